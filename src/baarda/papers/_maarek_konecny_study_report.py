"""The study of Maarek & Konecny laid out: homogeneity, laws, tests, the a of the errors, and what the scale rules do."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from baarda.distributions import Fit, fit, fit_classes, law
from baarda.distributions.histogram import count
from baarda.hypotheses import Options, bartlett, variance_per_image
from baarda.hypotheses.goodness_of_fit import from_evidence as goodness_of
from baarda.hypotheses.moments import from_evidence as moments_of
from baarda.papers import _maarek_konecny_printed as p
from baarda.papers._drawing import class_histogram
from baarda.papers.base import Comparison, Figure, Reason, Row, row
from baarda.papers.maarek_konecny_study import ENLARGEMENT, PRINCIPAL_DISTANCE, SETS, ScaleRule, Study, a_of_kurtosis, scale_rule

__all__ = ["report"]

SAMPLE = Reason("sample", "One simulated sample: estimates scatter, and a test of a false hypothesis need not reject it.")
OTHER = Reason("other data", "Simulated measurements, not those of the paper.")
REPLICAS = Reason("replicas", "A mean over simulated data sets: it scatters a little around the true value.")
SCALE = Reason(
    "scale rule", "Raw residuals have the standard deviation sqrt(r/n) sigma; S_o divides by the redundancy: the curve is too wide."
)
MIXTURE = Reason("mixed scales", "Residuals of 9 and 25 points have unequal standard deviations, one S_M serves all.")


def _laws(made: Study) -> dict[str, Fit]:
    """The laws of Table 4 for the simulated V, open end classes."""
    v = made.residuals
    counts, mean, total = count(v, p.V_LIMITS), float(v.mean()), float(v @ v)
    s_o, s_m = np.sqrt(total / (made.redundancy - 1)), np.sqrt(total / (len(v) - 1))
    return {
        "lineo": fit_classes(counts, p.V_LIMITS, "lineo", loc=mean, scale=s_o, estimated=2),
        "radico": fit_classes(counts, p.V_LIMITS, "radico", loc=mean, scale=s_o, estimated=2),
        "normal S_o": fit_classes(counts, p.V_LIMITS, "normal", loc=mean, scale=s_o, estimated=2),
        "normal S_M": fit_classes(counts, p.V_LIMITS, "normal", loc=mean, scale=s_m, estimated=2),
        "normal Q_v": fit_classes(count(made.standardised, p.QV_LIMITS), p.QV_LIMITS, "normal", loc=0.0, scale=1.0, estimated=2),
        "normal S_P": fit_classes(counts, p.V_LIMITS, "normal"),
    }


def _word(rejected: bool | None) -> str:
    return "reject" if rejected else "accept"


def _homogeneity(made: Study) -> Comparison:
    rows = [
        row((label, "S_i (um)"), made.sigma, float(np.sqrt(s2)), 2, SAMPLE) for label, s2 in zip(made.labels, made.variances, strict=True)
    ]
    kinds = np.array([label.split(",")[0] for label in made.labels])
    for name, chosen in [(name, kinds == name) for name, _, _ in SETS] + [("all", np.ones(len(kinds), dtype=bool))]:
        s2, r = made.variances[chosen], made.redundancies[chosen]
        test = bartlett(s2, r)
        rows.append(row((name, "pooled S (um)"), made.sigma, float(np.sqrt(s2 @ r / r.sum())), 2, SAMPLE))
        rows.append(row((name, "Bartlett, theta / C"), None, float(np.asarray(test.statistic)), 3))
        rows.append(row((name, f"critical value, {len(r) - 1} degrees of freedom"), None, float(np.asarray(test.critical)), 3))
        rows.append(row((name, "equal variances"), "accept", _word(bool(test.rejected)), 2, SAMPLE))
        beyond = int(np.sum(variance_per_image(s2, r).rejected))
        rows.append(row((name, "sets beyond the 95 % limits of the pooled variance"), None, beyond, 0))
    note = (
        f"Each set is a grid plate in one image (principal distance {PRINCIPAL_DISTANCE} mm, enlarged {ENLARGEMENT:g} times), resected "
        "with six unknowns. Errors are sums of 1000 elementary errors, some of them zero: modulated normal with "
        f"a = {made.a:g} and standard deviation {made.sigma} um; seed {made.seed}."
    )
    return Comparison(
        "study-sets", "The study on simulated measurements: 19 resections", ("set", "quantity"), tuple(rows), note, ("true", "estimated")
    )


def _verdicts(fits: dict[str, Fit]) -> Comparison:
    rows: list[Row] = []
    for name, found in fits.items():
        rows.append(row((name, "chi-square"), p.V_CHI2[name], float(found.statistic or 0.0), 2, OTHER))
        rows.append(row((name, "decision"), "reject" if p.V_CHI2[name] > p.V_CRITICAL else "accept", _word(found.rejected), 2, OTHER))
    note = "The six laws of Table 4 for the simulated V: 12 classes of 4 um with open ends (of half a unit for Q_v), 9 degrees of freedom."
    return Comparison(
        "study-laws", "The study: laws for the simulated V", ("law", "quantity"), tuple(rows), note, ("paper's V", "simulated V")
    )


def _tests(made: Study) -> Comparison:
    truth = {
        "mean_of_residuals": "accept",
        "skewness_of_residuals": "accept",
        "kurtosis_of_residuals": "reject",
        "goodness_of_fit": "reject",
    }
    options, rows = Options(seed=made.seed), list[Row]()
    found = [*moments_of(made.evidence, options), *goodness_of(made.evidence, options)]
    for test in found:
        if test.name in truth:
            rows.append(row((test.name, "p-value"), None, float(test.p_value), 3))
            rows.append(row((test.name, test.null), truth[test.name], _word(bool(test.rejected)), 2, SAMPLE))
    note = (
        "Residuals divided by their own standard deviations; null laws by simulated normal errors through the 19 resections. The mean of "
        "raw V cannot be tested: the shifts of the camera make it zero (1'Qvv1 is nearly 0)."
    )
    return Comparison("study-tests", "The study: tests through Q_v", ("test", "quantity"), tuple(rows), note, ("true", "found"))


def _said(a: float) -> str:
    return f"{a:.2f}" if np.isfinite(a) else "infinite (normal)"


def _modulation(made: Study, replicas: int) -> tuple[Comparison, list[str]]:
    true = law("modulated_normal")(a=made.a).excess_kurtosis()
    residual_true = a_of_kurtosis(true * made.dilution())
    found = made.excess_kurtosis
    a_errors = a_of_kurtosis(found)
    power, cumulant = made.kurtosis_of_errors(made.replicas(500, a_errors, made.seed + 1))
    spread = float(np.std(cumulant / power, ddof=1))
    low, high = a_of_kurtosis(found + 1.96 * spread), a_of_kurtosis(found - 1.96 * spread)
    likelihood = fit(made.standardised, "modulated_normal", loc=0.0)
    z = made.standardised
    moment = a_of_kurtosis(float(np.mean(z**4) / np.mean(z**2) ** 2) - 3.0)

    many = made.replicas(replicas, made.a, made.seed + 2)
    power, cumulant = made.kurtosis_of_errors(many)
    recovered = a_of_kurtosis(float(cumulant.mean() / power.mean()))
    scaled = many / np.sqrt(made.shares)[:, None]
    seen = a_of_kurtosis(float(np.mean(scaled**4) / np.mean(scaled**2) ** 2) - 3.0)
    one, over = "this data set", f"{replicas} replicas"
    rows = [
        row((one, "excess kurtosis of the errors, through Qvv"), true, found, 3, SAMPLE, f"standard error {spread:.2f}"),
        row((one, "a of the errors, through Qvv"), made.a, a_errors, 2, SAMPLE, f"95 %: {low:.2f} to {_said(high)}"),
        row((one, "standard deviation of the errors (um)"), made.sigma, made.sigma0, 2, SAMPLE),
        row((one, "a of the residuals, from their kurtosis"), residual_true, moment, 2, SAMPLE),
        row((one, "a of the residuals, maximum likelihood"), residual_true, likelihood.parameters["a"], 2, SAMPLE),
        row((over, "a of the errors, through Qvv"), made.a, recovered, 2, REPLICAS),
        row((over, "a of the residuals, from their kurtosis"), residual_true, seen, 2, REPLICAS),
    ]
    for name, _, side in SETS:
        part = next(r for r in made.projectors if len(r) == 2 * side * side)
        dilution = float(np.mean(np.sum(part**4, axis=1) / np.diag(part) ** 2))
        rows.append(row((name, "share of the errors' excess kurtosis left in residuals"), None, dilution, 3))
        rows.append(row((name, f"a of residuals where that of the errors is {made.a:g}"), None, a_of_kurtosis(true * dilution), 2))
    note = (
        "Residuals are mixtures of errors and more normal than these: the excess kurtosis of v_i is that of e times sum_j R_ij^4 / R_ii^2, "
        "R = Qvv P. Undoing this through Qvv gives the a of the errors."
    )
    upper = f"to {high:.2f}" if np.isfinite(high) else "upwards, the normal law included"
    said = (
        f"Study: the errors were drawn with a = {made.a:g}. The a of the errors through Qvv is {_said(a_errors)} (95 %: {low:.2f} {upper}: "
        f"630 residuals determine it only roughly), the a of the residuals {_said(likelihood.parameters['a'])}; over {replicas} replicas "
        f"these are {recovered:.2f} and {seen:.2f}."
    )
    title = "The study: a of the errors and a of the residuals"
    return Comparison("study-a", title, ("data", "quantity"), tuple(rows), note, ("true", "estimated")), [said]


def _rules(made: Study, replicas: int) -> tuple[Comparison, list[str]]:
    rows: list[Row] = []
    found: dict[str, ScaleRule] = {}
    choices: Sequence[tuple[str, str, bool]] = (
        ("open ends", "open", False),
        ("closed ends", "closed", False),
        ("closed ends, moments of class mids", "closed", True),
    )
    for label, ends, grouped in choices:
        rule = found[label] = scale_rule(made, replicas, ends, grouped, seed=made.seed + 3)
        for name, share in rule.rejected.items():
            level = 0.05 if name.startswith("normal") else None
            reason = SCALE if name == "normal S_o" else MIXTURE if name == "normal S_M" else REPLICAS
            rows.append(row(("normal", label, f"{name} rejected"), level, share, 2, reason))
        rows.append(row(("normal", label, "normal S_o rejected, a modulated law accepted"), None, rule.modulated_instead, 2))
    kind = f"modulated, a = {made.a:g}"
    for name, share in scale_rule(made, replicas, "open", False, made.a, made.seed + 4).rejected.items():
        rows.append(row((kind, "open ends", f"{name} rejected"), None, share, 2))
    note = f"{replicas} replicas through the 19 resections; shares in which chi-square with 9 degrees of freedom rejects at the level 5 %."
    wrong, instead = 100 * found["open ends"].rejected["normal S_o"], 100 * found["closed ends"].modulated_instead
    said = (
        f"What the S_o rule does to truly normal errors: with open ends it rejects them in {wrong:.0f} % of the replicas; with closed ends "
        f"it rejects the normal law and accepts a modulated one in {instead:.0f} %. The paper's verdict on V is thus partly an effect of "
        "its scale rule; Q_v does not have this fault."
    )
    title = "The study: what the scale rules do"
    return Comparison("study-rule", title, ("errors", "classes", "rule"), tuple(rows), note, ("level", "measured")), [said]


def report(made: Study, replicas: int = 2000) -> tuple[tuple[Comparison, ...], tuple[Figure, ...], list[str]]:
    """Lay out a study: homogeneity, laws, tests, the a of the errors, and what the scale rules do.

    Parameters
    ----------
    made : Study
    replicas : int
        Simulated data sets behind each share and mean.

    Returns
    -------
    comparisons : tuple of Comparison
    figures : tuple of Figure
    sentences : list of str

    Examples
    --------
    >>> from baarda.papers.maarek_konecny_study import study
    >>> tables, figures, said = report(study(), replicas=100)
    >>> [t.table for t in tables]
    ['study-sets', 'study-laws', 'study-tests', 'study-a', 'study-rule']
    """
    fits = _laws(made)
    homogeneity, verdicts = _homogeneity(made), _verdicts(fits)
    modulation, said_a = _modulation(made, replicas)
    rules, said_rules = _rules(made, replicas)
    accepted = [name for name, f in fits.items() if not f.rejected]
    refused = [name for name, f in fits.items() if f.rejected]
    equal = "accepted" if homogeneity.value("all", "equal variances") == "accept" else "rejected"
    said = (
        f"Study on simulated measurements, 19 resections: equal variances {equal}; laws accepted for V: {', '.join(accepted) or 'none'}; "
        f"rejected: {', '.join(refused) or 'none'}."
    )
    v = made.residuals
    curves = [
        (f"{name}, S_o = {fits[key].parameters['scale']:.2f}", fits[key].distribution)
        for name, key in (("normal", "normal S_o"), ("radico", "radico"))
    ]
    svg = class_histogram(
        "figure-study", count(v, p.V_LIMITS).astype(float), p.V_LIMITS, curves, float(len(v)), "simulated residual V", "um"
    )
    alt = f"Histogram of {len(v)} simulated residuals in 12 classes with the normal and the radico curve of the same standard deviation."
    figure = Figure(
        "figure-study",
        "The study: simulated V",
        "Class counts divided by the class width (end classes hold all values beyond), and 630 times the densities.",
        alt,
        svg,
    )
    return (homogeneity, verdicts, _tests(made), modulation, rules), (figure,), [said, *said_a, *said_rules]
