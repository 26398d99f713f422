"""Scenes that are built, used and dropped without `destroy`: what is left of them, by PETSc's own count and MPI's."""

from __future__ import annotations

import re
import tempfile
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

from mpi4py import MPI
from petsc4py import PETSc

from cases import BAR, STRIP, study
from fracsim.scene import build_scene
from fracsim.solvers import policy, weak_callbacks
from support.scenes import Walk

IN_USE = "living objects of PETSc", "communicators", "options", "MiB"
KINDS: dict[str, dict[str, Any]] = {
    "bar": {"base": BAR},
    "strip": {"base": STRIP, "fracture": {"crumbs": False}},
    "contact": {"base": STRIP, "contact": {}, "fracture": {"crumbs": False}},
    "quasi-static": {"base": STRIP, "time": {"scheme": "quasi-static"}},
    "explicit": {"base": STRIP, "time": {"scheme": "explicit"}},
    "consistent": {"base": STRIP, "time": {"mass": "consistent"}},
    "obstacle": {
        "base": BAR, "load": {"gravity": [0.0, 0.0, -9.81]},
        "obstacle": [{"name": "ball", "shape": "sphere", "radius": 0.1, "at": [0.5, 0.1, 0.4], "mass": 0.1}],
    },
}  # fmt: skip


def build_and_drop(kind: str, count: int, steps: int) -> Iterator[None]:
    """Build a scene, take some steps and drop it, so many times; small bodies are multiplied with in blocks, too."""
    policy.DEFAULT_POLICY = replace(policy.DEFAULT_POLICY, min_block_dofs=0)
    tables = dict(KINDS[kind])
    table = study(tables.pop("base"), **tables)
    for _ in range(count):
        walk = Walk(build_scene(MPI.COMM_WORLD, table))
        for _ in range(steps):
            walk.advance()
        del walk
        yield


def in_use() -> tuple[int, int, int, float]:
    """What `IN_USE` names."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "log.txt"
        viewer = PETSc.Viewer().createASCII(str(path), "w")
        PETSc.Log.view(viewer)
        viewer.destroy()
        table = path.read_text().partition("Object Type")[2]
    counts = re.findall(r"^\s*[A-Z][\w ]*?\s+(\d+)\s+(\d+)\s*$", table, re.MULTILINE)
    living = sum(int(made) - int(gone) for made, gone in counts)
    assert len(counts) > 0
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return living, communicators(), len(PETSc.Options().getAll()), pages * 4096 / 2**20


def communicators() -> int:
    """The number that MPI gives to the next one: the lowest that is free."""
    made = MPI.COMM_SELF.Dup()
    number = made.py2f()
    made.Free()
    return number


def most_in_use(kind: str, count: int, steps: int, every: int) -> Any:
    """In the first half of so many scenes, and in the second, the most of what is in use."""
    PETSc.Log.begin()
    halves: list[list[tuple[int, int, int, float]]] = [[], []]
    for number, _ in enumerate(build_and_drop(kind, count, steps)):
        if number % every == 0:
            halves[2 * number // count].append(in_use())
    return [tuple(max(column) for column in zip(*half, strict=True)) for half in halves]


if __name__ == "__main__":
    import json
    import sys

    name, *numbers, often = sys.argv[1:]
    if int(often):
        default = weak_callbacks.DEFAULT_POLICY
        weak_callbacks.DEFAULT_POLICY = replace(default, scenes_between_collections=int(often))
    print(json.dumps(most_in_use(name, *map(int, numbers))))
