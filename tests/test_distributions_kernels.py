"""Speed and scale: compiled loops and their twins, tabulated likelihoods, mergeable bins, streams, the polished fit."""

from __future__ import annotations

import json
import math
import subprocess
import sys
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import baarda.distributions as D
from baarda.distributions import kernels as K
from baarda.distributions.condensed import Condensed, condense, condense_stream
from baarda.distributions.fitting import fit
from baarda.distributions.generalised_normal import GeneralisedNormal
from baarda.distributions.modulated import ModulatedNormal
from baarda.distributions.sample import Sample
from baarda.distributions.tabulated import _table, log_likelihood, log_likelihood_gradient
from baarda.errors import UsageError

SHAPES = [-0.95, -0.9, -0.6, -0.5, -0.4999, -0.3, 0.0, 0.1, 0.5, 1.0, 1.5, 2.0, 3.3, 8.0, 25.0, 100.0, 1e4, 1e13, np.inf]


def sample(a: float = 0.5, n: int = 630, seed: int = 0, loc: float = 0.0, scale: float = 1.0) -> np.ndarray:
    return ModulatedNormal(a, loc=loc, scale=scale).rvs(n, np.random.default_rng(seed))


@pytest.fixture(scope="module")
def loops() -> K.Kernels:
    pytest.importorskip("numba")
    found = K.compiled()
    assert found is not None
    assert found.compiled
    return found


def fields(c: Condensed) -> list[np.ndarray]:
    return [c.keys, c.counts, c.high, c.low, c.squares]


# ---- loops and twins ------------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("n", [0, 1, 1023, 1024, 1025, 50_000])
def test_loop_and_twin_agree_to_the_last_bit(loops: K.Kernels, n: int) -> None:
    rng = np.random.default_rng(n)
    x = rng.standard_normal(n) * np.exp2(rng.integers(-40, 12, n))
    special = [0.0, -0.0, 5e-324, -1e-310, 1e300, -1e300]
    x[: min(n, 6)] = special[: min(n, 6)]
    tables = rng.standard_normal((3, K.INTERVALS + 1, K.COEFFICIENTS))
    tables[:, -1] = 0.0
    for loc, inverse in ((0.0, 1.0), (0.3, 0.7)):
        assert loops.log_sum(x, loc, inverse, tables[0]) == K.TWINS.log_sum(x, loc, inverse, tables[0])
        mine, theirs = np.zeros(4), np.zeros(4)
        assert loops.gradient_sums(x, loc, inverse, tables, mine) == K.TWINS.gradient_sums(x, loc, inverse, tables, theirs)
        assert np.array_equal(mine, theirs)
        bins, twin = np.zeros((2, K.KEYS, 4), dtype=np.int64)
        loops.bin_values(x, loc, bins)
        K.TWINS.bin_values(x, loc, twin)
        assert np.array_equal(bins, twin)
        assert np.sum(bins[:, 0]) == n


def test_loops_take_read_only_arrays_and_count_what_is_outside(loops: K.Kernels) -> None:
    x = np.array([1.0, np.inf, -np.inf, np.nan, 0.0, 2.0**K.HIGHEST, -(2.0**K.LOWEST)])
    x.setflags(write=False)
    table = np.ones((K.INTERVALS + 1, K.COEFFICIENTS))
    table[-1] = 0.0
    table.setflags(write=False)
    for each in (loops, K.TWINS):
        total, outside = each.log_sum(x, 0.0, 1.0, table)
        assert outside == 5
        assert math.isfinite(total)


def test_numba_is_not_needed_and_changes_no_bit() -> None:
    code = """
import sys
{block}
import json, numpy as np
import baarda.distributions as D
from baarda.distributions.tabulated import log_likelihood, log_likelihood_gradient
from baarda.distributions import kernels
assert {block_word!r} == "" or kernels.compiled() is None
if {block_word!r} == "":
    kernels.compiled()
x = D.law("radico")(scale=2.0).rvs(40_000, np.random.default_rng(1))
law = D.law("modulated_normal")(a=0.7, loc=0.01, scale=1.9)
c = D.condense(x)
total, slopes = log_likelihood_gradient(x, law)
print(json.dumps([log_likelihood(x, law), total, slopes, c.squares.tolist(), D.fit(x, loc=0.0, polish=True).parameters]))
"""
    results = []
    for block in ("", "sys.modules['numba'] = None"):
        script = code.format(block=block, block_word="blocked" if block else "")
        run = subprocess.run([sys.executable, "-W", "error", "-c", script], capture_output=True, text=True, check=True)
        results.append(json.loads(run.stdout))
    assert results[0] == results[1]


