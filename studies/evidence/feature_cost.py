"""Cost of each feature: where it is used, and that it costs nothing where it is not.

    python -m fracsim.studies.evidence.feature_cost SCENE [--n 10] -o figures.json

Each scene is the bar of `make bench` (24 n^3 tetrahedra, one Newton iteration and CG to 1e-6 a step) with one feature
more. It is timed in turn with the elastic bar in one process. The elastic bar is timed in turn with the bare loop of
bench.py, which has no features but fracsim's assembly of the tangent. Start-up, modules, fields and memory are measured
in a separate process.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass, field
from pathlib import Path
from statistics import median
from typing import Any

from ...study import Study
from ..bench import bench_study as bench_study
from ..bench import time_call
from . import fracture_step_cost, self_contact_cost, solver_comparison
from .report_section import Claim, Plot, ReportTable, Section, Series, TableCell
from .trial import Trial

WARM_UP_STEPS, TIMED_STEPS = 3, 12
# blocks of steps are repeated, up to MAX_STEPS, while the quartiles of the ratio differ by more than this share of it
MAX_QUARTILE_RANGE, MAX_STEPS = 0.08, 36
SMALL_N, LARGE_N = 10, 20  # cells along a metre: 24k and 192k tetrahedra
MAX_RATIO = 1.05  # of the elastic bar over the bare loop
DAMAGE: dict[str, Any] = {"fracture": {"strength": 4e6}}  # above the stress of the bar
# a tangent and an exact solve in every iteration, as in the bench; otherwise savings would depend on the scene
EXACT: dict[str, Any] = {"solver": {"snes_type": "newtonls", "ksp_rtol": 1e-5}}
YIELDING_EVERYWHERE: dict[str, Any] = {"solver": None, "plasticity": {"yield_stress": 2e3, "hardening": 1e5}}
FRACTURE_MODULES = (
    "fracture.fracture_pass", "fracture.degradation", "fracture.strength", "fracture.edge_stress",
    "fracture.edge_history", "mesh.edge_graph",
)  # fmt: skip
PLASTIC_MODULES = (
    "mechanics.plasticity", "mechanics.return_mapping", "mechanics.tensor_functions",
    "forms.plasticity",
)  # fmt: skip
AVERAGE, SURFACE, BRITTLE = "fracture.nonlocal_average", ("mesh.split_surface", "output.surface"), "fracture.brittle"
CONTACT_MODULES = ("contact", "scene.contact_terms", "solvers.balancing", *SURFACE)
BALL: dict[str, Any] = {"name": "ball", "shape": "sphere", "radius": 0.5, "at": [5.0, 0.5, 2.0]}  # far from the bar
OPTIONAL = (
    *FRACTURE_MODULES, *CONTACT_MODULES, *PLASTIC_MODULES, AVERAGE, BRITTLE, "forms.damage", "forms.crack_closure",
    "report",
)  # fmt: skip
MAX_OBSTACLE_RATIO = 1.03  # of an obstacle without contact, at 192k tetrahedra
OTHER_CASES = {
    "faces": self_contact_cost,
    "solvers": solver_comparison,
    "steps": fracture_step_cost,
}  # by their case
MAX_YIELDING_RATIO = 1.30  # of plastic flow in all cells over the elastic bar


@dataclass(frozen=True)
class FeatureScene:
    """A scene with one feature.

    Attributes:
        tables: changes from the elastic bar; None removes a table.
        uses: modules of `OPTIONAL` that the scene may import (with their submodules).
        cut: break a plane through the middle before the first step.
        plane: the 2D bar, with about as many triangles.
        baseline: name of the scene it is compared with. "": the bare loop. "recorded": the bare loop with the elastic
            energy of each step, which every run writes to history.csv.
        needs: table of the study file that the scene requires.
        first: steps before the timed ones.
    """

    tables: dict[str, Any] = field(default_factory=dict)
    uses: tuple[str, ...] = ()
    cut: bool = False
    plane: bool = False
    baseline: str = "elastic"
    needs: str = ""
    first: int = WARM_UP_STEPS


def feature_scenes(n: int) -> dict[str, FeatureScene]:
    """All scenes by name that this version of the program supports."""
    near = {"fracture": DAMAGE["fracture"] | {"radius": 2 / n}}
    average = (*FRACTURE_MODULES, AVERAGE)
    scenes = {
        "elastic": FeatureScene(baseline=""),
        "elastic-recorded": FeatureScene(baseline="recorded"),
        "linear": FeatureScene({"material": {"energy": "linear"}}),
        "corotated": FeatureScene({"material": {"energy": "corotated"}}),
        "damage": FeatureScene(DAMAGE, FRACTURE_MODULES),
        "damage-cut": FeatureScene(DAMAGE, FRACTURE_MODULES, cut=True),
        "average": FeatureScene(near, average),
        "average-cut": FeatureScene(near, average, cut=True),
        "surface": FeatureScene(DAMAGE | {"output": {"surface": True}}, (*FRACTURE_MODULES, *SURFACE), cut=True),
        # converged Newton iterations in all; every cell yields after a few steps
        "newton": FeatureScene({"solver": None}),
        "tangents": FeatureScene(EXACT),
        "plasticity": FeatureScene(YIELDING_EVERYWHERE | EXACT, PLASTIC_MODULES, baseline="tangents"),
        # the elastic bar's forces, which scale its residual, grow: later it keeps its tangent and needs one iteration
        "plasticity-later": FeatureScene(YIELDING_EVERYWHERE, PLASTIC_MODULES, baseline="newton", first=30),
        "brittle": FeatureScene(
            DAMAGE | {"brittle": {"surfaces": 10}}, (*FRACTURE_MODULES, BRITTLE), needs="brittle"
        ),
        "obstacle": FeatureScene({"solver": None, "obstacle": [BALL]}, CONTACT_MODULES, baseline="newton"),
        "obstacle-free": FeatureScene({"solver": None, "obstacle": [BALL | {"mass": 1.0}]}, CONTACT_MODULES,
                                      baseline="newton"),
        "plane": FeatureScene(plane=True),
        "plane-damage": FeatureScene(DAMAGE, FRACTURE_MODULES, plane=True, baseline="plane"),
    }  # fmt: skip
    return {name: scene for name, scene in scenes.items() if not scene.needs or scene.needs in Study.model_fields}


def trials() -> list[Trial]:
    """Trials of all scenes at 24k tetrahedra, at 192k in the full report, and of the other cases."""
    rung_by_rung = (_trial(name, n) for n in (SMALL_N, LARGE_N) for name in feature_scenes(n))
    return [*rung_by_rung, *(trial for part in OTHER_CASES.values() for trial in part.trials())]


def _trial(name: str, n: int) -> Trial:
    """Trial of a scene with n cells along a metre."""
    script = ("fracsim.studies.evidence.feature_cost", name, "--n", str(n))
    settings: dict[str, Any] = {"scene": name, "n": n}
    return Trial("ladder", f"n-{n}", name, script=script, settings=settings, limit=60.0 * n / 2, full=n > SMALL_N)


def feature_study(name: str, n: int) -> dict[str, Any]:
    """Study of a scene."""
    scene, data = feature_scenes(n)[name], bench_study(n)
    del data["fracture"]
    data["output"] |= {"surface": False}
    if scene.plane:
        h = 1 / round((3 * n**3) ** 0.5)  # 8 / h^2 triangles
        data["mesh"] = {"builder": "box", "size": [1.0, 4.0], "h": h}
        data["boundary"] = [{"on": "bottom", "fix": "xy"}, {"on": "top", "velocity": [0.0, 1.0]}]
        data["load"] = {"gravity": [0.0, -9.81]}
    for key, table in scene.tables.items():
        if table is None:
            data.pop(key, None)
        else:
            data[key] = data.get(key, {}) | table if isinstance(table, dict) else table
    return data


# --- the script -----------------------------------------------------------------------------------------------------


def main() -> None:
    """Time a scene, measure it in a separate process, and write the figures."""
    began = time.perf_counter()
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("scene")
    parser.add_argument("--n", type=int, default=SMALL_N)
    parser.add_argument("--alone", action="store_true", help=argparse.SUPPRESS)
    parser.add_argument("-o", "--out", type=Path, required=True)
    given = parser.parse_args()
    if given.alone:
        given.out.write_text(json.dumps(measure_alone(given.scene, given.n, began)))
        return
    figures = time_in_turn(given.scene, given.n)  # first, so that its kernels are compiled before a start-up is timed
    part = given.out.with_name("alone.json")
    command = [
        sys.executable,
        "-m",
        "fracsim.studies.evidence.feature_cost",
        given.scene,
        "--n",
        str(given.n),
        "--alone",
    ]
    subprocess.run([*command, "-o", str(part)], check=True, timeout=600)
    given.out.write_text(json.dumps(figures | json.loads(part.read_text(encoding="utf-8")), indent=1) + "\n")


def start_run(name: str, n: int, folder: Path) -> Any:
    """Run of a scene before its first timed step."""
    from mpi4py import MPI

    from ...deformable_run import Run
    from ...scene import build_scene
    from ...study.reader import validate

    run = Run(build_scene(MPI.COMM_WORLD, validate(feature_study(name, n), name)), folder)
    if feature_scenes(n)[name].cut:
        from .crack_count_cost import break_planes

        # through the middle, askew and off the nodes of the lattice
        break_planes(
            run, [((0.02, 0.03, 1.0), 0.5013 * (run.scene.domain.bounds.lower + run.scene.domain.bounds.upper))]
        )
    return run


def measure_alone(name: str, n: int, began: float) -> dict[str, Any]:
    """Start-up time, modules, fields and memory of a scene in this process."""
    from ... import deformable_run, scene  # noqa: F401  imports of every run: memory is counted from here

    before = _process_memory("VmRSS")
    with tempfile.TemporaryDirectory() as folder:
        started_ = start_run(name, n, Path(folder))
        started_.step()
        start_up = time.perf_counter() - began
        for _ in range(WARM_UP_STEPS):
            started_.step()
        frame = time_call(started_.comm, started_.write_frame)
        cells = started_.scene.domain.cell_count
        own = ("fracsim.studies", "fracsim.report")  # imported by this script
        modules = sorted(name for name in sys.modules if name.startswith("fracsim.") and not name.startswith(own))
        fields = _function_memory()
    memory = (_process_memory("VmHWM") - before) / cells
    return {
        "start_up": start_up,
        "frame": frame,
        "cells": cells,
        "memory_per_cell": memory,
        "modules": modules,
        **fields,
    }


def _process_memory(which: str) -> float:
    """Resident memory (VmRSS) or its peak (VmHWM), bytes. ru_maxrss would start from the parent's value."""
    lines = Path("/proc/self/status").read_text(encoding="utf-8").splitlines()
    return 1024 * float(next(line for line in lines if line.startswith(which)).split()[1])


