"""A run beside others that resume from its checkpoints: every number of every later step, to the last digit.

By itself: `mpirun -n 2 python -m mpi4py -m support.continued OUT.npz`.
"""

from __future__ import annotations

import csv
import shutil
import sys
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from mpi4py import MPI

from fracsim.deformable_run import Run
from fracsim.scene import build_scene

from . import quadratic, shattered, tearing, torn
from .scenes import make_study
from .solver_policy import other_policy

Numbers = dict[str, npt.NDArray[Any]]
SOFT = {"young": 1.0, "poisson": 0.3, "density": 1.0}
DRAWN = [{"on": "left", "fix": "xy"}, {"on": "right", "velocity": [0.4, 0.1]}]

# name: (tables, steps, steps after which the run is stopped)
CASES: dict[str, tuple[dict[str, Any], int, tuple[int, ...]]] = {
    # explicit: contact with obstacles, a free one; of the body with itself; energy; crumbs joined; flow; surfaces;
    # edges
    "explicit-obstacles": (torn.RUNS["rapped"], 17, (7, 12)),
    "explicit-contact": (torn.RUNS["rammed"], 15, (5, 12)),
    "explicit-energy": (tearing.RUNS["begun"], 12, (5, 11)),
    "explicit-joined": (tearing.RUNS["shivered"], 25, (7, 19)),
    "explicit-ductile": (
        torn.RUNS["ductile"] | {
            "time": {"scheme": "explicit", "step": 0.05, "end": 1.0}, "fracture": {"strength": 0.2, "radius": 0.15},
        }, 30, (7, 23),
    ),
    "explicit-brittle": (
        shattered.RUNS["averaged"] | {"time": {"scheme": "explicit", "step": 0.05, "end": 1.0}}, 26, (9, 17),
    ),
    "explicit-edges": (
        torn.RUNS["plate"] | {
            "material": SOFT | {"energy": "linear"}, "time": {"scheme": "explicit", "step": 0.05, "end": 1.0},
            "fracture": {"strength": 0.2, "approach": "edge", "unilateral": True},
        }, 30, (9, 23),
    ),
    # implicit: what tears, averaged; flows; closes; touches obstacles, free ones, solids, itself; energy; surfaces
    "backward-euler": (torn.RUNS["plate"], 5, (1, 3)),
    "newmark": (torn.RUNS["block"], 4, (2,)),
    "ductile": (torn.RUNS["ductile"], 5, (2, 3)),
    "ductile-implicit": (torn.RUNS["ductile-implicit"], 4, (2,)),
    "closing": (torn.RUNS["closing"], 10, (3, 6)),
    "joined": (torn.RUNS["joined"], 8, (3, 5)),
    "obstacles": (torn.RUNS["struck"], 3, (1, 2)),
    "free-obstacles": (torn.RUNS["thrown"], 2, (1,)),
    "solids": (torn.RUNS["hewn"], 3, (1,)),
    "contact": (torn.RUNS["shut"], 11, (4, 8)),
    "contact-of-pieces": (torn.RUNS["crushed"], 6, (3,)),
    "branching": (tearing.RUNS["forked"], 16, (5, 13)),
    "brittle": (shattered.RUNS["averaged"], 5, (2, 3)),
    "grains": (shattered.RUNS["bias"], 4, (2,)),
    # quadratic displacement, damped; contact that is made stiffer in the third step; steps as a table says, and
    # shorter where edges break
    "quadratic": (quadratic.RUNS["block"], 4, (2, 3)),
    "explicit-quadratic": (quadratic.RUNS["plate"], 25, (9, 22)),
    "stiffened": (
        {"mesh": {}, "material": {"energy": "neo-hookean", "young": 1e4, "poisson": 0.3, "density": 100.0},
         "contact": {"stiffness": 3e-3, "friction": 0.2},
         "boundary": [{"on": {"box": [[-1.0, -1.0], [0.01, 2.0]]}, "fix": "xy"},
                      {"on": {"box": [[2.04, -1.0], [2.2, 2.0]]}, "velocity": [-0.6, 0.0]}],
         "time": {"scheme": "backward-euler", "step": 0.05, "end": 0.5}}, 6, (4,),
    ),
    "retaken": (
        torn.RUNS["plate"] | {
            "time": {"scheme": "newmark", "step": {"time": [0.0, 0.1, 0.3], "value": [0.08, 0.05, 0.03]}, "end": 5.0,
                     "breaking_step": 0.01},
        }, 16, (3, 9),
    ),
    # without inertia, where the next guess is extrapolated: a strength, energy, cracks that hold on
    "quasi-static": (torn.RUNS["ties"], 6, (2, 4)),
    "quasi-static-energy": (tearing.RUNS["notched"], 5, (1, 3)),
    "quasi-static-cohesive": (tearing.RUNS["cohesive"], 12, (3, 8)),
    "cohesive": (tearing.RUNS["drawn"], 30, (12, 21)),
    # one linear solve a step, whose guess is made of earlier ones
    "one-solve": (
        {"mesh": {"builder": "box", "size": [1.0, 0.25, 0.25], "h": 0.0625}, "material": SOFT | {"energy": "linear"},
         "boundary": [{"on": "left", "fix": "xyz"}, {"on": "right", "velocity": [0.1, 0.0, 0.05]}],
         "damping": {"mass": 0.1}, "time": {"scheme": "newmark", "step": 0.05, "end": 1.0}}, 8, (3, 5),
    ),
    # steps that are halved, and grow back
    "halved": (
        {"mesh": {"builder": "box", "size": [1.0, 0.25, 0.25], "h": 0.25},
         "material": {"energy": "stvk", "young": 1e6, "poisson": 0.3, "density": 1000.0},
         "boundary": [{"on": "left", "fix": "xyz"}, {"on": "right", "displacement": {
             "time": [0.0, 0.02, 0.04], "value": [[0, 0, 0], [-1.2, 0, 0], [0.01, 0, 0]]}}],
         "time": {"scheme": "backward-euler", "step": 0.01, "end": 0.08}, "solver": {"snes_max_it": 6}}, 12, (2, 4, 9),
    ),
}  # fmt: skip


