"""Count calls from one file of fracsim to another in an implicit step.

    python -m fracsim.studies.cross_file_calls [--ball] [--plain] [--list]

The count measures how many modules a reader has to follow. A block of rubber hangs from one face and is pulled at the
other. With `--ball` a free ball lands on a block of 243 nodes and begins to roll. The first two steps, which set up the
solver, are not counted.
"""

from __future__ import annotations

import argparse
import sys
from collections import Counter
from pathlib import Path
from types import FrameType
from typing import Any

STUDY: dict[str, Any] = {
    "title": "crossings",
    "mesh": {"builder": "box", "size": [0.5, 0.5, 1.0], "h": 0.25},
    "material": {"energy": "neo-hookean", "young": 1e7, "poisson": 0.35, "density": 1000.0},
    "boundary": [{"on": "bottom", "fix": "xyz"}, {"on": "top", "velocity": [0.0, 0.0, 1.0]}],
    "load": {"gravity": [0.0, 0.0, -9.81]},
    "time": {"scheme": "backward-euler", "step": 5e-3, "end": 1.0},
    "output": {"picture": False},
}

BALL: dict[str, Any] = {
    "title": "ball",
    "mesh": {"builder": "box", "size": [0.08, 0.08, 0.02], "h": 0.01},
    "material": {"energy": "neo-hookean", "young": 1e6, "poisson": 0.3, "density": 1000.0},
    "boundary": [{"on": "bottom", "fix": "xyz"}],
    "load": {"gravity": [0.0, 0.0, -9.81]},
    "obstacle": [{"name": "ball", "shape": "sphere", "radius": 0.015, "at": [0.04, 0.04, 0.0351], "density": 3000.0,
                  "friction": 0.3, "velocity": [0.1, 0.0, -0.3]}],
    "time": {"scheme": "backward-euler", "step": 5e-4, "end": 6e-3},
    "output": {"picture": False},
}  # fmt: skip


def count_calls(study: dict[str, Any]) -> Counter[tuple[str, str]]:
    """(calling file, called file) -> number of calls in the third step of a study."""
    from mpi4py import MPI

    from ..scene import build_scene
    from ..study.reader import validate

    scene = build_scene(MPI.COMM_SELF, validate(study, "crossings"))
    state = scene.start()
    for _ in range(2):
        state, _ = scene.stepper.advance(state)
    root, calls = str(Path(__file__).resolve().parents[1]), Counter[tuple[str, str]]()

    def count(frame: FrameType, event: str, _: Any) -> None:
        caller = frame.f_back
        while caller is not None and not caller.f_code.co_filename.startswith(root):
            caller = caller.f_back  # callbacks come through PETSc
        if event != "call" or caller is None:
            return
        first, second = caller.f_code.co_filename, frame.f_code.co_filename
        if second.startswith(root) and first != second:
            calls[first.removeprefix(f"{root}/"), second.removeprefix(f"{root}/")] += 1

    sys.setprofile(count)
    scene.stepper.advance(state)
    sys.setprofile(None)
    scene.destroy()
    return calls


def main() -> None:
    """Print the number of calls and, if asked, the calls from file to file."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--ball", action="store_true", help="a step of a free ball in contact with a block")
    parser.add_argument("--plain", action="store_true", help="with [solver] plain = true")
    parser.add_argument("--list", action="store_true", help="the calls from file to file as well")
    given = parser.parse_args()
    calls = count_calls((BALL if given.ball else STUDY) | {"solver": {"plain": True} if given.plain else {}})
    if given.list:
        for (first, second), count in calls.most_common():
            print(f"{count:5}  {first} -> {second}")
    print(f"{calls.total()} calls cross files in one implicit step")


if __name__ == "__main__":
    main()
