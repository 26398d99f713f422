"""Section of a case from its records: errors against seconds, fitted orders, recommended settings."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from statistics import median
from typing import Any

from ..report_section import (
    Claim,
    CostPoint,
    Plot,
    ReportTable,
    Section,
    Series,
    TableCell,
    cheapest_point,
    fitted_order,
    pareto_front,
    rerun_hint,
)
from ..trial import Setting

Records = list[dict[str, Any]]
Errors = Callable[[Records], dict[str, dict[str, float]]]

ORDER_TOLERANCE = 0.2  # of a theoretical order
TIMING_NOISE = 1.25  # differences in time below this factor are noise
TIMED_RUNS = 3  # runs of two settings if the default seems more expensive by more than that
ERROR_LIMITS = (0.05, 0.01)


@dataclass(frozen=True)
class ExpectedOrder:
    """Expected order of convergence over some trials: error = C variable^theory.

    Attributes:
        error: name of the error.
        variable: key of the settings.
        theory: exponent.
        names: trials in the asymptotic range.
        of: description of the fit, if the error's name is not enough.
        least: `theory` is a lower bound.
    """

    error: str
    variable: str
    theory: float
    names: tuple[str, ...]
    of: str = ""
    least: bool = False


@dataclass(frozen=True)
class AccuracyCase:
    """Description of how the records of a case become a section.

    Attributes:
        name: name of the case in its records.
        title: title of the section.
        text: records -> text of the section.
        columns: settings shown in the table.
        compare: records -> trial name -> error name -> relative error.
        errors: names of errors; the first one is the target.
        orders: expected orders of convergence.
        split: setting whose values are series of the plots.
        excluded: values of settings that cannot be defaults (explicit steps, a Newton step without a test).
        limit_share: share of an error limit that the case may use; less than 1 if mesh and step add their errors.
        claims: records -> further claims.
        compare_cost: compare the cost of errors; False if the settings are unrelated bodies.
        figures: measured figures that the table shows beside the errors.
    """

    name: str
    title: str
    text: Callable[[Records], str]
    columns: tuple[str, ...]
    compare: Errors
    errors: tuple[str, ...]
    orders: tuple[ExpectedOrder, ...] = ()
    split: str = ""
    excluded: tuple[Setting, ...] = ()
    limit_share: float = 1.0
    claims: Callable[[Records], tuple[Claim, ...]] = lambda records: ()
    compare_cost: bool = True
    figures: tuple[str, ...] = ()


@dataclass(frozen=True)
class AccuracyRow:
    """A trial in the table, with its relative errors."""

    record: dict[str, Any]
    errors: dict[str, float]

    @property
    def wall(self) -> float:
        """Wall time of the whole process, s."""
        return median(self.record["wall"])

    @property
    def core_seconds(self) -> float:
        """Processor seconds of all ranks in the time steps; for a script, seconds of its work.

        Processor time depends less on other load of the machine than wall time times ranks.
        """
        return median(self.record["cpu"] or [self.record["figures"].get("seconds", 0.0)])


def trial_figure(records: Records, name: str, key: str) -> float:
    """Figure of one trial.

    Raises:
        KeyError: the figure was not measured.
    """
    figures: dict[str, float] = next((record["figures"] for record in records if record["name"] == name), {})
    if key not in figures:
        raise KeyError(f"{name} has no {key}")
    return float(figures[key])


def relative_error(value: float, exact: float) -> float:
    """|value / exact - 1|."""
    return abs(value / exact - 1)


def measured_errors(*keys: str) -> Errors:
    """Function that returns the errors that the measurement itself took against a closed form."""
    return lambda records: {
        record["name"]: {key: float(record["figures"][key]) for key in keys if key in record["figures"]}
        for record in records
    }


def section(case: AccuracyCase, records: Records) -> Section:
    """Section of a case; a section that says so if its reference is missing."""
    own_records = [record for record in records if record["case"] == case.name]
    try:
        errors, text = case.compare(own_records), case.text(own_records)
        claims = case.claims(own_records)
    except (KeyError, StopIteration) as error:
        return Section(
            case.title, f"Not run, or its reference is missing: {error}.", tables=(_outcome_table(case, own_records),)
        )
    rows = [AccuracyRow(record, errors.get(record["name"], {})) for record in own_records]
    advice, marked = _recommend(case, rows) if case.compare_cost else ([], [])
    orders = tuple(_order_claim(order, rows) for order in case.orders)
    tables = (_error_table(case, rows, marked),)
    words = f"{text}\n\n{_recommendation_text(advice, case)}" if case.compare_cost else text
    words += rerun_hint(own_records)
    return Section(case.title, words, (*orders, *claims, *_default_claims(case, advice)),
                   tables, _plots(case, rows))  # fmt: skip


def case_rows(case: AccuracyCase, records: Records) -> list[AccuracyRow]:
    """Trials of a case with their errors; empty if its reference is missing."""
    own_records = [record for record in records if record["case"] == case.name]
    try:
        errors = case.compare(own_records)
    except (KeyError, StopIteration):
        return []
    return [AccuracyRow(record, errors.get(record["name"], {})) for record in own_records]


def doubtful_trials(case: AccuracyCase, records: Records) -> set[str]:
    """Names of trials to time again: a default and a setting that seems cheaper by more than noise."""
    if not case.compare_cost or not (rows := case_rows(case, records)):
        return set()
    advice, _ = _recommend(case, rows)
    rivals = [
        row.record for item in advice if item.default is not None and not _costs_no_more(item.default, item.candidate)
        for row in (item.default, item.candidate) if row is not None
    ]  # fmt: skip
    return {record["name"] for record in rivals if 0 < len(record["cpu"]) < TIMED_RUNS}


# --- orders ---


def _order_claim(order: ExpectedOrder, rows: list[AccuracyRow]) -> Claim:
    """Claim that the fitted order agrees with theory."""
    chosen = [row for row in rows if row.record["name"] in order.names and order.error in row.errors]
    what = " ".join(word for word in (order.of, order.error) if word)
    words = f"at least {order.theory:.3g}" if order.least else f"{order.theory:.3g}"
    text = f"{what}: order {words} in {order.variable}, within {ORDER_TOLERANCE}"
    sizes = [float(row.record["settings"][order.variable]) for row in chosen]
    if len(set(sizes)) < 3:
        return Claim(text, "not run: fewer than three sizes", None)
    results = fitted_order(sizes, [row.errors[order.error] for row in chosen])
    measured = f"{results:.2f} from {order.variable} = {max(sizes):.3g} to {min(sizes):.3g} ({len(sizes)} runs)"
    return Claim(
        text,
        measured,
        results >= order.theory - ORDER_TOLERANCE if order.least else abs(results - order.theory) <= ORDER_TOLERANCE,
    )


# --- recommended settings ---


@dataclass(frozen=True)
class Recommendation:
    """Recommended setting for an error limit.

    Attributes:
        limit: relative error.
        chosen: the cheapest setting, or the cheapest default if it costs hardly more.
        candidate: the cheapest setting that could be a default.
        default: the cheapest setting with the program's defaults.
    """

    limit: float
    chosen: AccuracyRow | None
    candidate: AccuracyRow | None  # cheapest of those that could be defaults
    default: AccuracyRow | None  # cheapest of those with the program's defaults


def _recommend(case: AccuracyCase, rows: list[AccuracyRow]) -> tuple[list[Recommendation], list[int]]:
    """Recommendations for all limits, and the rows that they choose."""
    usable = [row for row in rows if is_comparable(case, row)]
    results = [_recommend_for_limit(case, usable, limit) for limit in ERROR_LIMITS]
    return results, sorted({rows.index(item.chosen) for item in results if item.chosen is not None})


def is_comparable(case: AccuracyCase, row: AccuracyRow) -> bool:
    """Return whether a run succeeded and is not a reference."""
    return row.record["outcome"] == "done" and case.errors[0] in row.errors and "elements" not in row.record["settings"]


def _recommend_for_limit(case: AccuracyCase, rows: list[AccuracyRow], limit: float) -> Recommendation:
    """Recommendation for one limit."""
    best = cheapest_row(case, rows, limit)
    candidate = cheapest_row(case, [row for row in rows if not _is_excluded(case, row)], limit)
    default = cheapest_row(case, [row for row in rows if is_default(row.record["settings"])], limit)
    chosen = default if default is not None and _costs_no_more(default, best) else best
    return Recommendation(limit, chosen, candidate, default)


def _costs_no_more(row: AccuracyRow, other: AccuracyRow | None) -> bool:
    """Return whether a row costs at most TIMING_NOISE times another."""
    return other is not None and row.core_seconds <= TIMING_NOISE * other.core_seconds


def _is_excluded(case: AccuracyCase, row: AccuracyRow) -> bool:
    """Return whether a row cannot be a default.

    Excluded are values named by the case, looser CG tolerances (they fail on slender bodies), and looser Newton
    tolerances (they accept the first guess on slivers; both in case "solver").
    """
    settings, known = row.record["settings"], defaults()
    if any(settings.get(key, 0.0) > known[key] for key in ("ksp_rtol", "snes_rtol")):
        return True
    return any(value in case.excluded for value in row.record["settings"].values() if isinstance(value, str))


def cheapest_row(case: AccuracyCase, rows: list[AccuracyRow], limit: float) -> AccuracyRow | None:
    """The cheapest row with an error of at most its share of a limit."""
    points = [
        CostPoint(row.core_seconds, row.errors[case.errors[0]], {"row": number}) for number, row in enumerate(rows)
    ]
    best = cheapest_point(points, limit * case.limit_share)
    return None if best is None else rows[int(best.settings["row"])]


def defaults() -> dict[str, Any]:
    """Default values of the settings that trials vary."""
    from ....solvers.linear_solver import DEFAULT_OPTIONS
    from ....solvers.preconditioner import GAMG_OPTIONS
    from ....study import PlasticitySettings, TimeSettings

    ours = {key: DEFAULT_OPTIONS[key] for key in ("ksp_type", "ksp_rtol", "snes_rtol", "snes_type")}
    fields = {key: TimeSettings.model_fields[key].default for key in ("scheme", "mass", "rho")}
    fields["update"] = PlasticitySettings.model_fields["update"].default
    return ours | fields | {"pc_type": GAMG_OPTIONS["pc_type"]}


def is_default(settings: dict[str, Any]) -> bool:
    """Return whether all settings that have a default are at it."""
    known = defaults()
    return all(value == known[key] for key, value in settings.items() if key in known)


def _recommendation_text(advice: list[Recommendation], case: AccuracyCase) -> str:
    """Recommendations and exclusions as text."""
    why = ""
    if case.limit_share < 1:
        why = f" The solver may take {case.limit_share:.0%} of a limit: errors of mesh and step come on top."
    if case.excluded:
        why += f" No candidate for a default: {', '.join(map(str, case.excluded))}."
    if "ksp_rtol" in case.columns:
        why += (
            " Nor is a looser CG, which fails on slender bodies (ksp-1e-3-slender among the solver settings), nor a "
            "looser Newton, which takes the first guess for the answer on slivers (snes-1e-4-slivers)."
        )
    return " ".join(_recommendation_sentence(item, case) for item in advice) + why


def _recommendation_sentence(advice: Recommendation, case: AccuracyCase) -> str:
    """Recommendation for one limit as text."""
    head = f"For {advice.limit:.0%} of {case.errors[0]}:"
    if advice.chosen is None:
        return f"{head} no setting here is good enough."
    row = advice.chosen
    return (
        f"{head} {describe_setting(row)} (error {row.errors[case.errors[0]]:.2g}, {row.core_seconds:.2g} core-seconds)."
    )


def describe_setting(row: AccuracyRow) -> str:
    """Settings of a row as text."""
    settings = row.record["settings"].items()
    return ", ".join(f"{key} = {f'{value:.4g}' if isinstance(value, float) else value}" for key, value in settings)


def _default_claims(case: AccuracyCase, advice: list[Recommendation]) -> tuple[Claim, ...]:
    """Claims that the default is the recommended setting, if the case varies a setting with a default."""
    known = defaults()
    if not any(column in known for column in case.columns):
        return ()
    return tuple(_default_claim(case, item) for item in advice)


def _default_claim(case: AccuracyCase, advice: Recommendation) -> Claim:
    """Claim that the default is the recommended setting for one limit."""
    text = f"{case.title}: what is recommended for {advice.limit:.0%} of {case.errors[0]} is the program's default"
    if advice.candidate is None:
        return Claim(text, "no setting reaches it", None)
    best = f"cheapest: {describe_setting(advice.candidate)}, {advice.candidate.core_seconds:.3g} core-seconds"
    if advice.default is None:
        return Claim(text, f"{best}; the default does not reach it here", False)
    runs = min(len(row.record["cpu"]) for row in (advice.candidate, advice.default))
    medians = f", medians of {runs}" if runs > 1 else ""
    measured = f"{best}; default: {describe_setting(advice.default)}, {advice.default.core_seconds:.3g}{medians}"
    holds = _costs_no_more(advice.default, advice.candidate)
    return Claim(text, f"{measured} (a factor below {TIMING_NOISE:g} is noise)", holds)


# --- table and plots ---


def _error_table(case: AccuracyCase, rows: list[AccuracyRow], marked: list[int]) -> ReportTable:
    """Table of errors and times."""
    front = _pareto_rows(case, rows)
    columns = ("trial", *case.columns, "ranks", *(f"error of {name}" for name in case.errors), *case.figures,
               "wall s", "core-seconds", "front", "outcome")  # fmt: skip
    caption = f"{case.title}: relative errors and times. Marked: recommended for 5 % and 1 %; *: on the front."
    cells = tuple(_table_cells(case, row, number in front) for number, row in enumerate(rows))
    return ReportTable(f"precision-{case.name}", caption, columns, cells, marked=tuple(marked))


def _table_cells(case: AccuracyCase, row: AccuracyRow, best: bool) -> tuple[TableCell, ...]:
    """Cells of a row."""
    record = row.record
    settings = (record["settings"].get(key) for key in case.columns)
    errors = (row.errors.get(name) for name in case.errors)
    figures = (record["figures"].get(name) for name in case.figures)
    return (record["name"], *settings, record["ranks"], *errors, *figures, row.wall, row.core_seconds,
            "*" if best else "", record["outcome"])  # fmt: skip


def _outcome_table(case: AccuracyCase, records: Records) -> ReportTable:
    """Table of outcomes and messages, for a case without reference."""
    rows = tuple((record["name"], record["outcome"], record["message"]) for record in records)
    return ReportTable(f"precision-{case.name}", case.title, ("trial", "outcome", "message"), rows)


def _pareto_rows(case: AccuracyCase, rows: list[AccuracyRow]) -> set[int]:
    """Numbers of the Pareto-optimal rows."""
    numbers = [number for number, row in enumerate(rows) if is_comparable(case, row)]
    points = [(rows[number].core_seconds, rows[number].errors[case.errors[0]]) for number in numbers]
    return {numbers[place] for place in pareto_front(points)}


def _plots(case: AccuracyCase, rows: list[AccuracyRow]) -> tuple[Plot, ...]:
    """Plots of the error over wall time and core-seconds."""
    usable = [row for row in rows if case.compare_cost and is_comparable(case, row)]
    if not usable:
        return ()
    return tuple(
        Plot(f"{case.title}: {label}", label, f"error of {case.errors[0]}", _series(case, usable, cost), "loglog",
             pareto=True, levels=ERROR_LIMITS)
        for label, cost in (("wall time of the run, s", "wall"), ("core-seconds in the steps", "core_seconds"))
    )  # fmt: skip


def _series(case: AccuracyCase, rows: list[AccuracyRow], cost: str) -> tuple[Series, ...]:
    """Series of a plot, one for each value of `split`."""
    groups: dict[str, list[AccuracyRow]] = {}
    for row in sorted(rows, key=lambda row: float(getattr(row, cost))):
        groups.setdefault(str(row.record["settings"].get(case.split, "")), []).append(row)
    return tuple(
        Series(label, tuple(float(getattr(row, cost)) for row in group),
               tuple(max(row.errors[case.errors[0]], 1e-16) for row in group), "points",
               tuple(row.record["name"] for row in group))
        for label, group in groups.items()
    )  # fmt: skip
