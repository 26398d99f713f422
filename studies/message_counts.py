"""Messages, bytes and seconds of each rank by phase of a run, for docs/scaling.md.

    python3 -m fracsim.studies.message_counts [-o out/messages.json] [--strong 6] [--weak 2000] [--ranks 1 2 4 8 16]

The scene is the box of `bench`. Strong scaling has 24 n^3 tetrahedra on any number of ranks, weak scaling about as many
for each rank as --weak says. Phases are the set-up, a step (mean of four), a step after the edges across the middle
broke, and a frame with fields and surface. A library that is loaded before MPI counts what each process sends; on more
ranks than cores the counts are right, and seconds are not.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

from .bench import bench_study, break_edges, time_call

SOURCE = Path(__file__).with_suffix(".c")
KINDS = ("messages", "message_bytes", "collectives", "collective_bytes")
STEPS = 4


def compile_counter(folder: Path) -> Path:
    """Library that counts messages, compiled for the MPI at hand. Raises SystemExit if there is no compiler of MPI."""
    compiler = shutil.which("mpicc")
    if compiler is None:
        sys.exit("message_counts: there is no mpicc (Debian: libopenmpi-dev; the wheel mpich has one)")
    library = folder / "message_counts.so"
    subprocess.run([compiler, "-O2", "-shared", "-fPIC", "-o", library, SOURCE], check=True)
    return library


def phase_counts(n: int) -> dict[str, Any]:
    """Counts and seconds of each phase on the ranks of this process: mean and largest over the ranks (collective)."""
    import ctypes

    import numpy as np
    from mpi4py import MPI

    from ..deformable_run import Run
    from ..scene import build_scene
    from ..study.reader import validate

    comm = MPI.COMM_WORLD
    library = ctypes.CDLL(None)
    phases: dict[str, Any] = {}

    def counted(name: str, work: Any, calls: int = 1) -> Any:
        before, after = ((ctypes.c_longlong * len(KINDS))() for _ in range(2))
        result: list[Any] = []
        library.message_counts(before)
        seconds = time_call(comm, lambda: result.extend(work() for _ in range(calls)))
        library.message_counts(after)
        own = (np.array(after[:]) - np.array(before[:])) / calls
        # without the two barriers of time_call
        own[KINDS.index("collectives")] -= 2 / calls
        everything = np.array(comm.allgather(own))
        columns = zip(KINDS, everything.T, strict=True)
        phases[name] = {kind: [float(column.mean()), float(column.max())] for kind, column in columns}
        phases[name]["seconds"] = seconds / calls
        return result[-1]

    with tempfile.TemporaryDirectory() as folder:
        study = bench_study(n)
        study["output"] |= {"surface": True, "fields": ["damage", "stress"]}
        out = Path(comm.bcast(folder))
        run = counted("set-up", lambda: Run(build_scene(comm, validate(study, "messages")), out))
        run.step()
        counted("step", run.step, STEPS)
        graph = run.scene.fracture.graph
        is_above = graph.domain.nodes[graph.edge_nodes][:, :, 2] > 2.0
        break_edges(run, is_above[:, 0] != is_above[:, 1])
        run.step()
        counted("step after a break", run.step, STEPS)
        counted("frame", run.write_frame)
    return {"tetrahedra": 24 * n**3, "ranks": comm.size, "phases": phases}


def run_cases(cases: list[tuple[str, int, int]]) -> list[dict[str, Any]]:
    """Figures of cases (scaling, n, ranks), each in processes of its own."""
    figures = []
    with tempfile.TemporaryDirectory() as folder:
        library = compile_counter(Path(folder))
        environment = dict(os.environ) | {"OMP_NUM_THREADS": "1", "LD_PRELOAD": str(library)}
        for scaling, n, ranks in cases:
            out = Path(folder) / "figures.json"
            worker = [sys.executable, "-m", "fracsim.studies.message_counts", "--case", str(n), "-o", str(out)]
            command = ["env", *(f"{key}={environment[key]}" for key in ("OMP_NUM_THREADS", "LD_PRELOAD")), *worker]
            oversubscribe = ["--oversubscribe"] if ranks > (os.cpu_count() or 1) else []
            subprocess.run(["mpirun", "-n", str(ranks), *oversubscribe, *command], check=True, timeout=1800)
            figures.append({"scaling": scaling, **json.loads(out.read_text())})
            print(_row(figures[-1]), flush=True)
    return figures


def _row(case: dict[str, Any]) -> str:
    step = case["phases"]["step"]
    size = f"{case['scaling']:7}{case['tetrahedra']:9,} tetrahedra {case['ranks']:3} ranks"
    sent = f"{step['messages'][0]:.0f} messages, {step['message_bytes'][0] / 1e3:.0f} kB"
    return f"{size}: a step {step['seconds']:.3f} s, {sent}, {step['collectives'][0]:.0f} collectives"


def _run_worker(n: int, out: Path) -> None:
    """Write the figures of a case on the ranks of this process (collective)."""
    from mpi4py import MPI

    figures = phase_counts(n)
    if MPI.COMM_WORLD.rank == 0:
        out.write_text(json.dumps(figures))


def main() -> None:
    """Run the cases, or the one of a worker, and write the figures as JSON."""
    parser = argparse.ArgumentParser(description=str(__doc__).split("\n", maxsplit=1)[0])
    parser.add_argument("-o", "--out", type=Path, default=Path("out/messages.json"))
    parser.add_argument("--strong", type=int, default=6, metavar="N", help="24 N^3 tetrahedra in all")
    parser.add_argument("--weak", type=int, default=2000, metavar="CELLS", help="tetrahedra of each rank")
    parser.add_argument("--ranks", type=int, nargs="+", default=[1, 2, 4, 8, 16])
    parser.add_argument("--case", type=int, metavar="N", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.case:
        _run_worker(options.case, options.out)
        return
    strong = [("strong", options.strong, ranks) for ranks in options.ranks]
    weak = [("weak", max(2, round((options.weak * ranks / 24) ** (1 / 3))), ranks) for ranks in options.ranks]
    figures = run_cases([*strong, *weak])
    options.out.parent.mkdir(parents=True, exist_ok=True)
    options.out.write_text(json.dumps(figures, indent=1))


if __name__ == "__main__":
    main()