def _function_memory() -> dict[str, int]:
    """Number of live DOLFINx functions, and their bytes."""
    import gc

    from dolfinx import fem

    gc.collect()
    # by type: isinstance would ask proxies for their class
    results = [thing for thing in gc.get_objects() if type(thing) is fem.Function]
    return {"fields": len(results), "field_bytes": sum(function.x.array.nbytes for function in results)}


def time_in_turn(name: str, n: int) -> dict[str, Any]:
    """Seconds per step of a scene and of the scene it is compared with, one step of each in turn."""
    pairs: list[tuple[float, float]] = []
    ratio, spread = 1.0, float("inf")
    while spread > MAX_QUARTILE_RANGE / 2 * ratio and len(pairs) < MAX_STEPS:
        block, newton = _time_block(name, n)
        pairs += block
        ratios = [a / b for a, b in pairs]
        ratio, spread = median(ratios), _half_quartile_range(ratios)
    return {
        "after": feature_scenes(n)[name].baseline or "bare", "steps": len(pairs), "newton": newton,
        "step": median(a for a, _ in pairs), "step_spread": _half_quartile_range([a for a, _ in pairs]),
        "ratio": ratio, "ratio_spread": spread,
    }  # fmt: skip


def _time_block(name: str, n: int) -> tuple[list[tuple[float, float]], str]:
    """Pairs of seconds of the timed steps, always the same ones from the start, and Newton iterations of the last."""
    scene = feature_scenes(n)[name]
    with tempfile.TemporaryDirectory() as folder:
        runs = [start_run(name, n, Path(folder, "scene"))]
        runs[0].write_frame()  # for its kernels
        steps = [runs[0].step]
        if scene.baseline in feature_scenes(n):
            runs.append(start_run(scene.baseline, n, Path(folder, "other")))
            steps.append(runs[1].step)
        else:
            from ..bench import BareLoop

            steps.append(BareLoop(n, runs[0].scene.domain, records=bool(scene.baseline), in_lanes=True).step)
        pairs = [_time_pair(runs[0].comm, steps, number) for number in range(scene.first + TIMED_STEPS)]
        newton = " / ".join(str(run.scene.stepper.solver.snes.its) for run in runs)
    return pairs[scene.first :], newton