def differences(comm: MPI.Intracomm, name: str, folder: Path) -> list[str]:
    """What differs between a run and those that resume from its checkpoints: the name of a case, where the run was
    stopped, the first step that differs, and in what (collective).

    Explicit runs write no checkpoint themselves. Implicit ones do, and so do those that resume: each is a place that
    all go on from alike.
    """
    tables, steps, stops = CASES[name]
    if not tables["mesh"]:
        from test_self_contact import two_blocks

        folder.mkdir(exist_ok=True)
        tables = tables | {"mesh": {"file": comm.bcast(two_blocks(folder, 2, 0.05) if comm.rank == 0 else "")}}
    explicit, found = tables["time"]["scheme"] == "explicit", []

    def begun(where: str, *, restart: bool = False) -> Run:
        study = make_study(**{"solver": {}, "output": {"picture": False, "interval": 1e9}} | tables)
        return Run(build_scene(comm, study), folder / where, restart=restart)

    going, states = begun("going"), {}
    writing = begun("writing") if explicit else going
    for step in range(1, steps + 1):
        going.step()
        states[step] = numbers(going)
        if writing is not going:
            writing.step()
        if step in stops:
            writing.checkpoint()
            if comm.rank == 0:
                shutil.copytree(writing.folder, folder / f"stopped-{step}")
            comm.Barrier()
    for stop in stops:
        again = begun(f"stopped-{stop}", restart=True)
        for step in range(stop, steps + 1):
            if step > stop:
                again.step()
            now = numbers(again) | ({"probes": states[step]["probes"]} if step == stop else {})  # of a step
            differ = other(now, states[step])
            if differ := sorted({each for some in comm.allgather(differ) for each in some}):
                found.append(f"{name}, stopped after {stop}, step {step}: {', '.join(differ)}")
                break
            if step > stop and step in stops and not explicit:
                again.checkpoint()
        if comm.rank == 0 and (differ := unlike(again.folder, going.folder)):
            found.append(f"{name}, stopped after {stop}: history.csv, {differ}")
        again.history.close()
    return found


def numbers(run: Run) -> Numbers:
    """Copies of all that a run says of its body on this rank."""
    state, scene = run.state, run.scene
    every = {
        each.name: getattr(state, each.name)
        for each in fields(state)
        if each.name not in ("history", "previous_increment")
    }
    found = {key: np.array(value) for key, value in every.items() if value is not None and key != "elastic"}
    found |= {"probes": scene.probes(), "figures": np.array(run.breaks.counts)}
    found |= {f"term.{key}": np.array(value) for key, value in scene.balance.histories.to_checkpoint().items()}
    if scene.balance.stress.chi is not None:
        found["chi"] = scene.balance.stress.chi.x.array.copy()
    if scene.fracture is not None:
        found["integrity"] = scene.fracture.graph.integrity.copy()
    if (plastic := scene.balance.stress.material.plastic) is not None:
        found["plastic"] = plastic.snapshot().copy()
    return found


def other(found: Numbers, wanted: Numbers) -> list[str]:
    """Names of arrays that are not the same to the last digit."""
    names = sorted({*found, *wanted})
    return [name for name in names if name not in found or name not in wanted
            or not np.array_equal(found[name], wanted[name], equal_nan=found[name].dtype.kind == "f")]  # fmt: skip


def unlike(folder: Path, reference: Path) -> str:
    """Columns of history.csv that are not the same in two folders, but for the time that steps took; empty: all are."""
    found, wanted = (columns(each / "history.csv") for each in (folder, reference))
    names = {*found, *wanted} - {"wall_step"}
    return ", ".join(sorted(name for name in names if found.get(name) != wanted.get(name)))


def columns(path: Path) -> dict[str, list[str]]:
    """The values of a CSV file as they are written."""
    with path.open(newline="") as file:
        head, *lines = csv.reader(file)
    return {name: [line[place] for line in lines] for place, name in enumerate(head)}


ON_RANKS = ("explicit-obstacles", "explicit-contact", "explicit-joined", "ductile", "obstacles", "contact", "branching",
            "brittle", "quasi-static-energy")  # fmt: skip


def main(path: str) -> None:
    """Some cases on all ranks; rank 0 saves what differs."""
    # Factors of MUMPS on several ranks, and what is solved with them, differ in the last digit from run to run.
    with other_policy(max_plain_direct_dofs=0):
        found = [each for name in ON_RANKS for each in differences(MPI.COMM_WORLD, name, Path(path).parent / name)]
    if MPI.COMM_WORLD.rank == 0:
        np.savez(path, differences=np.array(found))


if __name__ == "__main__":
    main(sys.argv[1])
