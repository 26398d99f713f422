"""Runs at extremes of step, stiffness, shape and damage on 1 and 2 ranks, and the verdict on each."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import chain
from typing import Any

from . import contact_studies
from . import stability_studies as scenes
from .report_section import Claim, ReportTable, Section, TableCell
from .trial import Setting, Trial

GROUP = "stability"
Record = dict[str, Any]
TIME_STEPS = (1e-6, 1e-5, 1e-4, 1e-3, 1e-2, 1e-1)  # s
SINGLE_RUN = ((1, 0),)
REPEATED_RUNS = tuple((ranks, time) for time in range(5) for ranks in (1, 2))
MAX_ENERGY_GROWTH, MAX_ERROR = 0.05, 0.02  # relative; above either the result is wrong


def trials() -> list[Trial]:
    """Trials on 1 and 2 ranks: once, and five times in the full report, since round-off must not decide a crack."""
    cases = chain(
        _steps(), _stiffness(), _poisson(), _densities(), _stretches(), _inverted(), _slivers(), _shells(),
        _strengths(), _mass_breaking(), _one_cell(), _lengths(), _long_steps(), _edge_approach(), _contacts(),
        _rejected(),
    )  # fmt: skip
    return [
        _on_ranks(trial, *item) for trial in cases for item in (SINGLE_RUN if trial.case == "failed" else REPEATED_RUNS)
    ]


def _on_ranks(trial: Trial, ranks: int, time: int) -> Trial:
    """Trial on some ranks, for the first or a further time."""
    again = f".{time}" if time else ""
    return replace(trial, name=f"{trial.name}-r{ranks}{again}", ranks=ranks, full=trial.full or time > 0)


def _trial(case: str, name: str, study: scenes.Data, measure: str = "measure_run", limit: float = 60.0) -> Trial:
    """Trial of a study."""
    setting: dict[str, Setting] = {"of": name}
    return Trial(
        GROUP,
        case,
        name,
        study=study,
        settings=setting,
        always=True,
        limit=limit,
        measure=measure if ":" in measure else f"stability_measures:{measure}",
    )


def _script(
    case: str, name: str, module: str, *arguments: str, measure: str = "stability_measures:measure_run"
) -> Trial:
    """Trial of a script."""
    script = (f"fracsim.studies.evidence.{module}", *arguments)
    return Trial(GROUP, case, name, script=script, settings={"of": name}, measure=measure, always=True, limit=60.0)


# --- the cases ------------------------------------------------------------------------------------------------------


def _steps() -> list[Trial]:
    """Trials over the time step."""
    long = [_trial("dt", f"{step:.0e}-s", scenes.accelerated_bar(step), "measure_momentum") for step in TIME_STEPS]
    long += [_trial("dt", "1e-06-s-flying", scenes.flying_block(1e3, 1e-6), "measure_momentum_drift")]
    second = "generalized-alpha"
    long += [
        _trial("dt", f"{step:.0e}-s-{second}", scenes.accelerated_bar(step, scheme=second), "measure_momentum")
        for step in TIME_STEPS
    ]
    others = ("newmark", "explicit")
    return long + [
        _trial("dt", f"1e-2-s-{name}", scenes.accelerated_bar(1e-2, scheme=name), "measure_momentum") for name in others
    ]


def _stiffness() -> list[Trial]:
    """Trials over Young's modulus."""
    return [
        _trial(
            "young",
            f"{young:.0e}-Pa",
            scenes.stretched_block(1.3, material={"young": young}, strength=0.15 * young),
            "measure_stretch",
        )
        for young in (1e3, 1e6, 1e9, 1e12)
    ]


def _poisson() -> list[Trial]:
    """Trials over Poisson's ratio."""
    results = []
    for nu in (-0.9, 0.0, 0.49, 0.499, 0.4999):
        results.append(
            _trial("poisson", f"{nu:g}", scenes.stretched_block(1.3, material={"poisson": nu}), "measure_stretch")
        )
    torn = scenes.torn_body(scenes.BAR, speed=1.0, step=1e-2, steps=60, strength=2e5, material={"poisson": 0.4999})
    return [*results, _trial("poisson", "0.4999-torn", torn)]