def test_numba_is_imported_late() -> None:
    code = "import sys, baarda.distributions as D; D.laws(); D.fit([1.0, 2.0, 4.0, 9.0], 'normal'); print('numba' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.strip() == "False"


def test_no_place_for_a_cache_is_no_failure(monkeypatch: pytest.MonkeyPatch) -> None:
    numba = pytest.importorskip("numba")
    seen = []

    def njit(signature: object, *, nogil: bool, cache: bool) -> object:
        if cache:
            raise RuntimeError("cannot cache function: no locator available")
        seen.append(nogil)
        return lambda function: function

    monkeypatch.setattr(numba, "njit", njit)
    K.compiled.cache_clear()
    try:
        assert K.compiled() is not None
    finally:
        K.compiled.cache_clear()
    assert seen == [True, True, True]


# ---- tabulated likelihood -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("a", SHAPES)
def test_the_tabulated_likelihood_is_the_exact_one(a: float) -> None:
    x = sample(max(a, -0.6), 60_000, 5, scale=1.7)
    x[:6] = [0.1 + 1e-9, 0.1 - 3e-12, 250.0, -40.0, 1e-300, 30.0]  # some outside the table
    law = ModulatedNormal(a, loc=0.1, scale=1.3)
    exact = math.fsum(law.logpdf(x))
    assert log_likelihood(x, law) == pytest.approx(exact, rel=2e-15, abs=0.0)
    z = (x - law.loc) / law.scale
    _, score, (slope,) = ModulatedNormal._likelihood(z, a)
    total, gradient = log_likelihood_gradient(x, law)
    assert total == pytest.approx(exact, rel=2e-15, abs=0.0)
    for name, terms in (("a", slope), ("loc", -score / law.scale), ("scale", (-1.0 - z * score) / law.scale)):
        size = math.fsum(np.abs(terms))
        assert abs(gradient[name] - math.fsum(terms)) <= (1e-13 if a < 1e3 else 1e-9) * size, name


@pytest.mark.parametrize("name", sorted(D.laws()))
def test_every_law_can_be_summed(name: str) -> None:
    x = sample(0.5, 40_000, 6, scale=2.0)
    law = D.law(name)(loc=-0.05, scale=1.8)
    exact = math.fsum(law.logpdf(x))
    assert log_likelihood(x, law) == pytest.approx(exact, rel=1e-14)
    total, gradient = log_likelihood_gradient(x, law)
    assert total == pytest.approx(exact, rel=1e-14)
    assert gradient["loc"] == pytest.approx(-math.fsum(law.score(x)), abs=1e-13 * math.fsum(np.abs(law.score(x))))
    few, slopes = log_likelihood_gradient(x[:100], law)  # without a table
    assert few == pytest.approx(math.fsum(law.logpdf(x[:100])), rel=1e-14)
    assert set(slopes) == set(gradient)


@pytest.mark.parametrize("name", [*sorted(D.laws()), *SHAPES])
def test_a_table_holds_its_functions_everywhere(name: str | float) -> None:
    law = D.law(name)() if isinstance(name, str) else ModulatedNormal(name)
    table = _table(type(law), law.shape_values, gradient=False)
    tables = _table(type(law), law.shape_values, gradient=True)
    if name in ("contaminated_normal", "huber"):  # too rough for polynomials: these are summed exactly
        assert table is None
        return
    z = np.exp2(np.random.default_rng(3).uniform(K.LOWEST, K.HIGHEST, 20_000))
    k, v, outside = K._places(z)
    assert outside == 0
    exact = law._logpdf(z, *law.shape_values)
    assert np.max(np.abs(K._polynomial(table[0], k, v) - exact) / np.maximum(1.0, np.abs(exact))) < 3e-15
    assert np.array_equal(tables[0], table[0]) or tables[0] == pytest.approx(table[0], abs=1e-11)
    _, score, slopes = law._likelihood(z, *law.shape_values)
    for got, want in zip(tables[1:], (score, *slopes), strict=True):
        want = np.broadcast_to(want, z.shape)
        limit = 1e-13 if not law.shape_values or law.shape_values[0] < 1e3 else 1e-9
        assert np.max(np.abs(K._polynomial(got, k, v) - want) / np.maximum(1.0, np.abs(want))) < limit


