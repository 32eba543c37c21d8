"""Maarek & Konecny, Modulated Normal Distribution: Tables 1 to 6, Appendix 1, Figures 1 to 8, and the study on simulated measurements."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from itertools import combinations
from typing import Literal

import numpy as np
from scipy import special

from baarda.distributions import Fit, fit_classes, law
from baarda.distributions.base import Floats
from baarda.hypotheses import bartlett, variance_per_image
from baarda.papers import _maarek_konecny_printed as p
from baarda.papers._drawing import class_histogram
from baarda.papers.base import Comparison, Figure, Paper, Reason, Reproduction, Row, row

__all__ = ["reproduce"]

NAME, TITLE = "maarek-konecny", "Modulated Normal Distribution"
REFERENCE = "A. Maarek, G. Konecny, Modulated Normal Distribution, Photogrammetric Engineering, pages around 963 (revised 1972)."
LAWS = ("normal", "lineo", "radico")
Ends = Literal["open", "closed"]

SLIP = Reason("slip", "A slip or misprint of the paper: its own other numbers contradict it.")
TABLES = Reason("old tables", "Interpolated in the tables of the time; the printed modulated counts belong to a law about 1 % narrower.")
ROUNDED = Reason("rounding", "The paper computes from rounded intermediate values: z, probabilities to four decimals, S_o.")
INPUT = Reason("unprinted input", "The paper computes from single values, of which it prints only classes or rounded numbers.")
ENDS = Reason("end classes", "The paper does not say how far its end classes reach and what becomes of values beyond; ours are stated.")
TOTAL = Reason("629/630", "The counts sum to 629, the expectations to 630: the one value above 24 um has no class.")
FLAT = Reason("flat minimum", "The least chi-square is flat: the paper's search ended beside the minimum, which ours reaches.")
LOGARITHM = Reason("logarithm", "Chi-square needs the natural logarithm of S_i^2; the paper prints log S_i, and 25 points fit log10.")

#: Label, counts from the lowest class upwards, end classes, and the number that probabilities are multiplied with.
_V_CHOICES: tuple[tuple[str, Floats, Ends, float], ...] = (
    ("629 values, closed", p.V_COUNTS, "closed", 629.0),
    ("629 values against 630 P, closed", p.V_COUNTS, "closed", 630.0),
    ("630 values, open", p.V_COUNTS + np.eye(12)[11] * p.V_ABOVE, "open", 630.0),
)
PLAIN, PAPERS_OWN, OPEN = (choice[0] for choice in _V_CHOICES)


def _judged(
    counts: Floats, edges: Floats, name: str, ends: Ends, total: float, loc: float | None = None, scale: float | None = None
) -> Fit:
    """Return chi-square on the classes with two parameters taken as estimated, as the paper counts them."""
    return fit_classes(counts, edges, name, loc=loc, scale=scale, ends=ends, total=total, estimated=2)


def _decision(rejected: bool | None) -> str:
    return "reject" if rejected else "accept"


def _table_1() -> Comparison:
    rows: list[Row] = []
    for lower, z in zip(p.V_LOWER, p.V_Z, strict=True):
        wrong = SLIP if z == 2.5644 else ROUNDED
        rows.append(row((f"from {lower}", "z"), z, (lower - p.V_MEAN) / p.V_SD_REDUNDANCY, 4, wrong))
    slips = {(16, "normal"), (-16, "normal"), (-20, "normal")}
    narrow: list[Row] = []
    for name in LAWS:
        expected = _judged(p.V_COUNTS, p.V_LIMITS, name, "closed", 630.0, p.V_MEAN, p.V_SD_REDUNDANCY).histogram
        assert expected is not None  # noqa: S101  (fit_classes always makes one)
        for lower, printed, ours in zip(p.V_LOWER[1:], p.V_EXPECTED[name], expected.expected[::-1], strict=True):
            reason = SLIP if (lower, name) in slips else ROUNDED if name == "normal" else TABLES
            rows.append(row((f"{lower} to {lower + 4}", f"T {name}"), printed, float(ours), 2, reason))
        if name != "normal":
            own = fit_classes(p.V_EXPECTED[name][::-1], p.V_LIMITS, name, loc=p.V_MEAN, ends="closed", total=630.0)
            narrow.append(row(("all", f"S that the printed T {name} fit"), p.V_SD_REDUNDANCY, own.parameters["scale"], 2, TABLES))
    mids = (p.V_LIMITS[1:] + p.V_LIMITS[:-1]) / 2.0
    first, second = float(p.V_COUNTS @ mids), float(p.V_COUNTS @ mids**2)
    more = [
        row(("all", "sum F (12 classes)"), 629, float(p.V_COUNTS.sum()), 0),
        row(("all", "sum F t^2"), 32340, second, 0),
        row(("all", "M_o (um)"), p.V_MEAN, first / p.V_TOTAL, 3),
        row(("all", "redundancy less the mean"), 515, p.V_REDUNDANCY - 1, 0),
        row(("all", "S_o (um)"), p.V_SD_REDUNDANCY, float(np.sqrt(second / (p.V_REDUNDANCY - 1))), 2),
        row(("all", "S_M (um)"), p.V_SD_SAMPLE, float(np.sqrt(second / (p.V_TOTAL - 1))), 2, INPUT),
    ]
    note = (
        "V, 630 residuals of 19 grid measurements, classes of 4 um. T = 630 P between the class limits with M_o = -0.333 and S_o = 7.92; "
        "z = (limit - M_o) / S_o. The one value above 24 um stands in the row of the limit 24 and enters neither the sums nor T."
    )
    return Comparison("table-1", "Table 1: V with S_o", ("class (um)", "quantity"), (*rows, *more, *narrow), note)


def _table_2() -> Comparison:
    found = _judged(p.V_COUNTS, p.V_LIMITS, "normal", "closed", 630.0, p.V_MEAN, p.V_SD_SAMPLE).histogram
    assert found is not None  # noqa: S101
    z = (p.V_LIMITS[::-1] - p.V_MEAN) / p.V_SD_SAMPLE
    rows = [
        row((f"{b:g}", "z"), a, float(o), 4, SLIP if a == 3.8372 else ROUNDED) for b, a, o in zip(p.V_LIMITS[::-1], p.SM_Z, z, strict=True)
    ]
    rows += [
        row((f"{b:g}", "P below"), a, float(special.ndtr(o)), 4, ROUNDED) for b, a, o in zip(p.V_LIMITS[::-1], p.SM_BELOW, z, strict=True)
    ]
    rows += _of_classes(p.V_COUNTS, p.V_LIMITS, found.expected, p.SM_EXPECTED, p.SM_DISTANCE, p.SM_TERMS, 3)
    rows.append(row(("all", "sum of the printed terms"), p.V_CHI2["normal S_M"], float(np.sum(p.SM_TERMS)), 2, SLIP))
    rows.append(row(("all", "sum of terms"), p.V_CHI2["normal S_M"], float(found.terms.sum()), 2, ROUNDED))
    note = "Normal law with M_o = -0.333 and S_M = 7.19, T = 630 P. |F - T| is recomputed from the printed T."
    return Comparison("table-2", "Table 2: V with S_M", ("limit or class (um)", "quantity"), tuple(rows), note)


def _table_3() -> Comparison:
    found = _judged(p.QV_COUNTS, p.QV_LIMITS, "normal", "closed", 630.0, 0.0, 1.0).histogram
    assert found is not None  # noqa: S101
    rows = [row((f"{b:g}", "P below"), a, float(special.ndtr(b)), 4, ROUNDED) for b, a in zip(p.QV_LIMITS[::-1], p.QV_BELOW, strict=True)]
    rows += _of_classes(p.QV_COUNTS, p.QV_LIMITS, found.expected, p.QV_EXPECTED, p.QV_DISTANCE, p.QV_TERMS, 2)
    rows.append(row(("all", "sum of the printed terms"), p.V_CHI2["normal Q_v"], float(np.sum(p.QV_TERMS)), 2, ROUNDED))
    rows.append(row(("all", "sum of terms"), p.V_CHI2["normal Q_v"], float(found.terms.sum()), 2, SLIP, "4.71 for 4.81, and P rounded"))
    note = "Standard normal law for residuals divided by s0 sqrt(q), q from Q_v; T = 630 P. |F - T| is recomputed from the printed T."
    return Comparison("table-3", "Table 3: V with Q_v", ("limit or class (standard deviations)", "quantity"), tuple(rows), note)


def _of_classes(
    counts: Floats,
    limits: Floats,
    expected: Floats,
    printed: Sequence[float],
    distances: Sequence[float],
    terms: Sequence[float],
    decimals: int,
) -> Iterator[Row]:
    """Yield T, |F - T| from the printed T, and the terms of each class, from the top class downwards."""
    names = [f"{a:g} to {b:g}" for a, b in zip(limits[-2::-1], limits[:0:-1], strict=True)]
    f, t = counts[::-1], expected[::-1]
    for name, a, o in zip(names, printed, t, strict=True):
        yield row((name, "T"), a, float(o), 2, ROUNDED)
    for name, a, o in zip(names, distances, np.abs(f - np.array(printed)), strict=True):
        yield row((name, "|F - T|"), a, float(o), 2, SLIP)
    for name, a, o, d, e in zip(names, terms, (f - t) ** 2 / t, distances, np.abs(f - np.array(printed)), strict=True):
        yield row((name, "term"), a, float(o), decimals, SLIP if abs(d - e) > 0.05 else ROUNDED)


def _v_fits() -> dict[tuple[str, str], Fit]:
    """Chi-square of V under each law of Table 4 and each treatment of the classes."""
    fits = {}
    for choice, counts, ends, total in _V_CHOICES:
        args = (counts, p.V_LIMITS)
        fits["lineo", choice] = _judged(*args, "lineo", ends, total, p.V_MEAN, p.V_SD_REDUNDANCY)
        fits["radico", choice] = _judged(*args, "radico", ends, total, p.V_MEAN, p.V_SD_REDUNDANCY)
        fits["normal S_o", choice] = _judged(*args, "normal", ends, total, p.V_MEAN, p.V_SD_REDUNDANCY)
        fits["normal S_M", choice] = _judged(*args, "normal", ends, total, p.V_MEAN, p.V_SD_SAMPLE)
        fits["normal S_P", choice] = _judged(*args, "normal", ends, total)
    ends_of: tuple[tuple[str, Ends], ...] = (("630 values, closed", "closed"), (OPEN, "open"))
    for choice, ends in ends_of:
        fits["normal Q_v", choice] = _judged(p.QV_COUNTS, p.QV_LIMITS, "normal", ends, 630.0, 0.0, 1.0)
    return fits


def _table_4(fits: dict[tuple[str, str], Fit]) -> Comparison:
    rows: list[Row] = []
    reasons = {"lineo": TABLES, "radico": TABLES, "normal S_o": SLIP, "normal S_M": ROUNDED, "normal Q_v": SLIP, "normal S_P": FLAT}
    for name, printed in p.V_CHI2.items():
        for (which, choice), found in fits.items():
            if which != name:
                continue
            statistic = float(found.statistic or 0.0)
            rows.append(row((name, choice, "chi-square"), printed, statistic, 2, ENDS if choice == OPEN else reasons[name]))
            accepted = "reject" if printed > p.V_CRITICAL else "accept"
            rows.append(row((name, choice, "decision"), accepted, _decision(found.rejected)))
        if name == "normal S_P":
            for choice, counts, ends, total in _V_CHOICES:
                why = ENDS if choice == OPEN else FLAT
                minimum = fits[name, choice].parameters
                rows.append(row((name, choice, "M_P (um)"), p.V_MEAN_MINIMUM, minimum["loc"], 3, why))
                rows.append(row((name, choice, "S_P (um)"), p.V_SD_MINIMUM, minimum["scale"], 3, why))
                there = _judged(counts, p.V_LIMITS, "normal", ends, total, p.V_MEAN_MINIMUM, p.V_SD_MINIMUM)
                why = ENDS if choice == OPEN else TOTAL
                rows.append(row((name, choice, "chi-square at the printed M_P, S_P"), printed, float(there.statistic or 0.0), 2, why))
    for name, short in (("lineo", "lineo"), ("radico", "radico"), ("normal S_o", "normal")):
        t = np.array(p.V_EXPECTED[short])[::-1]
        own = float(np.sum((p.V_COUNTS - t) ** 2 / t))
        rows.append(row((name, "printed T of Table 1", "chi-square"), p.V_CHI2[name], own, 2, ROUNDED if name == "lineo" else SLIP))
    t = np.array([26.57 if v == 33.71 else v for v in p.V_EXPECTED["normal"]])[::-1]
    own, said = float(np.sum((p.V_COUNTS - t) ** 2 / t)), "26.57 is lineo's T in this class: a conjecture"
    rows.append(row(("normal S_o", "printed T, 26.57 for 33.71", "chi-square"), p.V_CHI2["normal S_o"], own, 2, ROUNDED, said))
    rows.append(row(("normal S_M", "", "standard deviation (um)"), 7.92, p.V_SD_SAMPLE, 2, SLIP, "Table 1 has 7.19"))
    rows.append(row(("all", "", "critical value, 9 degrees of freedom"), p.V_CRITICAL, float(special.chdtri(9, 0.05)), 2))
    note = (
        "Chi-square of V with 12 classes and 9 degrees of freedom. Closed: the outer classes stop at 24 um (at 3 standard deviations "
        "for Q_v); open: they reach to infinity and hold the value above 24. S_P: ours is the minimum over mean and standard deviation."
    )
    return Comparison("table-4", "Table 4: laws for V", ("law", "classes", "quantity"), tuple(rows), note)


def _fisher(fits: dict[tuple[str, str], Fit]) -> Comparison:
    limit = float(special.fdtri(9, 9, 0.95))
    chosen = {name: float(fits[name, "630 values, closed" if name == "normal Q_v" else PLAIN].statistic or 0.0) for name in p.V_CHI2}
    rows = []
    for a, b in combinations(("normal S_M", "normal Q_v", "normal S_P"), 2):
        ratio = max(chosen[a], chosen[b]) / min(chosen[a], chosen[b])
        rows.append(row((f"{a} : {b}", "ratio of chi-squares"), None, ratio, 3))
        rows.append(row((f"{a} : {b}", "verdict"), "compatible", "compatible" if ratio < limit else "different"))
    rows.append(row(("all", "F(9, 9) at 95 %"), None, limit, 3))
    note = "Descriptive only: two chi-squares of one sample are not independent, so their ratio does not follow Fisher's law."
    return Comparison("fisher", "Fisher ratios of the chi-squares of V (descriptive)", ("pair", "quantity"), tuple(rows), note)


def _table_5() -> Comparison:
    rows: list[Row] = []
    for b, z in zip(p.U_LIMITS, p.U_Z, strict=True):
        rows.append(row((f"{b:g}", "z"), z, b / p.U_SD, 4, SLIP if z in (1.7360, 3.5928) else ROUNDED))
    names = [f"{a:g} to {b:g}" for a, b in zip(p.U_LIMITS[:-1], p.U_LIMITS[1:], strict=True)]
    for short in LAWS:
        half = float(p.U_TOTAL) * np.diff(law(short)(scale=p.U_SD).cdf(p.U_LIMITS))
        for k, (name, printed, ours) in enumerate(zip(names, p.U_EXPECTED[short], half, strict=True)):
            slip = k == 6 or (short == "normal" and k in (5, 7))  # z = 1.7360 is wrong: it parts classes 5 and 6
            reason = SLIP if slip else ROUNDED if short == "normal" else TABLES
            rows.append(row((name, f"T {short}"), None if np.isnan(printed) else printed, float(ours), 2, reason))
    squares = float((p.U_POSITIVE + p.U_NEGATIVE) @ p.U_MIDS**2)
    first = float((p.U_POSITIVE - p.U_NEGATIVE) @ p.U_MIDS)
    rows += [
        row(("all", "sum F"), p.U_TOTAL, float(np.sum(p.U_POSITIVE + p.U_NEGATIVE)), 0),
        row(("all", "sum F t"), -1.9, first, 1, SLIP),
        row(("all", "sum F t^2"), p.U_SQUARES, squares, 0, SLIP),
        row(("all", "S_o (um) from the printed sum"), p.U_SD, float(np.sqrt(p.U_SQUARES / p.U_TOTAL)), 2),
        row(("all", "S_o (um) from the class mids"), p.U_SD, float(np.sqrt(squares / p.U_TOTAL)), 2, SLIP),
        row(("all", "M_o (um) from the printed sum"), p.U_MEAN, -1.9 / p.U_TOTAL, 3),
        row(("12.25 to 14", "lower limit"), 11.25, 12.25, 2, SLIP, "both halves; 12.25 is what z belongs to"),
        row(
            ("12.25 to 14", "T normal, upper half"),
            2.39,
            float(p.U_TOTAL * np.diff(law("normal")(scale=p.U_SD).cdf([12.25, 14.0]))[0]),
            2,
            SLIP,
        ),
        row(("-5.25 to -3.5", "class mid"), -4.58, -4.38, 2, SLIP),
        row(("14 to 17.5", "F t^2, upper half"), 922.25, 4 * 15.75**2, 2, SLIP),
    ]
    note = (
        "U, 298 residuals of image coordinates; two values above 21 um and some below -21 are outside. T = 298 P for one half, mean 0, "
        "S_o = 5.92 (the printed table is symmetric)."
    )
    return Comparison("table-5", "Table 5: U with S_o", ("limit or class (um)", "quantity"), tuple(rows), note)


def u_classes(merged: int = 0) -> tuple[Floats, Floats]:
    """Return counts and limits of U, with the outermost classes of each side merged a number of times.

    Parameters
    ----------
    merged : int
        Merges a side: 0, 1, 2 leave 20, 18, 16 classes.

    Returns
    -------
    counts : (k,) array
    limits : (k+1,) array, um

    Examples
    --------
    >>> [len(u_classes(k)[0]) - 3 for k in (2, 1, 0)]
    [13, 15, 17]
    """
    f = np.concatenate([p.U_NEGATIVE[::-1], p.U_POSITIVE])
    b = np.concatenate([-p.U_LIMITS[:0:-1], p.U_LIMITS])
    for _ in range(merged):
        f = np.concatenate([[f[0] + f[1]], f[2:-2], [f[-2] + f[-1]]])
        b = np.concatenate([b[:1], b[2:-2], b[-1:]])
    return f, b


def _table_6() -> Comparison:
    rows: list[Row] = []
    choices: tuple[tuple[str, Ends], ...] = (("open", "open"), ("closed", "closed"))
    for merged, df in ((2, 13), (1, 15), (0, 17)):
        counts, limits = u_classes(merged)
        for short in LAWS:
            printed = p.U_CHI2[df].get(short)
            for label, ends in choices:
                found = _judged(counts, limits, short, ends, float(p.U_TOTAL), p.U_MEAN, p.U_SD)
                assert found.df == df and found.statistic is not None  # noqa: S101
                rows.append(row((f"{df}", short, label, "chi-square"), printed, found.statistic, 2, ENDS))
                verdict = None if printed is None else "reject" if printed > p.U_CRITICAL[df] else "accept"
                rows.append(row((f"{df}", short, label, "decision"), verdict, _decision(found.rejected), 2, ENDS))
        rows.append(row((f"{df}", "all", "", "critical value"), p.U_CRITICAL[df], float(special.chdtri(df, 0.05)), 2))
    note = (
        "Chi-square of U with M_o = -0.006, S_o = 5.92; 17 degrees of freedom: all 20 classes; 15 and 13: one and two merges on either "
        "side. The printed normal values stem from the wrong limit of Table 5, the modulated ones from tables of the time besides."
    )
    return Comparison("table-6", "Table 6: laws for U", ("degrees of freedom", "law", "ends", "quantity"), tuple(rows), note)


def _appendix() -> Comparison:
    rows: list[Row] = []
    for name, (s, df, pooled, theta, critical) in p.SETS.items():
        variances = np.square(np.array(s, dtype=float))
        plain, corrected = bartlett(variances, df, corrected=False), bartlett(variances, df)
        natural = float(np.asarray(plain.statistic))
        ours = float(plain.details["pooled_variance"])
        literal = float(df * np.sum(np.log(ours) - np.log(np.array(s, dtype=float))))
        rows += [
            row((name, "pooled variance (um^2)"), pooled, ours, 1, INPUT),
            row((name, "theta, natural logarithm of S_i^2"), theta, natural, 2, LOGARITHM),
            row((name, "theta / C, Bartlett's correction"), None, float(np.asarray(corrected.statistic)), 3),
            row((name, "theta, decimal logarithm"), theta, natural / float(np.log(10.0)), 2, INPUT),
            row((name, "theta, log of S_i as A-2 prints"), theta, literal, 2, SLIP),
            row(
                (name, f"critical value, {len(s) - 1} degrees of freedom"),
                critical,
                float(np.asarray(plain.critical)),
                3 if critical < 16 else 2,
                SLIP,
            ),
            row((name, "decision, natural logarithm"), "accept", _decision(bool(plain.rejected))),
            row((name, "decision, corrected"), "accept", _decision(bool(corrected.rejected))),
        ]
        each = variance_per_image(variances, df, reference=ours)
        rows.append(row((name, "sets whose variance differs from the pooled one, chi-square"), 0, float(np.sum(each.rejected)), 0))
        exact = variance_per_image(variances, df)
        rows.append(row((name, "sets whose variance differs from the pooled one, exact law"), 0, float(np.sum(exact.rejected)), 0))
    note = "Bartlett's test of equal variances from the printed S_i; equal variances are not rejected in any reading but the literal A-2."
    return Comparison("appendix-1", "Appendix 1: homogeneity", ("sets", "quantity"), tuple(rows), note)


def _text() -> Comparison:
    normal = law("normal")().pdf(0.0)
    rows = [row((f"peak of {name} over the normal",), printed, law(name)().pdf(0.0) / normal, 2) for name, printed in p.PEAKS.items()]
    practically = law("modulated_normal")(a=3.0).pdf(0.0) / normal
    rows.append(row(("peak of a = 3 over the normal ('practically normal')",), None, practically, 3))
    return Comparison("laws", "The modulated laws", ("quantity",), tuple(rows), "Density at the centre for equal standard deviation.")


def _beyond() -> Comparison:
    """What the paper does not compute: the law with a free."""
    rows = []
    for choice, counts, ends, total in (_V_CHOICES[0], _V_CHOICES[2]):
        found = fit_classes(counts, p.V_LIMITS, "modulated_normal", ends=ends, total=total)
        for key, name in (("a", "a"), ("loc", "mean (um)"), ("scale", "standard deviation (um)")):
            rows.append(row(("V", choice, name), None, found.parameters[key], 3))
        rows.append(row(("V", choice, f"chi-square, {found.df} degrees of freedom"), None, float(found.statistic or 0.0), 2))
    note = "Modulated normal law with mean, standard deviation and a all free, by minimum chi-square on the classes. Not in the paper."
    return Comparison("free-law", "Beyond the paper: a of V by minimum chi-square", ("data", "classes", "quantity"), tuple(rows), note)


def _figures(fits: dict[tuple[str, str], Fit]) -> tuple[Figure, ...]:
    u, u_limits = u_classes()
    v = (p.V_COUNTS, p.V_LIMITS, float(p.V_TOTAL), "residual V", "um")
    what = (
        ("1", "Normal curve for V using S_o", v, fits["normal S_o", PLAIN].distribution, "normal, S_o = 7.92"),
        ("2", "Lineo-normal curve for V", v, fits["lineo", PLAIN].distribution, "lineo, S_o = 7.92"),
        ("3", "Radico-normal curve for V", v, fits["radico", PLAIN].distribution, "radico, S_o = 7.92"),
        ("4", "Normal curve for V using S_M", v, fits["normal S_M", PLAIN].distribution, "normal, S_M = 7.19"),
        ("5", "Normal curve for V using Q_v", (p.QV_COUNTS, p.QV_LIMITS, 630.0, "V / (s0 sqrt q)", ""), law("normal")(), "standard normal"),
        (
            "6",
            "Normal curve for U",
            (u, u_limits, 298.0, "residual U", "um"),
            law("normal")(loc=p.U_MEAN, scale=p.U_SD),
            "normal, S_o = 5.92",
        ),
        (
            "7",
            "Lineo-normal curve for U",
            (u, u_limits, 298.0, "residual U", "um"),
            law("lineo")(loc=p.U_MEAN, scale=p.U_SD),
            "lineo, S_o = 5.92",
        ),
        (
            "8",
            "Radico-normal curve for U",
            (u, u_limits, 298.0, "residual U", "um"),
            law("radico")(loc=p.U_MEAN, scale=p.U_SD),
            "radico, S_o = 5.92",
        ),
    )
    made = []
    for number, title, (counts, limits, total, label, unit), curve, legend in what:
        name = f"figure-{number}"
        svg = class_histogram(name, counts, limits, [(legend, curve)], total, label, unit)
        peak = float((counts / np.diff(limits)).max())
        centre = total * float(curve.pdf(curve.loc))
        per = f"values per {unit or 'unit'}"
        alt = f"Histogram of {len(counts)} classes, highest {peak:.1f} {per}, with the curve of the {legend} law, highest {centre:.1f}."
        made.append(
            Figure(
                name, f"Figure {number}: {title}", f"Class counts divided by the class width, and {total:.0f} times the density.", alt, svg
            )
        )
    return tuple(made)


def _sentences(tables: dict[str, Comparison]) -> list[str]:
    decisions = [r for r in tables["table-4"].rows if r.labels[-1] == "decision"]
    good = sum(r.agrees for r in decisions)
    bad = sorted({(r.labels[1], r.labels[0]) for r in tables["table-6"].rows if r.labels[-1] == "decision" and not r.agrees})
    which = " and ".join(f"{name} at {df} degrees of freedom" for name, df in bad) or "none"
    lineo = [tables["table-6"].value("17", "lineo", ends, "chi-square") for ends in ("open", "closed")]
    theta = [tables["appendix-1"].value(name, "theta, natural logarithm of S_i^2") for name in p.SETS]
    corrected = [tables["appendix-1"].value(name, "theta / C, Bartlett's correction") for name in p.SETS]
    least, mean, sd = (tables["table-4"].value("normal S_P", PLAIN, key) for key in ("chi-square", "M_P (um)", "S_P (um)"))
    printed = [r for c in tables.values() for r in c.rows if r.printed is not None]
    why = Counter(r.reason.code for r in printed if r.reason is not None)
    return [
        f"{sum(r.agrees for r in printed)} of {len(printed)} printed values are met to the last digit; the others carry their reasons "
        f"({', '.join(f'{code} {n}' for code, n in why.most_common())}).",
        f"Table 4: {good} of {len(decisions)} decisions, in all treatments of the classes, are those of the paper: normal with S_o is "
        "rejected; lineo, radico and normal with S_M, Q_v or S_P are accepted.",
        f"Table 6: decisions that differ, with open ends as with closed ones: {which}. Lineo at 17: chi-square {lineo[0]:.2f} (open) and "
        f"{lineo[1]:.2f} (closed) against the limit 27.59, rejected; the paper has 26.80 and accepts.",
        f"Bartlett: theta = {theta[0]:.3f} and {theta[1]:.3f} ({corrected[0]:.3f} and {corrected[1]:.3f} corrected), printed 2.84 twice; "
        "equal variances are accepted either way.",
        f"The least chi-square of a normal law for V is {least:.2f} at M = {mean:.3f}, S = {sd:.3f} um (629 values, closed classes).",
        "The Fisher ratios of chi-squares are descriptive: the values come from one sample and are not independent.",
    ]


def reproduce() -> Reproduction:
    """Recompute the tables, the appendix and the figures, and carry out the study on simulated measurements.

    Returns
    -------
    Reproduction

    Notes
    -----
    A. Maarek, G. Konecny, Modulated Normal Distribution, Photogrammetric Engineering.

    Examples
    --------
    >>> _table_4(_v_fits()).value("normal S_P", "629 values, closed", "chi-square")
    14.39
    """
    from baarda.papers._maarek_konecny_study_report import report
    from baarda.papers.maarek_konecny_study import study

    fits = _v_fits()
    own = (_text(), _appendix(), _table_1(), _table_2(), _table_3(), _table_4(fits), _fisher(fits), _table_5(), _table_6())
    more, figures, said = report(study())
    sentences = (*_sentences({c.table: c for c in own}), *said)
    return Reproduction((*own, _beyond(), *more), (*_figures(fits), *figures), sentences, NAME, TITLE, REFERENCE)


paper = Paper(NAME, TITLE, REFERENCE, reproduce)