def _time_pair(comm: Any, both: list[Any], number: int) -> tuple[float, float]:
    """Seconds of a step of each. Each is first in half of the pairs, since the second finds filled caches."""
    if number % 2:
        second = time_call(comm, both[1])
        return time_call(comm, both[0]), second
    return time_call(comm, both[0]), time_call(comm, both[1])


def _half_quartile_range(values: list[float]) -> float:
    """Half the distance between the quartiles."""
    import numpy as np

    low, high = np.percentile(values, [25, 75])
    return float(high - low) / 2


# --- the section ----------------------------------------------------------------------------------------------------


def unused_feature_modules(name: str, n: int, modules: list[str]) -> list[str]:
    """Modules of features that a scene imported without using them."""
    optional = {module for module in modules for part in OPTIONAL if _is_inside(module, part)}
    allowed = {module for module in modules for part in feature_scenes(n)[name].uses if _is_inside(module, part)}
    return sorted(optional - allowed)


def _is_inside(module: str, part: str) -> bool:
    """Return whether a module is `part` or inside it."""
    return f"{module}.".startswith(f"fracsim.{part}.")


def sections(records: list[dict[str, Any]]) -> list[Section]:
    """Sections with table, ratios and claims, and of the other cases."""
    by_itself = {case: [record for record in records if record["case"] == case] for case in OTHER_CASES}
    records = [record for record in records if record["case"] not in OTHER_CASES]
    columns = (
        "cells along 1 m", "scene", "cells", "s a step", "±", "compared with", "ratio", "± ", "Newton", "frame s",
        "start-up s", "memory bytes/cell", "fields", "field bytes/cell", "modules",
        "modules beyond the elastic scene", "outcome",
    )  # fmt: skip
    base = _modules_of_elastic(records)
    rows = tuple(_row(record, base) for record in records)
    text = (
        f"Medians of the {TIMED_STEPS} steps after the first {WARM_UP_STEPS}, repeated up to {MAX_STEPS} steps "
        f"while the quartiles of "
        f"the ratio differ by more than {MAX_QUARTILE_RANGE:.0%}. Each step is timed in turn with one of the "
        f"scene it is "
        "compared with. Ratio: median over single steps; ±: half the distance between the quartiles. Newton: "
        "iterations "
        "of both in the last step. The elastic scene is compared with the same loop in DOLFINx alone, with fracsim's "
        "assembly of the tangent, without and with the energy that every run records. 'plasticity' (every cell yields) "
        "is compared with 'tangents': the elastic scene with converged Newton iterations and a tangent in each, as in "
        "'plasticity'. With default settings ('plasticity-later' over 'newton') the forces of the elastic bar grow, so "
        "that it keeps its tangent and needs one iteration less for the same relative residual. 'cut': a plane through "
        "the middle is broken. 'frame': time to write one frame, which is not part of a step. Start-up: from the first "
        "import to the end of the first step, with compiled kernels."
    )
    plot = Plot(
        "Seconds per step over those of the scene compared with",
        "scene, in the order of the table", "ratio", _bars(records), levels=(1.0, MAX_RATIO),
    )  # fmt: skip
    table = ReportTable("ladder", "What each feature costs", columns, rows)
    title = "Cost of features, used and unused"
    first = Section(title, text, _claims(records), (table,), (plot,))
    return [first, *(OTHER_CASES[case].section(results) for case, results in by_itself.items() if results)]