@pytest.mark.parametrize("n", [1, 65_536, 65_537, 300_001])
def test_the_number_of_workers_changes_no_bit(n: int) -> None:
    x = sample(0.5, n, 7)
    law = ModulatedNormal(0.6)
    one = log_likelihood(x, law, workers=1), log_likelihood_gradient(x, law, workers=1)
    for workers in (2, 3, 8):
        assert (log_likelihood(x, law, workers=workers), log_likelihood_gradient(x, law, workers=workers)) == one
        assert all(np.array_equal(p, q) for p, q in zip(fields(condense(x, workers=1)), fields(condense(x, workers=workers))))
    with pytest.raises(UsageError, match="workers"):
        log_likelihood(x, law, workers=0)


def test_values_of_other_types_and_layouts() -> None:
    law = ModulatedNormal(0.6)
    x = np.round(sample(0.5, 40_000, 8) * 3.0)
    want = log_likelihood(x, law)
    wide = np.stack([x, x], axis=1)
    for same in (x.astype(np.float32), x.astype(np.int8), wide[:, 0], x.reshape(200, 200), x.astype(">f8")):
        assert log_likelihood(same, law) == want
        assert np.array_equal(condense(same).squares, condense(x).squares)
    assert log_likelihood([], law) == 0.0
    assert math.isnan(log_likelihood(np.append(x, np.nan), law))
    assert log_likelihood(np.append(x, np.inf), ModulatedNormal(np.inf)) == -np.inf


def test_the_gradient_is_that_of_the_sum() -> None:
    x = sample(0.5, 50_000, 9, loc=0.2, scale=2.0)
    start = {"a": 0.8, "loc": 0.1, "scale": 1.8}
    _, gradient = log_likelihood_gradient(x, ModulatedNormal(**start))
    for name in start:
        h = 1e-4
        up, down = (log_likelihood(x, ModulatedNormal(**(start | {name: start[name] + s}))) for s in (h, -h))
        assert gradient[name] == pytest.approx((up - down) / (2 * h), rel=1e-5), name


# ---- bins -----------------------------------------------------------------------------------------------------------------------------


def test_merging_is_free_of_order_to_the_last_bit() -> None:
    x = sample(0.2, 50_000, 10, scale=3.0)
    whole = condense(x, 0.1)
    rng = np.random.default_rng(0)
    for _ in range(5):
        cuts = np.sort(rng.integers(0, x.size, 6))
        parts = [condense(p, 0.1) for p in np.split(rng.permutation(x), cuts) if p.size]
        while len(parts) > 1:
            i, j = rng.permutation(len(parts))[:2]
            merged = parts[i] + parts[j]
            parts = [p for k, p in enumerate(parts) if k not in (i, j)] + [merged]
        assert all(np.array_equal(p, q) for p, q in zip(fields(whole), fields(parts[0])))


@settings(max_examples=60, deadline=None)
@given(st.lists(st.floats(allow_nan=False, allow_infinity=False, min_value=-1e150, max_value=1e150), min_size=1, max_size=40))
def test_bins_keep_count_and_sum(values: list[float]) -> None:
    c = condense(values)
    assert c.n == len(values)
    assert all(np.all(f >= 0) for f in fields(c))
    exact = sum(map(Fraction, values))
    size = sum(abs(Fraction(v)) for v in values)
    assert abs(Fraction(math.fsum(c.sums)) - exact) <= size * Fraction(1, 10**14) + Fraction(5e-324) * len(values)
    for folded in (False, True):
        for per_octave in (64, 8, 1):
            points, weights = c.points(folded=folded, per_octave=per_octave)
            assert math.fsum(weights) == pytest.approx(len(values))
            squares = sum(Fraction(float(w)) * Fraction(float(p)) ** 2 for p, w in zip(points, weights))
            wanted = sum(Fraction(v) ** 2 for v in values)
            assert abs(squares - wanted) <= wanted * Fraction(1, 10**7) + Fraction(1e-300) * len(values)
            if folded:
                assert np.all(points >= -1e-9 * np.max(np.abs(points)))


