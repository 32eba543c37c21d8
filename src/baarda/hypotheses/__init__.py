"""Tests of hypotheses: one file per test, every test also a function on plain numbers.

``run`` goes over all members. The functions and types of the members are public names of this package and are
loaded when first used: ``import baarda.hypotheses`` imports neither NumPy nor SciPy.
"""

from __future__ import annotations

import sys
from importlib import import_module
from importlib.util import find_spec
from types import ModuleType
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from baarda.hypotheses.base import Estimates as Estimates
    from baarda.hypotheses.base import Evidence as Evidence
    from baarda.hypotheses.base import SimulatedLaw as SimulatedLaw
    from baarda.hypotheses.base import TestResult as TestResult
    from baarda.hypotheses.check_points import check_points as check_points
    from baarda.hypotheses.control_points import control_points as control_points
    from baarda.hypotheses.deformation import deformation as deformation
    from baarda.hypotheses.levels import Options as Options

_BASE = ("Estimates", "Evidence", "SimulatedLaw", "TestResult")


def run(evidence: Evidence, options: Options | None = None) -> list[TestResult]:
    """Run every test that the evidence allows, in the order of an analysis: global, residuals, observations, parameters, points.

    Parameters
    ----------
    evidence : Evidence
        What an adjustment, or a table of residuals, can tell.
    options : Options, optional
        Levels, power, choice of sigma, seed and number of replicas.

    Returns
    -------
    list of TestResult
        The tests whose fields are present. A member states its place by a module constant ``ORDER``; one that simulates its null law may
        define ``simulated_statistic(evidence, options)``, a function of residuals: all of these are computed from the same replicas.

    Notes
    -----
    Order of the analysis: A. Grün, Photogrammetria 34 (1978) 381-400.

    Examples
    --------
    >>> import numpy as np
    >>> from baarda.hypotheses import Evidence, run
    >>> v = np.array([0.4, -1.1, 0.3, 0.9, -0.6, 0.2, -0.4, 0.3])
    >>> [t.name for t in run(Evidence(residuals=v, sigmas=np.ones(8), vpv=float(v @ v), redundancy=7))][:2]
    ['global_variance_factor', 'mean_of_residuals']
    """
    from dataclasses import replace

    from baarda.discover import modules
    from baarda.hypotheses._simulation import simulate_all
    from baarda.hypotheses.levels import Options

    chosen = Options() if options is None else options
    members = [m for m in modules(__name__) if hasattr(m, "from_evidence")]
    ordered = sorted(members, key=lambda m: (getattr(m, "ORDER", 1000), m.__name__))
    if evidence.residuals_of is not None and not evidence.simulated:
        wanted = {
            m.__name__.rpartition(".")[2]: m.simulated_statistic(evidence, chosen) for m in ordered if hasattr(m, "simulated_statistic")
        }
        shared = simulate_all(evidence, {name: s for name, s in wanted.items() if s is not None}, chosen)
        evidence = replace(evidence, simulated=shared)
    return [result for member in ordered for result in member.from_evidence(evidence, chosen)]


class _Package(ModuleType):
    """The package as a module whose attribute is the *function* where a member file and its function share a name."""

    def __setattr__(self, name: str, value: Any) -> None:
        # Importing baarda.hypotheses.check_points would otherwise hide the function check_points behind its file.
        super().__setattr__(name, getattr(value, name, value) if isinstance(value, ModuleType) else value)


sys.modules[__name__].__class__ = _Package


def __getattr__(name: str) -> Any:
    if name.startswith("_"):
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    if name in _BASE:
        return getattr(import_module(f"{__name__}.base"), name)
    if find_spec(f"{__name__}.{name}") is not None:
        module = import_module(f"{__name__}.{name}")
        return getattr(module, name, module)
    from baarda.discover import modules

    for module in (*modules(__name__), import_module(f"{__name__}._linear_model")):
        if name in getattr(module, "__all__", ()):
            return getattr(module, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    from baarda.discover import modules

    public = {name for module in modules(__name__) for name in getattr(module, "__all__", ())}
    return sorted(public | {*_BASE, "run", "linear_model"})