def _modules_of_elastic(records: list[dict[str, Any]]) -> set[str]:
    """Modules that the elastic scene imported."""
    elastic = (record["figures"].get("modules", []) for record in records if record["name"] == "elastic")
    return {module for modules in elastic for module in modules}


def _row(record: dict[str, Any], base: set[str]) -> tuple[TableCell, ...]:
    """Row of the table."""
    get, cells = record["figures"].get, record["figures"].get("cells")
    modules = get("modules", [])
    beyond = ", ".join(sorted(name.removeprefix("fracsim.") for name in set(modules) - base))
    outcome = record["outcome"] if record["outcome"] == "done" else f"{record['outcome']}: {record['message']}"
    return (
        record["settings"]["n"], record["name"], cells, get("step"), get("step_spread"), get("after"), get("ratio"),
        get("ratio_spread"), get("newton"), get("frame"), get("start_up"), get("memory_per_cell"), get("fields"),
        get("field_bytes") / cells if cells else None, len(modules), beyond, outcome,
    )  # fmt: skip


def _bars(records: list[dict[str, Any]]) -> tuple[Series, ...]:
    """Series of ratios, one a mesh size."""
    result = []
    for n in (SMALL_N, LARGE_N):
        shown = [record for record in records if record["settings"]["n"] == n and "ratio" in record["figures"]]
        figures = [record["figures"] for record in shown]
        if shown:
            names, places = tuple(record["name"] for record in shown), tuple(map(float, range(len(shown))))
            y, spread = (tuple(figure[key] for figure in figures) for key in ("ratio", "ratio_spread"))
            result.append(Series(f"{24 * n**3:,} tets", places, y, "points", names, spread))
    return tuple(result)


