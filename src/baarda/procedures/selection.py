"""Stepwise deletion of parameters: F proposes, criteria decide, correlated pairs are judged together, a parameter may return."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import linalg, special

from baarda.errors import RedundancyNotPositive, Singular, UsageError
from baarda.hypotheses.levels import Policy, applied_level, check_level
from baarda.hypotheses.parameters import bivariate_parameters
from baarda.procedures.criteria import NAMES, SECOND_SPOKEN, SPOKEN, Criterion, Fitted, Second, criteria

Floats = NDArray[np.float64]

#: Wu's three criteria decide; the others are told.
DECIDING: tuple[Criterion, ...] = ("variance_factor", "criterion_b", "aic")


@dataclass(frozen=True)
class SelectionOptions:
    """How parameters are selected.

    Attributes
    ----------
    alpha : float
        Level of the F test that proposes a deletion.
    levels : str
        Policy over the parameters of a step; see `baarda.hypotheses.levels.Options`.
    known_variance : bool
        Judge by sigma0^2 (chi-square) instead of s0^2 (F).
    second : {"variance", "s", "j", "trace"}
        Reading of criterion 9b.
    deciding : tuple of str
        Criteria of which at least one must fall, or the deletion does not stand; empty: the F test alone decides.
    correlation_limit : float
        Pairs correlated so highly are judged by the bivariate test before one of them is deleted.
    """

    alpha: float = 0.05
    levels: Policy = "none"
    known_variance: bool = False
    second: Second = "variance"
    deciding: tuple[Criterion, ...] = DECIDING
    correlation_limit: float = 0.95

    def __post_init__(self) -> None:
        check_level(self.alpha)
        if self.second not in SECOND_SPOKEN:
            raise UsageError(f"criterion 9b is one of {', '.join(SECOND_SPOKEN)}, not {self.second!r}")
        for name in self.deciding:
            if name not in NAMES:
                raise UsageError(f"unknown criterion {name!r}; known are {', '.join(NAMES)}")
        if not 0.0 <= self.correlation_limit < 1.0:
            raise UsageError(f"correlation_limit must lie in [0, 1), not {self.correlation_limit}")


@dataclass(frozen=True)
class Fit:
    """A fitted model as the selection sees it.

    Attributes
    ----------
    names : tuple of str
        Parameters of the model that may be deleted.
    values, cofactors : (k,), (k, k) arrays
    unknowns : int
    fitted : Fitted
    entering : mapping of str to float
        For each deleted parameter the F that it would have in the model, by one linear step.
    payload : object
        What the model wants back (an adjustment).
    """

    names: tuple[str, ...]
    values: Floats
    cofactors: Floats
    unknowns: int
    fitted: Fitted
    entering: dict[str, float] = field(default_factory=dict)
    payload: Any = None


class Model(Protocol):
    """What can be fitted without some of its parameters."""

    def fit(self, deleted: frozenset[str]) -> Fit:
        """Fit the model with these parameters held at zero."""


@dataclass(frozen=True)
class SelectionStep:
    """One step: a model, and how it came about.

    Attributes
    ----------
    step : int
    action : {"start", "deleted", "kept", "returned"}
        "kept": the deletion was tried and refused.
    parameter : str or None
    f_statistic, p_value : float or None
        Of the parameter in the model in which it is estimated.
    predicted_increase : float or None
        x^2 / q, by which v'Pv must rise; `increase` is by how much it rose.
    increase : float or None
    unknowns : int
    objective : float
    redundancy : int
    criteria : dict
        See `baarda.procedures.criteria.criteria`.
    fell : tuple of str
        Criteria that fell against the model before.
    pair : dict or None
        The correlated partner: ``partner``, ``correlation``, ``f_statistic``, ``p_value``, ``rejected``.
    note : str
    """

    step: int
    action: str
    parameter: str | None
    f_statistic: float | None
    p_value: float | None
    predicted_increase: float | None
    increase: float | None
    unknowns: int
    objective: float
    redundancy: int
    criteria: dict[str, float | None]
    fell: tuple[str, ...]
    pair: dict[str, Any] | None
    note: str

    def as_dict(self) -> dict[str, Any]:
        """Return the row of `result.json`."""
        return {
            "step": self.step,
            "action": self.action,
            "stands": self.action != "kept",
            "dropped": self.parameter if self.action in ("deleted", "kept") else None,
            "returned": self.parameter if self.action == "returned" else None,
            "f_statistic": self.f_statistic,
            "p_value": self.p_value,
            "unknowns": self.unknowns,
            **self.criteria,
            "objective": self.objective,
            "redundancy": self.redundancy,
            "increase": self.increase,
            "predicted_increase": self.predicted_increase,
            "fell": list(self.fell),
            "pair": self.pair,
            "note": self.note,
        }


@dataclass(frozen=True)
class Selection:
    """The outcome of a selection.

    Attributes
    ----------
    steps : tuple of SelectionStep
    deleted : tuple of str
        In the order of their (last) deletion.
    fit : Fit
        Of the selected model.
    options : SelectionOptions
    stopped : str
        Why it ended, a sentence.
    """

    steps: tuple[SelectionStep, ...]
    deleted: tuple[str, ...]
    fit: Fit
    options: SelectionOptions
    stopped: str


def select(model: Model, options: SelectionOptions | None = None) -> Selection:
    """Delete insignificant parameters one by one, the least significant first, and refit each time.

    Parameters
    ----------
    model : Model
    options : SelectionOptions, optional

    Returns
    -------
    Selection
        A deletion proposed by the F test stands while at least one deciding criterion falls. A parameter whose F in the smaller model
        becomes significant returns. Of a highly correlated pair that is significant together one parameter stays.

    Notes
    -----
    Wu, Liu & Lin (2000), eq. 8-9 and their strategy; Grün (1978) eq. 43 for pairs. With v'Pv, n and u alone each criterion falls exactly
    where F is below a threshold (`criteria.falls_below`), so a refused deletion ends the search.
    """
    o = SelectionOptions() if options is None else options
    return _Search(model, o).run()


class _Search:
    """The state of one search."""

    def __init__(self, model: Model, options: SelectionOptions) -> None:
        self.model, self.o = model, options
        self.deleted: list[str] = []
        self.fit = model.fit(frozenset())
        self.visited: set[frozenset[str]] = {frozenset()}
        self.protected: dict[str, str] = {}  # parameter -> the deleted partner that it stands for
        self.steps: list[SelectionStep] = []

    def run(self) -> Selection:
        self._note("start", None, None, None, self.fit, (), None, "" if self.fit.names else "There are no parameters to select.")
        stopped = ""
        while not stopped:
            if not self._return_one():
                stopped = self._delete_one()
        return Selection(tuple(self.steps), tuple(self.deleted), self.fit, self.o, stopped)

    # ---- tests ----
    def _scale(self, fit: Fit) -> tuple[float, float]:
        """Return the variance factor that judges and its redundancy."""
        if self.o.known_variance:
            return 1.0, np.inf
        return fit.fitted.objective / fit.fitted.redundancy, float(fit.fitted.redundancy)

    def _p(self, f: Any, redundancy: float) -> Any:
        return special.chdtrc(1.0, f) if np.isinf(redundancy) else special.fdtrc(1.0, redundancy, f)

    def _note(
        self,
        action: str,
        name: str | None,
        f: float | None,
        p: float | None,
        fit: Fit,
        fell: tuple[str, ...],
        pair: dict[str, Any] | None,
        note: str,
        increase: tuple[float | None, float | None] = (None, None),
    ) -> None:
        values = criteria(fit.fitted, self.o.second)
        r, omega = fit.fitted.redundancy, fit.fitted.objective
        self.steps.append(SelectionStep(len(self.steps), action, name, f, p, *increase, fit.unknowns, omega, r, values, fell, pair, note))

    def _fell(self, before: Fit, after: Fit) -> tuple[str, ...]:
        old, new = criteria(before.fitted, self.o.second), criteria(after.fitted, self.o.second)
        return tuple(k for k in old if old[k] is not None and new[k] is not None and new[k] < old[k])  # type: ignore[operator]

    # ---- moves ----
    def _return_one(self) -> bool:
        """Let the most significant deleted parameter return, if it is significant now; return whether one did."""
        redundancy = np.inf if self.o.known_variance else float(self.fit.fitted.redundancy - 1)
        if not self.fit.entering or redundancy < 1:
            return False
        names = sorted(self.fit.entering, key=lambda k: -self.fit.entering[k])
        p = np.array([float(self._p(self.fit.entering[k], redundancy)) for k in names])
        level = applied_level(p, self.o.alpha, self.o.levels)
        for name, value in zip(names, p, strict=True):
            smaller = frozenset(self.deleted) - {name}
            if value > level or smaller in self.visited:
                continue
            trial = self.model.fit(smaller)
            s2, r = self._scale(trial)
            i = trial.names.index(name)
            f = float(trial.values[i] ** 2 / (trial.cofactors[i, i] * s2))
            exact = float(self._p(f, r))
            self.visited.add(smaller)
            if exact > level:
                continue
            fell = self._fell(self.fit, trial)
            change = (-f * s2, trial.fitted.objective - self.fit.fitted.objective)
            self.deleted.remove(name)
            self.protected = {k: v for k, v in self.protected.items() if v != name}
            self.fit = trial
            self._note("returned", name, f, exact, trial, fell, None, "Significant again in the smaller model.", change)
            return True
        return False

    def _delete_one(self) -> str:
        """Try to delete the least significant parameter; return why the search ends, or an empty text."""
        fit = self.fit
        if not fit.names:
            return "No parameter is left to delete." if self.deleted else "There are no parameters to select."
        s2, r = self._scale(fit)
        f = fit.values**2 / (np.diagonal(fit.cofactors) * s2)
        p = np.asarray(self._p(f, r), dtype=float)
        level = applied_level(p, self.o.alpha, self.o.levels)
        order = [int(i) for i in np.argsort(f, kind="stable") if p[i] > level]
        if not order:
            return f"All remaining parameters are significant at level {level:.3g}."
        spared = [fit.names[i] for i in order if fit.names[i] in self.protected]
        order = [i for i in order if fit.names[i] not in self.protected and frozenset([*self.deleted, fit.names[i]]) not in self.visited]
        if not order:
            kept = ", ".join(f"{k} (for {self.protected[k]})" for k in spared)
            return f"The others are significant; kept as the one of a significant pair: {kept}." if spared else "No model is left to try."
        i = order[0]
        name = fit.names[i]
        pair, note = self._pair(fit, i, s2, r, p, level)
        trial = self.model.fit(frozenset([*self.deleted, name]))
        self.visited.add(frozenset([*self.deleted, name]))
        fell = self._fell(fit, trial)
        change = (float(f[i] * s2), trial.fitted.objective - fit.fitted.objective)
        stands = not self.o.deciding or any(k in fell for k in self.o.deciding)
        if not stands:
            told = ", ".join(SPOKEN[k] for k in self.o.deciding)
            self._note("kept", name, float(f[i]), float(p[i]), trial, fell, pair, f"{note} No deciding criterion fell.".strip(), change)
            return f"Deleting {name} makes none of {told} smaller: it stays, and the search ends."
        self.deleted.append(name)
        if pair is not None and pair["rejected"] and not pair["partner_significant"]:
            self.protected[pair["partner"]] = name
        self.fit = trial
        self._note("deleted", name, float(f[i]), float(p[i]), trial, fell, pair, note, change)
        return ""

    def _pair(self, fit: Fit, i: int, s2: float, r: float, p: Floats, level: float) -> tuple[dict[str, Any] | None, str]:
        """Judge the parameter together with its most correlated partner, where their correlation reaches the limit."""
        s = np.sqrt(np.diagonal(fit.cofactors))
        rho = fit.cofactors[i] / (s[i] * s)
        rho[i] = 0.0
        j = int(np.argmax(np.abs(rho)))
        if len(s) < 2 or abs(rho[j]) < self.o.correlation_limit:
            return None, ""
        at = [i, j]
        words = (fit.names[i], fit.names[j])
        found: dict[str, Any] = {"partner": words[1], "correlation": float(rho[j]), "partner_significant": bool(p[j] <= level)}
        try:
            t = bivariate_parameters(fit.values[at], fit.cofactors[np.ix_(at, at)], s2, r, 0.0, level, "none", words)
        except Singular:
            return {
                **found,
                "f_statistic": None,
                "p_value": None,
                "rejected": False,
            }, f"{words[0]} and {words[1]} are perfectly correlated: one takes over all of the other."
        rejected = bool(np.asarray(t.rejected)[0])
        found |= {"f_statistic": float(np.asarray(t.statistic)[0]), "p_value": float(np.asarray(t.p_value)[0]), "rejected": rejected}
        if not rejected:
            return found, f"Neither is significant together with {words[1]}."
        if found["partner_significant"]:
            return found, f"The pair is significant by {words[1]} alone."
        return found, f"The pair is significant, neither parameter alone: {words[1]} stays for both."


# ---- plain design matrices ----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class LinearModel:
    """A linear model l + v = A x whose columns may be deleted.

    Attributes
    ----------
    design : (n, u) array
        Whitened.
    observed : (n,) array
        Whitened.
    names : tuple of str
        Of all columns.
    candidates : tuple of str
        Columns that may be deleted.
    check : pair of arrays or None
        (p, u) functions of x and their (p,) reference values.
    """

    design: Floats
    observed: Floats
    names: tuple[str, ...]
    candidates: tuple[str, ...]
    check: tuple[Floats, Floats] | None = None

    def fit(self, deleted: frozenset[str]) -> Fit:
        """Fit by QR without the deleted columns."""
        kept = [i for i, name in enumerate(self.names) if name not in deleted]
        gone = [i for i, name in enumerate(self.names) if name in deleted]
        n, u = self.design.shape[0], len(kept)
        if n <= u:
            raise RedundancyNotPositive(f"{n} observations for {u} unknowns")
        a = self.design[:, kept]
        size = np.linalg.norm(a, axis=0)
        size[size == 0.0] = 1.0
        basis, upper = np.linalg.qr(a / size)
        pivots = np.abs(np.diagonal(upper))
        if u and pivots.min() < 1e-12 * pivots.max():
            weak = [self.names[kept[i]] for i in np.flatnonzero(pivots < 1e-12 * pivots.max())]
            raise Singular(f"columns of the design matrix depend on each other: {', '.join(weak)}", weak)
        inverse = linalg.solve_triangular(upper, np.eye(u)) / size[:, None]
        x = inverse @ (basis.T @ self.observed)
        e = self.observed - basis @ (basis.T @ self.observed)
        omega, r = float(e @ e), n - u
        entering = {}
        for j in gone:
            rest = self.design[:, j] - basis @ (basis.T @ self.design[:, j])
            share = float(rest @ rest)
            if r > 1 and share > 1e-20 * float(self.design[:, j] @ self.design[:, j]):
                gain = float(rest @ e) ** 2 / share
                entering[self.names[j]] = gain / ((omega - gain) / (r - 1))
        q = inverse @ inverse.T
        rms = None
        if self.check is not None:
            d = self.check[0][:, kept] @ x - self.check[1]
            rms = float(np.sqrt(np.mean(d * d)))
        at = [i for i, k in enumerate(kept) if self.names[k] in self.candidates]
        trace = omega / r * float(np.trace(q))
        fitted = Fitted(omega, n, r, trace, rms)
        return Fit(tuple(self.names[kept[i]] for i in at), x[at], q[np.ix_(at, at)], u, fitted, entering, x)


def select_columns(
    design: ArrayLike,
    observed: ArrayLike,
    candidates: Sequence[int | str] | None = None,
    covariance: ArrayLike | None = None,
    names: Sequence[str] = (),
    check: tuple[ArrayLike, ArrayLike] | None = None,
    **options: Any,
) -> Selection:
    """Select the columns of a linear model.

    Parameters
    ----------
    design : (n, u) array
        Design matrix A.
    observed : (n,) array
        Observations l.
    candidates : sequence of int or str, optional
        Columns that may be deleted, by index or name; all without it.
    covariance : (n,) or (n, n) array, optional
        Covariance of the observations, or their variances; absent: unit weights.
    names : sequence of str
        Names of the columns; "x1", "x2", ... without them.
    check : pair of arrays, optional
        (p, u) functions of x and (p,) reference values: the check-point error.
    **options
        Fields of `SelectionOptions`.

    Returns
    -------
    Selection

    Raises
    ------
    UsageError
        If shapes or names do not fit.
    Singular
        If columns depend on each other.
    RedundancyNotPositive
        If there are not more observations than columns.

    Notes
    -----
    Wu, Liu & Lin (2000).

    Examples
    --------
    >>> t = np.linspace(-1.0, 1.0, 9)
    >>> noise = np.array([0.1, -0.2, 0.15, 0.05, -0.1, -0.05, 0.2, -0.1, -0.05])
    >>> select_columns(np.vander(t, 4, increasing=True), 1.0 + 3.0 * t + noise, names=["a0", "a1", "a2", "a3"]).deleted
    ('a2', 'a3')
    """
    a, l_ = np.atleast_2d(np.asarray(design, dtype=float)), np.asarray(observed, dtype=float)
    n, u = a.shape
    if l_.shape != (n,):
        raise UsageError(f"{l_.shape} observations for {n} rows")
    words = tuple(names) or tuple(f"x{i + 1}" for i in range(u))
    if len(words) != u or len(set(words)) != u:
        raise UsageError(f"{len(words)} names for {u} columns, or a name twice")
    if candidates is None:
        chosen = words
    else:
        unknown = [c for c in candidates if (c not in words if isinstance(c, str) else not 0 <= c < u)]
        if unknown:
            raise UsageError(f"no column {unknown[0]!r}")
        chosen = tuple(c if isinstance(c, str) else words[c] for c in candidates)
    if covariance is not None:
        c = np.asarray(covariance, dtype=float)
        if c.ndim == 1:
            root = np.sqrt(c)
            a, l_ = a / root[:, None], l_ / root
        else:
            lower = np.linalg.cholesky(c)
            a, l_ = linalg.solve_triangular(lower, a, lower=True), linalg.solve_triangular(lower, l_, lower=True)
    checked = None if check is None else (np.atleast_2d(np.asarray(check[0], dtype=float)), np.asarray(check[1], dtype=float))
    return select(LinearModel(a, l_, words, chosen, checked), SelectionOptions(**options))
