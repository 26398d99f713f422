"""Seconds per step against the number of cracks, beside a method that adds unknowns at each crack.

    python -m fracsim.studies.evidence.crack_count_cost CASE [--cuts 0 1 10 100] [--no-baseline] -o figures.json

A body is fixed at one end and pulled at the other. Planes cut it: all edges across a plane break at once. After 0, 1,
10 and 100 planes three loops are timed, one step of each in turn, so that disturbances of the machine affect all. The
loops are the uncut body, the cut body (same unknowns), and cells duplicated with virtual nodes (virtual_nodes.py; same
forms, solver and stepper, no fracture pass), built again after each cut.

One Newton iteration a step and CG to 1e-6 for all, as in `make bench`. The number of iterations depends on the motion
of the fragments, which is not compared here.
"""

from __future__ import annotations

import argparse
import copy
import json
import tempfile
import time
import tomllib
from dataclasses import replace
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
import numpy.typing as npt

from ..bench import OPTIONS, break_edges
from .report_section import Claim, Picture, Plot, ReportTable, Section, Series, TableCell, record_folder
from .trial import Trial

CUT_COUNTS = (0, 1, 10, 100)
WARM_UP_STEPS, TIMED_STEPS, BASELINE_STEPS = (
    2,
    5,
    3,
)  # steps before timing, timed ones, and those of the baseline (10 times as dear)
MAX_RATIO = 1.10  # of a step after 100 cuts over one before
CYLINDER = {"builder": "cylinder", "radius": 0.05, "length": 0.3, "axis": "x"}
WALL = {"builder": "box", "size": [2.0, 0.3, 1.5], "pattern": "unstructured"}
SCENES: dict[str, dict[str, Any]] = {
    "cylinder-600-nodes": CYLINDER | {"h": 0.0215},
    "cylinder-33k-tets": CYLINDER | {"h": 0.0092},
    "adobe-wall": WALL | {"h": 0.202},
    "box-192k-tets": {"builder": "box", "size": [4.0, 1.0, 1.0], "h": 0.05},
    "box-648k-tets": {"builder": "box", "size": [4.0, 1.0, 1.0], "h": 1 / 30},
}
ENDS = {"cylinder": ("bottom", "top"), "box": ("left", "right")}
LOAF_SIZES = {"1.5k": 0.0265, "38k": 0.00865, "620k": 0.0034}  # m, h for about as many tets as in M22 fig. 14
PUBLISHED = (
    "M22 report, in s a frame and not on this machine: cylinder of 600 nodes (1,566 tets) with one cut 0.009 against "
    "0.271 of an XFEM; of 7.7k nodes (33.5k tets) with many cuts 0.253 against 5.87; adobe wall of 338 nodes (1,109 "
    "tets) 0.007 against 0.11 to 0.14 remeshed (M22 section 5.5). The meshes here have as many nodes or tets as those."
)


def trials() -> list[Trial]:
    """Trials on 1 and 2 ranks, and of the loaf at three resolutions."""
    return [*(_trial(case, ranks) for case in SCENES for ranks in (1, 2)), *map(_loaf_trial, LOAF_SIZES)]


def _trial(case: str, ranks: int) -> Trial:
    """Trial of a case on some ranks."""
    large = case.startswith("box")
    options = ["--no-baseline"] if ranks > 1 else ["--cuts", "0", "1", "10"] if case == "box-648k-tets" else []
    script = ("fracsim.studies.evidence.crack_count_cost", case, *options)
    limit = 3000.0 if large else 900.0
    return Trial(
        "growth", case, f"ranks-{ranks}", script=script, settings={"ranks": ranks}, ranks=ranks, limit=limit, full=large
    )


def _loaf_trial(name: str) -> Trial:
    """Trial of the loaf at one resolution."""
    from .. import folder

    study = tomllib.loads((folder() / "loaf.toml").read_text(encoding="utf-8"))
    study["mesh"]["h"] = LOAF_SIZES[name]
    study["output"] = {"interval": 0.15, "fields": ["damage"]}
    large = name == "620k"
    return Trial(
        "growth", "loaf", name, study=study, settings={"h": LOAF_SIZES[name]}, ranks=2 if large else 1,
        limit=4 * 3600.0 if large else 300.0, full=large,
    )  # fmt: skip