def _claims(records: list[dict[str, Any]]) -> tuple[Claim, ...]:
    """Claims on the ratios and the imports."""
    results = {
        record["name"]: unused_feature_modules(record["name"], record["settings"]["n"], record["figures"]["modules"])
        for record in records
        if "modules" in record["figures"]
    }
    extra = "; ".join(f"{name}: {', '.join(modules)}" for name, modules in results.items() if modules)
    none = f"{len(results)} scenes, none imports modules of an unused feature"
    return (
        _ratio_claim(
            "Unused features cost at most 5 % of a step (elastic scene over a bare loop that records its energy)",
            records,
            "elastic-recorded",
            MAX_RATIO,
        ),
        _ratio_claim(
            "Plastic flow in all cells adds at most 30 % to a step with the same iterations and tangents",
            records,
            "plasticity",
            MAX_YIELDING_RATIO,
        ),
        _ratio_claim(
            "An obstacle without contact adds at most 3 % to a step at 192k tetrahedra",
            [record for record in records if record["settings"]["n"] == LARGE_N],
            "obstacle",
            MAX_OBSTACLE_RATIO,
        ),
        Claim("An unused feature imports nothing", extra or none, not extra if results else None),
    )


def _ratio_claim(text: str, records: list[dict[str, Any]], scene: str, limit: float) -> Claim:
    """Claim that a scene costs at most `limit` times the scene it is compared with."""
    results = [record["figures"] for record in records if record["name"] == scene and "ratio" in record["figures"]]
    measured = ", ".join(
        f"{figures['ratio']:.3f} at {figures['cells']:,} tets (Newton iterations: {figures['newton']})"
        for figures in results
    )
    return Claim(text, measured or "nothing", all(item["ratio"] <= limit for item in results) if results else None)


if __name__ == "__main__":
    main()
