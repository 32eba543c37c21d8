"""Compile all loops once, by adjusting a small network with them."""

from __future__ import annotations

from typing import Any

from baarda.adjustment import cluster_loops, kernels, vector_loops
from baarda.adjustment.solve import adjust
from baarda.network import Network
from baarda.observations import kernels as image_point_loops


def warm_up(network: Network) -> bool:
    """Compile the loops of the block solver and of image points, which then stay in numba's cache.

    Parameters
    ----------
    network : Network
        A small one, of a camera model that can be compiled.

    Returns
    -------
    bool
        Whether numba is there.
    """
    if kernels.compiled() is None:
        return False
    modules: tuple[Any, ...] = (cluster_loops, kernels, vector_loops, image_point_loops)
    limits = [m.COMPILE_FROM for m in modules]
    try:
        for m in modules:
            m.COMPILE_FROM = 0
        result = adjust(network, solver="block")
        result.redundancy_numbers  # noqa: B018
        result.residuals_of(result.residuals[:, None])
        result.lin.times(result.lin.scale[:, None] * 0.0, {"point"})
    finally:
        for m, limit in zip(modules, limits, strict=True):
            m.COMPILE_FROM = limit
    return True
