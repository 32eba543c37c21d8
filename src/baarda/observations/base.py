"""The contract of observation kinds: small independent blocks of rows, linearised where the state stands."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from baarda.network import Network, State

Floats = NDArray[np.float64]
Ints = NDArray[np.intp]


@dataclass(frozen=True)
class Block:
    """The part of the design matrix that belongs to one unknown group.

    Attributes
    ----------
    kind : str
        The unknown group.
    nodes : (N,) int array
        Node of each row block.
    jacobian : (N, m, w) array
        Partials of the computed observations with respect to all w parameters of the node.
    """

    kind: str
    nodes: Ints
    jacobian: Floats


@dataclass(frozen=True)
class Rows:
    """Row blocks of one observation group, linearised.

    Attributes
    ----------
    index : (N,) int array
        Position of each row block in its group.
    misclosure : (N, m) array
        l = observed - computed.
    blocks : tuple of Block
    cofactor : (N, m, m) array, or (N, m)
        Covariance matrix of each row block for unit variance factor; of uncorrelated rows the variances suffice.
    condition : (N, k, m) array or None
        Of a combined model with fewer conditions (k) than observations (m): the partials of the conditions with respect to the
        observations; misclosures and partials are those of `baarda.observations.combined.rows`.
    """

    index: Ints
    misclosure: Floats
    blocks: tuple[Block, ...]
    cofactor: Floats
    condition: Floats | None = None


class Kind(Protocol):
    """An observation group as the adjustment sees it."""

    @property
    def name(self) -> str:
        """Name of the group, as in the observation table."""

    def __len__(self) -> int: ...

    @property
    def components(self) -> tuple[str, ...]:
        """Names of the m observations of a row block."""

    @property
    def unit(self) -> str:
        """Unit of the observations."""

    def linearize(self, network: Network, state: State) -> list[Rows]:
        """Return all row blocks, each once."""

    def misclosures(self, network: Network, state: State) -> Floats:
        """Return observed - computed, (N, m), without partials."""

    def observed(self) -> Floats:
        """Return the observed values, (N, m)."""

    def sigma(self) -> Floats:
        """Return the a-priori standard deviations, (N, m)."""

    def labels(self, network: Network) -> dict[str, Any]:
        """Return the codes of image and point and the component of each row block for the observation table."""


def component_unit(group: Any, component: int) -> str:
    """Return the unit of one component of an observation group: from its `units`, one per component, where it has them, else its `unit`.

    Examples
    --------
    >>> from types import SimpleNamespace
    >>> component_unit(SimpleNamespace(unit="s, px", units=("s", "px")), 1), component_unit(SimpleNamespace(unit="m"), 1)
    ('px', 'm')
    """
    units = getattr(group, "units", None)
    return str(group.unit if units is None else units[component])