def scene_study(case: str) -> dict[str, Any]:
    """Study of a soft bar fixed at one end and pulled at the other. Only planes cut it, as its strength is huge."""
    mesh = copy.deepcopy(SCENES[case])
    held, drawn = ENDS[mesh["builder"]]
    return {
        "title": case,
        "mesh": mesh,
        "material": {"energy": "neo-hookean", "young": 1e6, "poisson": 0.3, "density": 1000.0},
        "fracture": {"strength": 1e12},
        "boundary": [{"on": held, "fix": "xyz"}, {"on": drawn, "velocity": [0.1, 0.0, 0.0]}],
        "load": {"gravity": [0.0, 0.0, -9.81]},
        "solver": OPTIONS,
        "time": {"scheme": "backward-euler", "step": 5e-3, "end": 100.0},
        "output": {"every": 1000000, "picture": False, "surface": False},
    }


# --- the script -----------------------------------------------------------------------------------------------------


def main() -> None:
    """Measure one case and write the figures."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("case", choices=SCENES)
    parser.add_argument("--cuts", type=int, nargs="+", default=CUT_COUNTS)
    parser.add_argument("--no-baseline", action="store_true")
    parser.add_argument("-o", "--out", type=Path, required=True)
    given = parser.parse_args()
    from mpi4py import MPI

    figures = measure(given.case, given.cuts, baseline=not given.no_baseline)
    if MPI.COMM_WORLD.rank == 0:
        given.out.write_text(json.dumps(figures, indent=1) + "\n")


def measure(case: str, cuts: list[int], *, baseline: bool) -> dict[str, Any]:
    """Figures of one case on the ranks of this process (collective); the baseline needs one rank."""
    from mpi4py import MPI

    from ...deformable_run import Run
    from ...mesh.parallel import sum_over_ranks
    from ...scene import build_scene
    from ...study.reader import validate

    comm = MPI.COMM_WORLD
    study = validate(scene_study(case), case)
    with tempfile.TemporaryDirectory() as folder:
        inside = Path(comm.bcast(folder))
        whole, cut = (Run(build_scene(comm, study), inside / name) for name in ("whole", "cut"))
        domain = whole.scene.domain
        planes = random_planes(max(cuts), domain.bounds.lower, domain.bounds.upper)
        sizes = sum_over_ranks(comm, np.array([domain.cell_count, domain.node_count]))
        stages, done = [], 0
        for count in cuts:
            break_planes(cut, planes[done:count])
            done = count
            other = VirtualNodeBaseline(cut, whole) if baseline and comm.size == 1 else None
            stages.append({"cuts": count, **_time_stage(whole, cut, other)})
    return {"tets": int(sizes[0]), "nodes": int(sizes[1]), "ranks": comm.size, "stages": stages}


def random_planes(count: int, lower: npt.NDArray[np.float64], upper: npt.NDArray[np.float64]) -> list[Any]:
    """(normal, point) of planes, always the same: the first across the middle, the others anywhere in the body."""
    random = np.random.default_rng(1)
    normals = random.normal(size=(count, 3))
    points = lower + (upper - lower) * random.uniform(0.05, 0.95, (count, 3))
    if count:
        # off the middle by an odd share, lest it meet the nodes of a lattice
        normals[0], points[0] = (1.0, 0.0, 0.0), lower + 0.5013 * (upper - lower)
    return list(zip(normals, points, strict=True))


def break_planes(run: Any, planes: list[Any]) -> None:
    """Break all edges across the planes (collective)."""
    if not planes:
        return
    fracture, domain = run.scene.fracture, run.scene.domain
    flags = np.zeros(len(fracture.graph.broken), bool)
    for normal, point in planes:
        side = (domain.nodes - point) @ normal >= 0
        flags |= side[fracture.graph.edge_nodes[:, 0]] != side[fracture.graph.edge_nodes[:, 1]]
    break_edges(run, flags)


class VirtualNodeBaseline:
    """Baseline with duplicated cut cells on a new mesh, with the motion transferred."""

    def __init__(self, run: Any, whole: Any) -> None:
        """Duplicate the cut cells of `run` and transfer the motion of the `whole` body.

        The motion of the cut body is not used: nodes that a cut detaches from all cells would invert the copies.
        """
        from ...mesh.domain import distribute
        from ...mesh.simplices import node_groups
        from ...scene import build_material, build_scene_on, make_stepper
        from ...timestepping.inelastic_update import NoFracture, NoPlasticFlow
        from .virtual_nodes import duplicate_cut_cells

        began = time.perf_counter()
        old, study, graph = run.scene.domain, run.scene.study, run.scene.fracture.graph
        self.new = duplicate_cut_cells(old.cell_nodes, node_groups(old.dim)[graph.pattern], old.node_count)
        domain = distribute(old.comm, self._mesh(old))
        share = self.new.share[domain.input_numbering.cells]
        material = build_material(study, domain)
        scene = build_scene_on(domain, study, replace(material, density=share * material.density))
        assert scene.balance.stress.chi is not None
        scene.balance.stress.chi.x.array[: len(share)] = share
        self.stepper = make_stepper(scene.balance, study.time, NoPlasticFlow(), NoFracture(scene.balance), scene.solver)
        self.state = scene.start()
        self._transfer_motion(whole.state, domain)
        self.unknowns = 3 * len(self.new.node)
        self.rebuild = time.perf_counter() - began

    def _mesh(self, old: Any) -> Any:
        """Mesh with copies; a facet group contains the facets of copies that own a node of them."""
        from ...meshes.data import MeshData

        new, groups = self.new, {}
        local = np.array([[k for k in range(4) if k != face] for face in range(4)])
        faces, owned = new.cells[:, local].reshape(-1, 3), new.owned[:, local].reshape(-1, 3).any(axis=1)
        keys = np.sort(new.node[faces], axis=1) @ (old.node_count ** np.arange(3, dtype=np.int64))
        for name, facets in old.facets.groups.items():
            geometry = _facet_nodes(old, facets)
            wanted = np.sort(geometry, axis=1) @ (old.node_count ** np.arange(3, dtype=np.int64))
            groups[name] = faces[owned & np.isin(keys, wanted)]
        return MeshData(old.nodes[new.node], new.cells, groups)

    def _transfer_motion(self, state: Any, domain: Any) -> None:
        """Transfer displacement and velocity of the original nodes to all copies."""
        source = self.new.node[domain.input_numbering.nodes]
        u, v = (x.reshape(-1, 3)[source].ravel().copy() for x in (state.u, state.v))
        self.state = self.stepper.with_forces(replace(self.state, u=u, v=v, t=state.t, step=state.step))

    def step(self) -> Any:
        """Advance by one step and return its report."""
        self.state, report = self.stepper.advance(self.state)
        return report


def _facet_nodes(domain: Any, facets: Any) -> Any:
    """Nodes (n, 3) of local facets."""
    topology = domain.mesh.topology
    topology.create_connectivity(2, 0)
    topology.create_connectivity(3, 0)
    to_node = np.empty(topology.index_map(0).size_local, np.int64)
    to_node[topology.connectivity(3, 0).array.reshape(-1, 4)] = domain.cell_nodes
    return to_node[topology.connectivity(2, 0).array.reshape(-1, 3)[facets]]


def _time_stage(whole: Any, cut: Any, other: VirtualNodeBaseline | None) -> dict[str, Any]:
    """Seconds per step of the loops, one step of each in turn."""
    from ...mesh.parallel import sum_over_ranks
    from ..bench import time_call

    loops = {"whole": whole.scene.stepper, "cut": cut.scene.stepper}
    steps = {"whole": whole.step, "cut": cut.step}
    if other is not None:
        loops["baseline"], steps["baseline"] = other.stepper, other.step
    times: dict[str, list[float]] = {name: [] for name in loops}
    krylov: dict[str, list[int]] = {name: [] for name in loops}
    for number in range(WARM_UP_STEPS + TIMED_STEPS):
        for name, step in steps.items():
            if name == "baseline" and number >= WARM_UP_STEPS + BASELINE_STEPS:
                continue
            times[name].append(time_call(cut.comm, step))
            krylov[name].append(int(loops[name].solver.snes.getLinearSolveIterations()))
    broken, split, pieces = cut.breaks.counts
    dofs = int(sum_over_ranks(cut.comm, len(cut.state.u))[0])
    ratios = {
        f"{name}_ratio": median(
            a / b for a, b in zip(times[name][WARM_UP_STEPS:], times["whole"][WARM_UP_STEPS:], strict=False)
        )
        for name in loops
        if name != "whole"
    }
    seconds = {name: median(values[WARM_UP_STEPS:]) for name, values in times.items()}
    spread = {
        f"{name}_spread": (max(values[WARM_UP_STEPS:]) - min(values[WARM_UP_STEPS:])) / 2
        for name, values in times.items()
    }
    its = {f"{name}_krylov": int(median(counts[WARM_UP_STEPS:])) for name, counts in krylov.items()}
    about = {"rebuild": other.rebuild, "baseline_unknowns": other.unknowns} if other is not None else {}
    first = {"first_step": times["cut"][0]}
    return {
        "broken_edges": broken, "split_cells": split, "pieces": pieces, "unknowns": dofs,
        **seconds, **spread, **ratios, **its, **first, **about,
    }  # fmt: skip


# --- the section ----------------------------------------------------------------------------------------------------


def sections(records: list[dict[str, Any]]) -> list[Section]:
    """Sections on the cost of cracks and on the resolution of the loaf."""
    cuts = [record for record in records if record["case"] != "loaf"]
    return [_cost_section(cuts), _resolution_section([record for record in records if record["case"] == "loaf"])]


def _cost_section(records: list[dict[str, Any]]) -> Section:
    """Section on the cost of a step against the number of cracks."""
    columns = (
        "scene", "ranks", "tets", "nodes", "cuts", "broken edges", "split cells", "pieces",
        "s a step", "±", "over uncut", "CG", "CG uncut", "unknowns",
        "baseline s a step", "± ", "baseline over uncut", "baseline CG", "baseline unknowns",
        "baseline rebuild s", "outcome",
    )  # fmt: skip
    rows = tuple(row for record in records for row in _table_rows(record))
    caption = (
        "Seconds per step after planes cut a body: this method, and cut cells duplicated with virtual nodes (1 rank)"
    )
    text = (
        f"Medians of {TIMED_STEPS} steps ({BASELINE_STEPS} of the baseline) and half their range, timed in turn "
        f"with the same "
        "body uncut; ratios are medians of those of single steps. One Newton iteration a step and CG to 1e-6 in all "
        "loops; CG: its iterations. "
        f"{PUBLISHED}\n\nThe baseline shares forms, solver and stepper with the program, has no fracture pass, and "
        "runs on one rank only; its rebuilding (duplication, mesh, matrix) is not part of its seconds per step."
    )
    return Section(
        "Growth: cost of a step against the number of cracks", text, (_claim(records),),
        (ReportTable("growth", caption, columns, rows),), tuple(_plots(records)),
    )  # fmt: skip


def _stages(record: dict[str, Any]) -> list[dict[str, Any]]:
    """Stages of a record; empty if it failed."""
    return list(record["figures"].get("stages", []))


def _table_rows(record: dict[str, Any]) -> list[tuple[TableCell, ...]]:
    """Rows of a record, one a stage."""
    figures = record["figures"]
    head = (record["case"], record["ranks"], figures.get("tets"), figures.get("nodes"))
    keys = (
        "cuts", "broken_edges", "split_cells", "pieces", "cut", "cut_spread", "cut_ratio",
        "cut_krylov", "whole_krylov", "unknowns", "baseline", "baseline_spread", "baseline_ratio", "baseline_krylov",
        "baseline_unknowns", "rebuild",
    )  # fmt: skip
    outcome = record["outcome"] if record["outcome"] == "done" else f"{record['outcome']}: {record['message']}"
    return [(*head, *(stage.get(key) for key in keys), outcome) for stage in _stages(record) or [{}]]


def _claim(records: list[dict[str, Any]]) -> Claim:
    """Claim on the cost of a step after the last cut."""
    last = {f"{record['case']} on {record['ranks']}": _stages(record)[-1] for record in records if _stages(record)}
    worst = [f"{name} {stage['cut_ratio']:.2f}" for name, stage in last.items()]
    beside = [f"{name} {stage['baseline_ratio']:.2f}" for name, stage in last.items() if "baseline_ratio" in stage]
    holds = None
    if last:
        failed = any(record["outcome"] != "done" for record in records)
        holds = not failed and all(stage["cut_ratio"] <= MAX_RATIO for stage in last.values())
    measured = f"{', '.join(worst) or 'nothing'}; the baseline: {', '.join(beside) or 'nothing'}"
    return Claim(f"A step after the last cut costs at most {MAX_RATIO} times one of the uncut body", measured, holds)


def _plots(records: list[dict[str, Any]]) -> list[Plot]:
    """Cost over cracks, unknowns over cracks (1 rank), and cost over size."""
    single = [record for record in records if record["ranks"] == 1 and _stages(record)]
    cost, size = [], []
    for record in single:
        cuts = tuple(float(max(stage["cuts"], 0.5)) for stage in _stages(record))
        for key, label in (("cut", "this method"), ("baseline", "virtual nodes")):
            ratio = tuple(stage.get(f"{key}_ratio") for stage in _stages(record))
            cost.append(Series(f"{record['case']}, {label}", cuts, ratio))
        unknowns = tuple(stage.get("baseline_unknowns", np.nan) / stage["unknowns"] for stage in _stages(record))
        size.append(Series(record["case"], cuts, unknowns))
    by_size = tuple(
        _size_series(single, key, label) for key, label in (("cut", "this method"), ("baseline", "virtual nodes"))
    )
    x = "planes that cut (0 drawn at 0.5)"
    return [
        Plot("Step after cuts over step of the uncut body", x, "s / s", tuple(cost), "loglog", levels=(1.0, MAX_RATIO)),
        Plot("Unknowns of the baseline over those of this method", x, "ratio", tuple(size), "loglog", levels=(1.0,)),
        Plot("Seconds per step at the last number of cuts, over size", "tetrahedra", "s a step", by_size, "loglog"),
    ]


def _size_series(records: list[dict[str, Any]], key: str, label: str) -> Series:
    """Seconds per step over the number of tetrahedra."""
    points = sorted((record["figures"]["tets"], _stages(record)[-1].get(key)) for record in records)
    return Series(label, tuple(float(x) for x, _ in points), tuple(y for _, y in points))


def _resolution_section(records: list[dict[str, Any]]) -> Section:
    """Section on the loaf at three resolutions."""
    columns = (
        "loaf", "h m", "tets", "ranks", "steps", "s a step", "wall s", "broken edges", "pieces", "peak memory MiB",
        "outcome",
    )  # fmt: skip
    rows = tuple(_loaf_row(record) for record in records)
    text = (
        "The loaf of studies/loaf.toml torn at three resolutions (M22 fig. 14: 1.5k, 38k and 620k tets in 0.013, 0.31 "
        "and 4.38 s a frame on 12 threads). The radius of the average stays 12 mm, less than an edge of the coarsest "
        "mesh."
    )
    table = ReportTable("resolution", "The loaf at three resolutions; s a step: solve and fracture", columns, rows)
    pictures = tuple(
        Picture(
            f"{record['name']}: h = {record['settings']['h']} m",
            f"{record_folder(record)}/run/last.png",
            record["command"],
        )
        for record in records
    )
    return Section("Resolution of the loaf", text, tables=(table,), pictures=pictures)


def _loaf_row(record: dict[str, Any]) -> tuple[TableCell, ...]:
    """Row of a loaf."""
    summary = record["summary"] or {}
    steps = summary.get("steps")
    seconds = record["stepping"][-1] / steps if steps and record["stepping"] else None
    return (
        record["name"], record["settings"]["h"], summary.get("cells"), record["ranks"], steps, seconds,
        record["wall"][-1], summary.get("broken_edges"), summary.get("pieces"), summary.get("peak_memory_MiB"),
        record["outcome"],
    )  # fmt: skip


if __name__ == "__main__":
    main()