def test_narrow_bins_hold_moments_up_to_the_third() -> None:
    x = sample(0.5, 100_000, 11, loc=0.3)
    for per_octave in (64, 8):
        points, weights = condense(x, 0.1).points(per_octave=per_octave)
        d = x - 0.1
        for power, limit in ((1, 1e-13), (2, 1e-9), (3, 1e-4 if per_octave == 8 else 1e-6), (4, 1e-4 if per_octave == 8 else 1e-7)):
            assert weights @ points**power == pytest.approx(np.sum(d**power), rel=limit), (per_octave, power)


def test_too_many_values_for_the_bins_is_an_error() -> None:
    one = condense([1.9999999999])
    many = Condensed(0.0, one.keys, one.counts, one.high, one.low, np.array([2**63 - 1]))
    with pytest.raises(UsageError, match="one bin"):
        many + one


def test_a_stream_is_one_pass_over_all_values() -> None:
    x = sample(0.5, 600_000, 12)
    seen: list[int] = []
    buffer = np.empty(100_000)

    def chunks():
        for part in np.split(x, 6):
            buffer[:] = part  # a caller may use one buffer for all chunks
            yield buffer

    stream = condense_stream(chunks(), progress=seen.append, workers=2)
    assert all(np.array_equal(p, q) for p, q in zip(fields(stream), fields(condense(x))))
    assert seen == [100_000 * k for k in range(1, 7)]
    about = condense_stream(iter([np.array([]), x[:10], x[10:]]), centre=None)
    assert about.centre == pytest.approx(np.mean(x[:10]))
    assert about.mean == pytest.approx(np.mean(x), abs=1e-14)


def test_bad_streams_are_refused() -> None:
    x = sample(0.5, 300_000, 13)
    bad = x.copy()
    bad[299_990] = np.nan
    for workers in (1, 2):
        with pytest.raises(UsageError, match="1 of those from number 562145 to 600000 are not"):
            condense_stream([x, bad], workers=workers)
    with pytest.raises(UsageError, match="finite"):
        condense([np.inf])
    with pytest.raises(UsageError, match="finite"):
        condense_stream([[np.nan, 1.0]], centre=None)
    with pytest.raises(UsageError, match="no values"):
        condense_stream([])
    with pytest.raises(UsageError, match="no values"):
        condense([])


# ---- fits -----------------------------------------------------------------------------------------------------------------------------


def full_fit(x: np.ndarray, start: dict[str, float], names: tuple[str, ...]) -> dict[str, float]:
    """Newton's method on the exact log-densities of all values, with the curvature by differences of their exact slopes."""

    def slopes(p: dict[str, float]) -> np.ndarray:
        z = (x - p["loc"]) / p["scale"]
        _, score, (along,) = ModulatedNormal._likelihood(z, p["a"])
        out = {"a": np.sum(along), "loc": -np.sum(score) / p["scale"], "scale": np.sum(-1.0 - z * score) / p["scale"]}
        return np.array([out[name] for name in names])

    p = dict(start)
    h = 1e-4
    curvature = np.stack(
        [(slopes(p | {name: p[name] + h}) - slopes(p | {name: p[name] - h})) / (2.0 * h) for name in names],
    )
    for _ in range(4):
        p |= dict(zip(names, np.array([p[n] for n in names]) - np.linalg.solve(0.5 * (curvature + curvature.T), slopes(p))))
    return p


