"""`python3 -m attack`: all attacks, or some of them, and a table of what came of them."""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
import time
from importlib import import_module
from pathlib import Path

from .trial import Tally, run_trials

# In full; those in processes of their own first, then those in processes that are forked from one which has imported
# what a run needs.
FULL = {
    "kills": 100,
    "signals": 30,
    "disks": 20,
    "pairs": 10,
    "links": 60,
    "checkpoints": 200,
    "meshes": 300,
    "studies": 4000,
}
FORKED = ("links", "checkpoints", "meshes", "studies")


def main() -> int:
    """The exit code: 1 where a trial failed."""
    asked = argparse.ArgumentParser(prog="attack", description=__doc__)
    for kind, count in FULL.items():
        asked.add_argument(f"--{kind}", type=int, default=None, help=f"trials ({count})")
    asked.add_argument("--seed", type=int, default=None, help="of all chance; default: of the clock")
    asked.add_argument("--only", default="", help="kind:number,number of trials to be repeated, or kinds, by commas")
    asked.add_argument("--quick", action="store_true", help="a twentieth of the trials")
    asked.add_argument("-o", "--out", type=Path, default=None, help="where folders of failed trials stay")
    given = asked.parse_args()
    seed = given.seed if given.seed is not None else int(time.time()) % 1_000_000
    folder = (given.out or Path(tempfile.mkdtemp(prefix="fracsim-attack-"))).absolute()
    folder.mkdir(parents=True, exist_ok=True)
    print(f"attack: seed {seed}, folders of failed trials in {folder}", flush=True)
    tallies = []
    for kind, numbers in _chosen(given):
        module = import_module(f"attack.{kind}")
        if kind in FORKED:
            _import_all()
        if hasattr(module, "prepare"):
            module.prepare(folder)
        tallies.append(run_trials(kind, module.attack, numbers, seed, folder))
        _tell([tallies[-1]])
    print(f"\nseed {seed}")
    _tell(tallies)
    for tally in tallies:
        for number, _ in tally.failures:
            print(f"again: make attack seed={seed} only={tally.kind}:{number}")
    return int(any(tally.failures for tally in tallies))


def _chosen(given: argparse.Namespace) -> list[tuple[str, list[int]]]:
    """Kinds, and the numbers of their trials."""
    if ":" in given.only:
        kind, _, numbers = given.only.partition(":")
        return [(kind, [int(each) for each in numbers.split(",")])]
    only = given.only.split(",") if given.only else list(FULL)
    counts = {kind: getattr(given, kind) for kind in FULL}
    some = any(count is not None for count in counts.values())  # where counts are given, all others are 0
    full = {kind: 0 if some else -(-count // 20) if given.quick else count for kind, count in FULL.items()}
    wanted = {kind: full[kind] if counts[kind] is None else counts[kind] for kind in only}
    return [(kind, list(range(count))) for kind, count in wanted.items() if count]


def _import_all() -> None:
    """What runs need, once for all processes that are forked from here on."""
    import gmsh  # noqa: F401
    import h5py  # noqa: F401
    import meshio  # noqa: F401

    import fracsim.deformable_run
    import fracsim.rigid_run
    import fracsim.scene.rigid_scene
    import fracsim.study.check  # noqa: F401


def _tell(tallies: list[Tally]) -> None:
    print(f"{'attack':12} {'trials':>7} {'failed':>7} {'seconds':>8}  ended")
    for tally in tallies:
        ends = ", ".join(f"{count} {end}" for end, count in sorted(tally.ends.items(), key=lambda each: -each[1]))
        print(f"{tally.kind:12} {tally.trials:7} {len(tally.failures):7} {tally.seconds:8.0f}  {ends}", flush=True)


if __name__ == "__main__":
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    sys.exit(main())