def _densities() -> list[Trial]:
    """Trials with two densities."""
    return [
        _script(
            "density-ratio",
            "1e4-thrown",
            "custom_meshes",
            "two-densities",
            measure="stability_measures:measure_momentum",
        ),
        _script(
            "density-ratio",
            "1e4-hanging",
            "custom_meshes",
            "two-densities-hanging",
            measure="stability_measures:measure_weight",
        ),
    ]


def _stretches() -> list[Trial]:
    """Trials of large tension and compression."""
    results = []
    for energy in ("linear", "corotated", "stvk", "neo-hookean"):
        material = {"energy": energy, "poisson": 0.05}
        results.append(
            _trial("stretch", f"10x-{energy}", scenes.stretched_block(10.0, material=material), "measure_stretch")
        )
        crushed = scenes.stretched_block(0.05, material=material, confined=True)
        results.append(_trial("compression", f"5-percent-{energy}", crushed, "measure_stretch"))
    return results


def _inverted() -> list[Trial]:
    """Bodies that start inverted, and one whose right face is pushed through the left one in one step."""
    energies = ("corotated", "stvk", "neo-hookean")
    results = [_script("inverted", energy, "inverted_start", energy, measure="") for energy in energies]
    results.append(
        _trial("inverted", "pushed-through", scenes.stretched_block(-1.0, steps=1, confined=True), "measure_stretch")
    )
    swift = scenes.torn_body(scenes.BAR, speed=-20.0, step=0.1, steps=2, strength=float("inf"))
    return [*results, _trial("inverted", "pushed-through-moving", swift)]


def _slivers() -> list[Trial]:
    """Trials of cells with large aspect ratios."""
    results = []
    for ratio in (1e2, 1e3, 1e4):
        mesh = {"builder": "box", "size": [4.0, 4.0, 1 / ratio], "h": 1.0}
        results.append(
            _trial(
                "slivers", f"{ratio:.0e}-along", scenes.stretched_block(1.3, mesh=mesh, strength=2e5), "measure_stretch"
            )
        )
        mesh = {"builder": "box", "size": [1 / ratio, 4.0, 4.0], "h": 1.0}
        results.append(
            _trial(
                "slivers",
                f"{ratio:.0e}-across",
                scenes.stretched_block(1.3, mesh=mesh, strength=2e5),
                "measure_stretch",
            )
        )
    exact = results[-1].study | {"solver": {"snes_rtol": 1e-10}}  # type: ignore[operator]
    results.append(_trial("slivers", "1e+04-across-snes_rtol-1e-10", exact, "measure_stretch"))
    mesh = {"builder": "box", "size": [4.0, 4.0, 1e-4], "h": 1.0}
    return [
        *results,
        _trial("slivers", "1e+04-torn", scenes.torn_body(mesh, speed=1.0, step=2e-2, steps=60, strength=1e5)),
    ]


def _shells() -> list[Trial]:
    """Trials of thin plates."""
    mesh = {"builder": "box", "size": [1.0, 1.0, 1e-3], "h": 0.05}
    blown = scenes.torn_body(mesh, speed=0.5, step=5e-3, steps=60, strength=2e5)
    lifted = scenes.torn_body(mesh, speed=2.0, step=5e-3, steps=60, strength=1e5, axis=2)
    return [
        _trial(
            "shells", "1-to-1000-stretched", scenes.stretched_block(1.3, mesh=mesh, strength=2e5), "measure_stretch"
        ),
        _trial("shells", "1-to-1000-torn", blown),
        _trial("shells", "1-to-1000-bent", lifted),
    ]


def _strengths() -> list[Trial]:
    """Trials over the strength."""
    results = []
    for strength in (0.0, 1e-45, 1e-3, 1e3, 1e30, float("inf")):
        study = scenes.torn_body(scenes.BAR, speed=1.0, step=1e-2, steps=40, strength=strength)
        results.append(_trial("strength", f"{strength:g}-Pa", study))
    return [
        *results,
        _trial(
            "strength", "nan-Pa", scenes.torn_body(scenes.BAR, speed=1.0, step=1e-2, steps=40, strength=float("nan"))
        ),
    ]


def _mass_breaking() -> list[Trial]:
    """Trials in which many edges break in a step."""
    mesh = {"builder": "box", "size": [1.0, 1.0, 1.0], "h": 0.05}
    cube = {"builder": "box", "size": [1.0, 1.0, 1.0], "h": 0.1}
    return [
        _trial(
            "many",
            "10000-edges-in-a-step",
            scenes.stretched_block(1.2, mesh=mesh, strength=1e5, steps=10),
            "measure_stretch",
            120.0,
        ),
        _trial(
            "many",
            "1000-pieces",
            scenes.spinning_block(cube, spin=50.0, step=5e-3, steps=30, strength=1e2),
            "measure_momentum_drift",
        ),
    ]