@pytest.mark.parametrize(
    ("a", "loc", "names"),
    [(0.5, 0.0, ("a", "scale")), (0.0, 0.0, ("a", "scale")), (-0.4, 0.0, ("a", "scale")), (2.0, None, ("a", "loc", "scale"))],
)
def test_condensed_and_polished_fits_agree_with_the_full_one(a: float, loc: float | None, names: tuple[str, ...]) -> None:
    x = sample(a, 60_000, 14, scale=2.0)
    rough, polished = fit(x, loc=loc), fit(x, loc=loc, polish=True)
    full = full_fit(x, rough.parameters, names)
    for name in names:
        error = rough.standard_errors[name]
        assert abs(rough.parameters[name] - full[name]) < 1e-4 * error, name  # 1e-2 is wanted
        assert abs(polished.parameters[name] - full[name]) < 1e-7 * error + 1e-9 * abs(full[name]), name  # 1e-4 is wanted
    exact = math.fsum(ModulatedNormal(**full).logpdf(x))
    assert polished.log_likelihood == pytest.approx(exact, rel=1e-14)
    assert rough.log_likelihood == pytest.approx(exact, abs=1e-3)
    assert polished.standard_errors == pytest.approx(rough.standard_errors, rel=1e-6)


def test_a_polished_fit_keeps_what_is_at_a_bound() -> None:
    x = np.random.default_rng(15).uniform(-1.0, 1.0, 30_000)
    found = fit(x, loc=0.0, polish=True)
    assert found.parameters["a"] == np.inf
    assert found.parameters["scale"] == pytest.approx(np.sqrt(np.mean(x * x)), rel=1e-9)
    assert found.log_likelihood == pytest.approx(np.sum(found.distribution.logpdf(x)), rel=1e-13)
    few = fit(x[:100], "student", polish=True)  # nothing condensed: nothing to polish
    assert few == fit(x[:100], "student")
    given = fit(x, "radico", loc=0.0, scale=0.5, polish=True)
    assert given.log_likelihood == log_likelihood(x, given.distribution)


def test_polishing_needs_the_values() -> None:
    x = sample(0.5, 30_000, 16)
    with pytest.raises(UsageError, match="polish"):
        fit(condense(x), polish=True)
    with pytest.raises(UsageError, match="polish"):
        fit(x, rule="moments", polish=True)


@pytest.mark.parametrize("name", ["student", "generalised_normal", "laplace", "logistic", "normal", "radico"])
def test_other_laws_are_fitted_by_levels_as_well(name: str) -> None:
    x = sample(0.5, 30_000, 17, scale=2.0)
    condensed = fit(x, name, loc=0.0)
    raw = fit(condense(x), name, loc=0.0)
    assert condensed.parameters == raw.parameters
    best = log_likelihood(x, condensed.distribution)
    assert condensed.log_likelihood == pytest.approx(best, abs=1e-4)
    for p in condensed.estimated:
        for factor in (0.999, 1.001):
            other = D.law(name)(**{k: v for k, v in condensed.parameters.items() if k != "a"} | {p: condensed.parameters[p] * factor})
            assert log_likelihood(x, other) < best, p


def test_both_sides_are_put_together_only_about_the_centre() -> None:
    x = np.where(np.arange(30_000) % 2 == 0, 1.0, -1.0)
    found = fit(x, "normal", loc=0.0)
    assert found.parameters["scale"] == pytest.approx(1.0)
    assert fit(sample(0.5, 30_000, 18), loc=0.0).log_likelihood == pytest.approx(
        fit(condense(sample(0.5, 30_000, 18), 0.01), loc=0.0).log_likelihood, abs=1e-4
    )
    of = Sample.of_condensed(condense(x))
    assert of.reduced(folded=False, coarse=False) is of
    assert Sample.of(x[:10], 0.0).reduced(folded=True, coarse=True).points.size == 10


@pytest.mark.parametrize("p", [0.4, 1.0, 1.5, 2.0, 7.0])
def test_score_of_the_generalised_normal_law_at_its_centre(p):
    """For p < 1 the power is infinite there: the score is 0 without a warning, and elsewhere the derivative of the log-density."""
    z = np.array([0.0, -0.0, 1e-300, -0.3, 2.0, 1e6])
    score = GeneralisedNormal._score(z, p)
    assert (score[:2] == 0.0).all()
    np.testing.assert_allclose(score[2:], [-p * np.sign(v) * abs(v) ** (p - 1.0) for v in z[2:].tolist()], rtol=1e-14)
