"""The tests that an adjustment under a law of errors still makes reject at about their level, under normal errors and under the law."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

import baarda
from baarda.adjustment.robust import NOT_APPLICABLE
from baarda.distributions import law
from baarda.hypotheses.levels import Options
from baarda.network import State
from baarda.procedures.testing import analyse
from networks import ring

pytestmark = pytest.mark.sampling
REPLICAS = 40
LEVEL = 0.05
#: True values of the additional parameters are zero, and the check points have their true coordinates.
NETWORK = {
    "images": 8,
    "points": 18,
    "control": 12,
    "checks": 6,
    "fixed_control": True,
    "noise": 0,
    "values": {"principal_distance": 1000.0, "principal_point_x": 505.0, "principal_point_y": 396.0, "K1": 0.0, "P1": 0.0},
    "free": ("principal_distance", "K1", "P1"),
}
#: Law of the adjustment, law of the errors.
CASES = [
    ("huber", "normal"),
    ("huber", "huber"),
    ("modulated_normal", "radico"),
    ("cauchy", "normal"),
    ("cauchy", "cauchy"),
]


@cache
def decisions(robust, errors):
    """Return the share of its members that each test rejects in each replica, by name."""
    network = baarda.adjust(ring(**NETWORK)).network
    group, state = network.observations[0], State.of(network)
    exact = group.xy - group.misclosures(network, state)
    drawn = law(errors)()
    out = {}
    for child in np.random.SeedSequence(17).spawn(REPLICAS):
        rng = np.random.default_rng(child)
        disturbed = replace(group, xy=exact + group.sigmas * drawn.rvs(exact.shape, rng))
        made = analyse(baarda.adjust(replace(network, observations=(disturbed,)), robust=robust), Options(alpha=LEVEL))
        assert made.converged
        assert not {t.name for t in made.tests} & set(NOT_APPLICABLE)
        for t in made.tests:
            out.setdefault(t.name, []).append(float(np.mean(t.rejected)))
    return {name: np.array(values) for name, values in out.items()}


@pytest.mark.parametrize(("robust", "errors"), CASES)
def test_every_test_that_is_made_keeps_its_level(robust, errors):
    found = decisions(robust, errors)
    print(robust, errors, {name: round(float(v.mean()), 3) for name, v in found.items()})
    assert "additional_parameter" in found
    assert ("check_points" in found) == (robust != "cauchy")
    for name, v in found.items():
        assert len(v) > 0.9 * REPLICAS, name
        spread = np.sqrt(LEVEL * (1 - LEVEL) / len(v))  # of single tests; members of a family vary less
        assert v.mean() < LEVEL + 4 * spread, name


def test_the_level_of_all_cases_together():
    """What no case shows alone: a rate that is a little too high everywhere."""
    found = [decisions(*case) for case in CASES]
    for name in dict.fromkeys(n for f in found for n in f):
        v = np.concatenate([f[name] for f in found if name in f])
        assert abs(v.mean() - LEVEL) < 4 * np.sqrt(LEVEL * (1 - LEVEL) / len(v)), name