def _one_cell() -> list[Trial]:
    """Trials of a single cell."""
    return [_script("one-cell", name, "custom_meshes", name) for name in ("triangle", "tetrahedron")]


def _lengths() -> list[Trial]:
    """Trials over the unit of length."""
    results = []
    for name, unit in (("micrometres", 1e-6), ("kilometres", 1e3)):
        mesh = {"builder": "box", "size": [unit, 0.25 * unit, 0.25 * unit], "h": 0.125 * unit}
        results.append(
            _trial("lengths", name, scenes.stretched_block(1.3, mesh=mesh, strength=1.5e5), "measure_stretch")
        )
        # time scales with the length, so that the same edges break
        study = scenes.torn_body(mesh, speed=1.0, step=1e-2 * unit, steps=60, strength=1e5)
        results.append(_trial("lengths", f"{name}-torn", study))
    return results


def _long_steps() -> list[Trial]:
    """M22's cylinder of about 600 nodes at dt = 5e-2 s, where XFEM is not stable."""
    mesh = {"builder": "cylinder", "radius": 0.25, "length": 1.0, "h": 0.095}
    results = []
    for energy in ("stvk", "neo-hookean", "corotated"):
        study = scenes.torn_body(
            mesh, speed=0.5, step=5e-2, steps=60, strength=5e5, ends=("bottom", "top"), axis=2,
            material={"energy": energy, "young": 1e7},
        )  # fmt: skip
        results.append(_trial("dt-5e-2", f"cylinder-{energy}", study))
    return results


def _edge_approach() -> list[Trial]:
    """The `edge` approach, which assumes small strains, at a strength that allows 30 %."""
    results = []
    for energy in ("linear", "corotated"):
        study = scenes.torn_body(
            scenes.BAR, speed=1.0, step=1e-2, steps=60, strength=3e5, approach="edge", material={"energy": energy}
        )
        results.append(_trial("edge-approach", f"30-percent-{energy}", study))
    return results


def _contacts() -> list[Trial]:
    """Falls on a floor, impacts of light and heavy balls, a press, and contact between bodies."""
    fell, struck = "contact_studies:measure_fall", "contact_studies:measure_impact"
    results = [
        _trial("contact", f"dt-{step:.0e}-s", contact_studies.falling_bar(step), fell)
        for step in (*TIME_STEPS[:-1], 5e-2)
    ]
    others = {"newmark": 50, "generalized-alpha": 100}  # steps; Newmark gains energy at large strains and takes more
    results += [
        _trial("contact", f"dt-1e-02-s-{name}", contact_studies.falling_bar(1e-2, scheme=name, steps=steps), fell)
        for name, steps in others.items()
    ]
    for young in (1e3, 1e5, 1e7, 1e9, 1e11):
        soft = contact_studies.falling_bar(5e-3, young=young, speed=0.3, gravity=0.0)
        results.append(_trial("contact", f"young-{young:.0e}-Pa", soft, fell))
    for ratio in (1e-4, 1.0, 1e4):
        results.append(_trial("contact", f"mass-ratio-{ratio:.0e}", contact_studies.bar_hit_by_ball(ratio), struck))
    broken = scenes.with_fracture(contact_studies.bar_hit_by_ball(1e4), 3e5)
    results.append(_trial("contact", "mass-ratio-1e+04-torn", broken, struck))
    results.append(
        _trial(
            "contact", "shell-1-to-1000-pressed", contact_studies.pressed_shell(1e-3), "contact_studies:measure_press"
        )
    )
    itself = (name for name in contact_studies.MESH_STUDIES if name.startswith("itself"))
    results += [
        _script("contact", name, "custom_meshes", name, measure="contact_studies:measure_block_fall") for name in itself
    ]
    results.append(
        _script("contact", "shell-in-a-stack", "custom_meshes", "stacked-4mm", measure="contact_studies:measure_stack")
    )
    return results + _without_contact()


# row of a body in contact -> row of the same one without
WITHOUT_CONTACT = {"young-1e+07-Pa": "young-1e+07-Pa-alone", "shell-in-a-stack": "stack-in-one-piece"}


