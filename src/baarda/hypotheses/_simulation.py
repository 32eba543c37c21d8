"""Null laws by simulation: standard normal errors, pushed through the map from errors to residuals."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np
from numpy.typing import NDArray

from baarda.errors import UsageError
from baarda.hypotheses.base import Evidence, Floats
from baarda.hypotheses.levels import Options

_NUMBERS = 4e7  # simulated errors per null law
_FEWEST = 199
_CHUNK = 2.0e8 / (8 * 6)  # numbers in a chunk: errors, residuals and temporaries stay below 200 MB
UNCONTROLLED = 1e-10


def controlled(evidence: Evidence) -> NDArray[np.bool_]:
    """Return which observations are controlled by others: the variance of the residual is a visible share of that of the observation."""
    if evidence.qvv is not None:
        return np.asarray(evidence.qvv * evidence.sigma0_apriori**2 / evidence.sigmas**2 >= UNCONTROLLED)
    if evidence.redundancy_numbers is not None:
        return np.asarray(evidence.redundancy_numbers >= UNCONTROLLED)
    return np.ones(len(evidence.residuals), dtype=bool)


def shares(evidence: Evidence) -> Floats:
    """Return var(v_i) / sigma_i^2: the redundancy number where observations are uncorrelated, 1 where nothing is known."""
    if evidence.qvv is not None:
        return np.asarray(evidence.qvv * evidence.sigma0_apriori**2 / evidence.sigmas**2)
    if evidence.redundancy_numbers is not None:
        return np.asarray(evidence.redundancy_numbers)
    return np.ones(len(evidence.residuals))


def affordable(evidence: Evidence, options: Options) -> int:
    """Return the number of replicas that can be afforded; 0 where the null cannot be simulated."""
    if evidence.residuals_of is None:
        return 0
    wanted = max(options.replicas, int(np.ceil(4.0 / options.alpha)) - 1)  # a two-sided test at level alpha needs 2 / alpha - 1
    count = int(min(wanted, _NUMBERS // max(len(evidence.residuals), 1)))
    return count if count >= min(_FEWEST, options.replicas) else 0


def simulate(evidence: Evidence, name: str, statistic: Callable[[Floats], Floats], options: Options) -> Floats | None:
    """Return the statistics of simulated data sets, (B, ...), or None where the null cannot be simulated or is not affordable.

    `statistic` maps residuals in units of the a-priori sigma, (n, b), to (b, ...). Where one pass has computed them for all tests, they are
    taken from there by the name of the test.
    """
    found = evidence.simulated.get(name)
    return simulate_all(evidence, {name: statistic}, options).get(name) if found is None else found


def simulate_all(evidence: Evidence, statistics: Mapping[str, Callable[[Floats], Floats]], options: Options) -> dict[str, Floats]:
    """Return several statistics of the same simulated data sets by name; nothing where the null cannot be simulated or is not affordable.

    Replica k uses child k of the seed, so that the result does not depend on the chunks. Leading residuals through the adjustment costs
    far more than the statistics do: all tests that simulate share one pass.
    """
    count, n = affordable(evidence, options), len(evidence.residuals)
    if count == 0 or evidence.residuals_of is None or not statistics:
        return {}
    children = np.random.SeedSequence(options.seed).spawn(count)
    width = max(1, int(_CHUNK // max(n, 1)))
    parts: dict[str, list[Floats]] = {name: [] for name in statistics}
    for start in range(0, count, width):
        chunk = children[start : start + width]
        errors = np.empty((n, len(chunk)))
        for k, child in enumerate(chunk):
            errors[:, k] = np.random.default_rng(child).standard_normal(n)
        residuals = np.asarray(evidence.residuals_of(errors), dtype=float)
        if residuals.shape != errors.shape:
            raise UsageError(f"residuals_of maps {errors.shape} to {residuals.shape}; it must keep the shape")
        for name, statistic in statistics.items():
            parts[name].append(statistic(residuals))
    return {name: np.concatenate(found) for name, found in parts.items()}


def null_note(evidence: Evidence, options: Options, count: int) -> str:
    """Return how the null law was found."""
    if count:
        fewer = f" (fewer than {options.replicas}: {len(evidence.residuals)} observations)" if count < options.replicas else ""
        coarse = 2.0 / (count + 1) > options.alpha
        undecided = f" They are too few for the level {options.alpha:g}: a test that does not reject decides nothing." if coarse else ""
        return f"Null law by {count} simulated adjustments of normal errors{fewer}, seed {options.seed}.{undecided}"
    why = "too many observations to simulate" if evidence.residuals_of is not None else "the map from errors to residuals is not at hand"
    return f"Asymptotic law for independent residuals of equal variance ({why}): approximate for residuals of an adjustment."


def skipped_note(skipped: int) -> str:
    """Return how many observations were left out because no other observation controls them."""
    return f" {skipped} uncontrolled observations (redundancy number below 1e-10) are left out." if skipped else ""