def _without_contact() -> list[Trial]:
    """The same bodies without contact."""
    fall = contact_studies.without_contact(contact_studies.falling_bar(5e-3, speed=0.3, gravity=0.0))
    return [
        _trial("contact", "young-1e+07-Pa-alone", fall),
        _trial("contact", "stack-in-one-piece", contact_studies.solid_stack()),
    ]


def _rejected() -> list[Trial]:
    """M22's section 6 as an experiment (rejected_approaches.py)."""
    from .rejected_approaches import APPROACHES

    return [_script("failed", name, "rejected_approaches", name, measure="") for name in APPROACHES]


# --- the page -------------------------------------------------------------------------------------------------------


def verdict(record: Record) -> str:
    """Outcome of a run: right, stable, warned, refused, not converged, or WRONG."""
    figures, outcome, message = record["figures"], record["outcome"], record["message"].removeprefix("fracsim: ")
    if outcome in ("refused", "not converged"):
        return f"{outcome}: {message}" if message else f"WRONG: {outcome} without a word"
    if outcome != "done":
        return f"WRONG: {outcome}"
    if not figures.get("finite", False):
        return "WRONG: not finite"
    if message.startswith("note: ") and any(word in message for word in ("turned inside out", "from nowhere")):
        return f"warned: {message.removeprefix('note: ')}"
    if figures.get("passed"):
        return f"WRONG: {figures['passed']} points passed through"
    if figures.get("growth", 0.0) > MAX_ENERGY_GROWTH:
        return "WRONG: energy grew"
    if "error" not in figures:
        return "stable"
    near = figures["error"] <= MAX_ERROR and not figures.get("break_off_by", 0)
    return "right" if near else "WRONG: far from the closed form"


def sections(records: list[Record]) -> list[Section]:
    """Sections with the table and its claims, contact iterations, and M22's two rejected approaches."""
    from .rejected_approaches import section

    table = [record for record in records if record["case"] != "failed"]
    text = (
        "Energy growth is the largest rise of elastic + kinetic + dissipated - work as a share of the energy at play; "
        "the error is that of a force, a momentum or a weight known in closed form (homogeneous stretch, dead load on "
        "a free body); the smallest J is that of the cells that still carry. `stable` means finite and without "
        "created energy, where no closed form is known; `warned` means that the run says that its "
        "result is invalid, and why. In contact no point of a frame may lie inside an obstacle or another body "
        "(inside a "
        "ball no deeper than a facet's chord). Each row was run on 1 and on 2 ranks, two runs at a time on 1 rank."
    )
    results = [record for record in records if record["case"] == "failed"]
    first = Section("Stability", text, claims=_claims(table), tables=(_table(table),))
    return [first, *([contact] if (contact := _iterations(table)) else []), *([section(results)] if results else [])]


def _claims(records: list[Record]) -> tuple[Claim, ...]:
    """Claims over all runs."""
    wrong = [f"{r['case']}/{r['name']}" for r in records if verdict(r).startswith("WRONG")]
    endless = [f"{r['case']}/{r['name']}" for r in records if r["outcome"] == "out of time"]
    infinite = [f"{r['case']}/{r['name']}" for r in records if r["figures"].get("finite") is False]
    differ = [runs for runs in _group_by_study(records) if not _agree(*runs)]
    apart = [_label(runs) for runs in differ if any(map(_is_trusted, runs))]
    doubtful = [_label(runs) for runs in differ if not any(map(_is_trusted, runs))]
    aside = f"; different, but all runs warn or do not converge: {', '.join(doubtful)}" if doubtful else ""
    return (
        _claim("No run exceeds its time limit, on 1 and 2 ranks", endless, records),
        _claim("No NaN in history, fields or surface, on 1 and 2 ranks", infinite, records),
        _claim("Each case ends with a correct result or a clear message", wrong, records),
        _claim("2 ranks break the same edges as 1", apart, records, aside),
    )


def _claim(text: str, against: Sequence[str], records: list[Record], aside: str = "") -> Claim:
    """Claim that holds if no run stands against it."""
    measured = f"{len(records)} runs; against it: {', '.join(against) or 'none'}{aside}"
    return Claim(text, measured, not against if records else None)


def _study_name(record: Record) -> str:
    """Name of the study, without ranks and repetition."""
    return str(record["name"]).rpartition("-r")[0]


def _group_by_study(records: list[Record]) -> list[list[Record]]:
    """Runs of each study on different ranks, fewest ranks first."""
    places: dict[tuple[str, str], list[Record]] = {}
    for record in sorted(records, key=lambda record: record["ranks"]):
        places.setdefault((record["case"], _study_name(record)), []).append(record)
    order = list(dict.fromkeys((record["case"], _study_name(record)) for record in records))
    return [places[place] for place in order]


def _label(runs: list[Record]) -> str:
    """Case and study of the runs."""
    return f"{runs[0]['case']}/{_study_name(runs[0])}"


def _is_trusted(record: Record) -> bool:
    """Return whether the run ended without warning, refusal or failure to converge.

    A motion with a warning (a body pushed through itself, say) is one of several, and round-off may decide which.
    """
    return not verdict(record).startswith(("warned", "refused", "not converged"))


def _agree(one: Record, *others: Record) -> bool:
    """Return whether runs have the same outcome, broken edges and fragments."""
    return all(
        one["outcome"] == other["outcome"]
        and all(one["figures"].get(key) == other["figures"].get(key) for key in ("broken", "pieces"))
        for other in others
    )


def _iterations(records: list[Record]) -> Section | None:
    """Section on Newton and CG iterations with and without contact; None if there is no run."""
    figures = {
        _study_name(record): record["figures"]
        for record in records
        if record["case"] == "contact" and record["ranks"] == 1
    }
    rows = [
        _iteration_row(name, figures[name], {})
        for name in figures
        if name not in (*WITHOUT_CONTACT, *WITHOUT_CONTACT.values())
    ]
    rows += [
        _iteration_row(name, figures[name], figures[alone])
        for name, alone in WITHOUT_CONTACT.items()
        if {name, alone} <= {*figures}
    ]
    if not rows:
        return None
    both = ("Newton a step", "most", "CG a step", "most ", "CG a Newton iteration")
    columns = ("scene", *both, *(f"without contact: {name.strip()}" for name in both))
    text = (
        "Iterations a step with 200 to 2,000 tetrahedra, on one rank. A barrier makes the tangent stiff at "
        "contacts, and "
        "its pattern changes with them. Without contact: the same free bar, and the stack as one block."
    )
    return Section(
        "Contact: iterations", text, tables=(ReportTable("contact-iterations", "Iterations", columns, tuple(rows)),)
    )


def _iteration_row(name: str, *both: Record) -> tuple[TableCell, ...]:
    """Row of the table of iterations."""
    results = [[item.get(key) for key in ITERATION_FIGURES] for item in both]
    each_time = [counts[2] / counts[0] if counts[0] else None for counts in results]
    return name, *results[0], each_time[0], *results[1], each_time[1]


ITERATION_FIGURES = ("newton_mean", "newton_max", "krylov_mean", "krylov_max")
COLUMNS = (
    "case", "of", "verdict", "2 ranks alike", "error", "energy growth", "Newton, mean", "Newton, most", "CG, mean",
    "smallest J", "steps halved", "broken edges", "in one step", "pieces", "s",
)  # fmt: skip
FRACTURE_FIGURES = ("broken", "broken_in_a_step", "pieces")
FIGURES = ("error", "growth", "newton_mean", "newton_max", "krylov_mean", "smallest_J")


def _table(records: list[Record]) -> ReportTable:
    """Table of all runs."""
    rows = tuple(_row(one, others) for one, *others in _group_by_study(records))
    return ReportTable("stability", "Outcome of each case", COLUMNS, rows)


def _row(one: Record, others: list[Record]) -> tuple[TableCell, ...]:
    """Row of a study; `others` are its runs on more ranks."""
    figures, summary = one["figures"], one["summary"] or {}
    words = list(dict.fromkeys(verdict(record) for record in (one, *others)))
    return (
        one["case"], _study_name(one), "; on 2 ranks ".join(words) if _verdicts_differ(words) else words[0],
        _agree(one, *others) if others else None, *(figures.get(key) for key in FIGURES),
        summary.get("steps_failed", figures.get("halved")), *(figures.get(key) for key in FRACTURE_FIGURES),
        one["wall"][-1],
    )  # fmt: skip


def _verdicts_differ(words: list[str]) -> bool:
    """Return whether verdicts differ in their first word; figures in messages may differ in the last digits."""
    return len({word.partition(":")[0] for word in words}) > 1
