"""Seconds per step of fracsim beside the same loop in DOLFINx alone, for boxes of 24k, 192k and 648k tetrahedra.

    python -m fracsim.studies.bench [-o bench.json] [--boxes 10 20 30] [--ranks 1 2]

A box of 1 x 1 x 4 m of neo-Hookean rubber (10 MPa) hangs from one end and is pulled at the other. Scheme: backward
Euler with steps of 5 ms, one Newton iteration each, CG to 1e-6.

Both loops run in one process, one step of each in turn, so that disturbances of the machine affect both. They share
solver options, compiler flags and the preconditioner's policy (built once, since the body does not change). The bare
loop assembles as a user of DOLFINx does, by dolfinx.fem.petsc. Figures are medians over the steps.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

TIMED_STEPS, WARM_UP_STEPS = 8, 2
EVENTS = {
    "residual": "SNESFunctionEval",
    "tangent": "SNESJacobianEval",
    "preconditioner": "PCSetUp",
    "krylov": "KSPSolve",
}
OPTIONS: dict[str, Any] = {"snes_type": "ksponly", "ksp_rtol": 1e-6}


def bench_study(n: int) -> dict[str, Any]:
    """Study with n cells along a metre: 24 n^3 tetrahedra. The stress stays below the strength."""
    return {
        "title": f"bench {24 * n**3} tetrahedra",
        "mesh": {"builder": "box", "size": [1.0, 1.0, 4.0], "h": 1 / n},
        "material": {"energy": "neo-hookean", "young": 1e7, "poisson": 0.35, "density": 1000.0},
        "fracture": {"strength": 4e6},
        "boundary": [{"on": "bottom", "fix": "xyz"}, {"on": "top", "velocity": [0.0, 0.0, 1.0]}],
        "load": {"gravity": [0.0, 0.0, -9.81]},
        "time": {"scheme": "backward-euler", "step": 5e-3, "end": 1.0},
        "solver": OPTIONS,
        "output": {"every": 1000, "picture": False},
    }


# --- one case, run under mpirun -------------------------------------------------------------------------------------


def run_case(n: int, bare: bool) -> dict[str, Any]:
    """Figures of one box on the ranks of this process (collective)."""
    import numpy as np
    from mpi4py import MPI
    from petsc4py import PETSc

    from ..deformable_run import Run
    from ..scene import build_scene
    from ..study.reader import validate

    PETSc.Log.begin()
    comm = MPI.COMM_WORLD
    with tempfile.TemporaryDirectory() as folder:
        run = Run(build_scene(comm, validate(bench_study(n), "bench")), Path(comm.bcast(folder)))
        loop = BareLoop(n, run.scene.domain) if bare else None
        stage = PETSc.Log.Stage("fracsim")
        times: dict[str, list[float]] = {name: [] for name in ("step", "bare", "fracture", *EVENTS)}
        for _ in range(WARM_UP_STEPS + TIMED_STEPS):
            _timed_step(run, stage, times)
            if loop is not None:
                times["bare"].append(time_call(comm, loop.step))
        figures = {name: float(np.median(values[WARM_UP_STEPS:])) for name, values in times.items() if values}
        figures["output"] = time_call(comm, run.write_frame)
        figures["after_fracture"] = _after_fracture(run, stage)
    memory = comm.allreduce(_peak_memory())
    return {"tetrahedra": 24 * n**3, "ranks": comm.size, "peak_memory_GiB": memory, **figures}


def _timed_step(run: Any, stage: Any, times: dict[str, list[float]]) -> None:
    """Append the seconds of one step and of its phases to `times`."""
    from petsc4py import PETSc

    events = {name: PETSc.Log.Event(event) for name, event in EVENTS.items()}
    before = {name: event.getPerfInfo(stage)["time"] for name, event in events.items()}
    fracture = run.scene.stepper.phases["fracture"]
    stage.push()
    times["step"].append(time_call(run.comm, run.step))
    stage.pop()
    for name, event in events.items():
        times[name].append(event.getPerfInfo(stage)["time"] - before[name])
    times["fracture"].append(run.scene.stepper.phases["fracture"] - fracture)


def break_edges(run: Any, flags: Any) -> None:
    """Break the flagged edges and update all that depends on them, as a fracture pass does (collective)."""
    fracture = run.scene.fracture
    fracture.graph.break_edges(flags)
    fracture.graph.break_unloaded_edges()
    fracture.degradation(True, *fracture.evaluate_undamaged_stress())
    fracture.mark_changed()
    run.state = run.scene.stepper.inelastic.with_snapshot(run.state)
    run.record_breaks()
    run.scene.balance.damage_changed()
    run.scene.solver.edges_broke(None)


def _after_fracture(run: Any, stage: Any) -> float:
    """Median seconds of a step with all edges broken."""
    import numpy as np

    break_edges(run, np.ones(len(run.scene.fracture.graph.broken), bool))
    times: dict[str, list[float]] = {name: [] for name in ("step", "fracture", *EVENTS)}
    for _ in range(WARM_UP_STEPS + TIMED_STEPS):
        _timed_step(run, stage, times)
    return float(np.median(times["step"][WARM_UP_STEPS:]))


def time_call(comm: Any, work: Any) -> float:
    """Wall time of `work()` in s, between two barriers (collective)."""
    comm.Barrier()
    began = time.perf_counter()
    work()
    comm.Barrier()
    return time.perf_counter() - began


def _peak_memory() -> float:
    """Peak resident memory of this process, GiB."""
    import resource

    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024**2


class BareLoop:
    """Time loop of the same scene in DOLFINx and PETSc alone: assemble, solve, update."""

    def __init__(self, n: int, domain: Any, *, records: bool = False, in_lanes: bool = False) -> None:
        """Compile forms and set up matrix, vectors and solver.

        Args:
            n: cells along a metre.
            domain: distributed mesh.
            records: evaluate the elastic energy of each step, as every run does for history.csv.
            in_lanes: assemble the tangent as fracsim does, by single entries (mechanics.matrix_assembly).
        """
        import numpy as np
        import ufl
        from dolfinx import fem
        from dolfinx.fem import petsc as fem_petsc
        from petsc4py import PETSc

        from ..forms.balance import elastic_energy, internal_work
        from ..forms.energies import NeoHookean, lame
        from ..mechanics.jit import jit_options
        from ..mechanics.matrix_assembly import TangentAssembler
        from ..solvers.preconditioner import GAMG_OPTIONS
        from ..solvers.tangent_operators import near_nullspace

        scene = bench_study(n)
        V, mesh = domain.space, domain.mesh
        self.dt, self.petsc, self.fem_petsc, self.PETSc = scene["time"]["step"], fem_petsc, fem_petsc, PETSc
        self.u, self.g = fem.Function(V), fem.Function(V)
        energy = NeoHookean(*(fem.Constant(mesh, np.float64(value)) for value in lame(1e7, 0.35)))
        w, dx = ufl.TestFunction(V), ufl.Measure("dx", domain=mesh)
        residual = internal_work(energy, self.u, w, dx)
        self.R = fem.form(residual, jit_options=jit_options())
        self.K = fem.form(ufl.derivative(residual, self.u, ufl.TrialFunction(V)), jit_options=jit_options())
        self.integrate = fem.assemble_scalar
        self.stored: Any = None
        if records:
            self.stored = fem.form(elastic_energy(energy, self.u, dx), jit_options=jit_options())
        vertex = dx(metadata={"quadrature_rule": "vertex", "quadrature_degree": 1})
        mass = fem_petsc.assemble_vector(fem.form(1000.0 * ufl.inner(fem.Constant(mesh, np.ones(3)), w) * vertex))
        mass.ghostUpdate(PETSc.InsertMode.ADD, PETSc.ScatterMode.REVERSE)
        self.mass = mass.array_r.copy()
        self.weight = self.mass * np.tile([0.0, 0.0, -9.81], len(self.mass) // 3)
        bottom, top = (fem.locate_dofs_topological(V, 2, domain.facets.groups[name]) for name in ("bottom", "top"))
        self.top = top
        self.bcs = [fem.dirichletbc(self.g, np.sort(np.concatenate([bottom, top])).astype(np.int32))]
        rows, owned = self.bcs[0].dof_indices()
        self.held = rows[:owned]
        self.assembly = TangentAssembler(self.K) if in_lanes else None
        self.A = self.assembly.matrix if self.assembly is not None else fem_petsc.create_matrix(self.K)
        self.b = fem_petsc.create_vector(self.R)
        self.A.setNearNullSpace(near_nullspace(domain))
        self.diagonal, self.du = self.A.createVecLeft(), self.A.createVecLeft()
        self.ksp = PETSc.KSP().create(mesh.comm)
        self.ksp.setOptionsPrefix("bare_")
        options = PETSc.Options()
        for key, value in (GAMG_OPTIONS | {"ksp_type": "cg", "ksp_rtol": 1e-6}).items():
            options[f"bare_{key}"] = str(value).lower() if isinstance(value, bool) else value
        self.ksp.setFromOptions()
        self.ksp.setOperators(self.A)
        self.t, self.v, self.u_n = 0.0, np.zeros_like(self.mass), np.zeros_like(self.mass)

    def step(self) -> None:
        """Advance by one backward Euler step with one Newton iteration."""
        PETSc, n = self.PETSc, len(self.mass)
        self.t += self.dt
        self.g.x.array.reshape(-1, 3)[self.top, 2] = self.t
        predicted = self.u_n + self.dt * self.v
        self.u.x.array[:n] = predicted
        self.u.x.array[self.held] = self.g.x.array[self.held]
        self.u.x.scatter_forward()
        with self.b.localForm() as local:
            local.set(0.0)
        self.fem_petsc.assemble_vector(self.b, self.R)
        self.b.ghostUpdate(PETSc.InsertMode.ADD, PETSc.ScatterMode.REVERSE)
        rows = self.b.array_w
        rows += self.mass * (self.u.x.array[:n] - predicted) / self.dt**2 - self.weight
        rows[self.held] = 0.0
        self._assemble()
        self.diagonal.array_w[:] = self.mass / self.dt**2
        self.A.setDiagonal(self.diagonal, PETSc.InsertMode.ADD)
        self.ksp.solve(self.b, self.du)
        self.ksp.pc.setReusePreconditioner(True)
        self.u.x.array[:n] -= self.du.array_r
        self.u.x.scatter_forward()
        self.v = (self.u.x.array[:n] - self.u_n) / self.dt
        self.u_n = self.u.x.array[:n].copy()
        if self.stored is not None:
            self.energy = self.integrate(self.stored)

    def _assemble(self) -> None:
        """Assemble the tangent."""
        if self.assembly is not None:
            self.assembly(self.bcs)
            return
        self.A.zeroEntries()
        self.fem_petsc.assemble_matrix(self.A, self.K, self.bcs)  # type: ignore[arg-type]
        self.A.assemble()


# --- all cases ------------------------------------------------------------------------------------------------------


def launch_case(n: int, ranks: int, bare: bool) -> dict[str, Any]:
    """Run one case in separate processes and return its figures."""
    command = ["mpirun", "-n", str(ranks), sys.executable, "-m", "fracsim.studies.bench", "--case", str(n)]
    output = subprocess.run(
        [*command, *(["--bare"] if bare else [])], check=True, capture_output=True, timeout=1800, text=True
    )
    line = next(line for line in output.stdout.splitlines() if line.startswith("{"))
    result: dict[str, Any] = json.loads(line)
    return result


def format_table(cases: list[dict[str, Any]]) -> str:
    """Table of seconds and ratios as text."""
    parts = ("step", "bare", *EVENTS, "fracture", "output", "after_fracture")
    ratios = {
        "step/bare": ("step", "bare"),
        "pass/step": ("fracture", "step"),
        "after/before": ("after_fracture", "step"),
    }
    head = ["tetrahedra", "ranks", *(part.replace("_fracture", "") for part in parts), *ratios, "GiB"]
    rows = [
        [str(row["tetrahedra"]), str(row["ranks"])]
        + [f"{row[part]:.4f}" for part in parts]
        + [f"{row[a] / row[b]:.3f}" for a, b in ratios.values()]
        + [f"{row['peak_memory_GiB']:.2f}"]
        for row in cases
    ]
    widths = [max(len(title), 9) for title in head]
    return "\n".join(" ".join(map(str.rjust, row, widths)) for row in [head, *rows])


def main() -> None:
    """Run one case, or all of them, and write the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("-o", "--out", type=Path, default=Path("out/bench.json"))
    parser.add_argument("--boxes", type=int, nargs="+", default=[10, 20, 30])
    parser.add_argument("--ranks", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--case", type=int, help=argparse.SUPPRESS)
    parser.add_argument("--bare", action="store_true", help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.case is not None:
        from mpi4py import MPI

        figures = run_case(given.case, given.bare)
        if MPI.COMM_WORLD.rank == 0:
            print(json.dumps(figures), flush=True)
        return
    cases = []
    for n in given.boxes:
        for ranks in given.ranks:
            row = launch_case(n, ranks, bare=True)
            row["peak_memory_GiB"] = launch_case(n, ranks, bare=False)["peak_memory_GiB"]  # of the program alone
            cases.append(row)
            print(format_table([row]), flush=True)
    given.out.parent.mkdir(parents=True, exist_ok=True)
    given.out.write_text(json.dumps(cases, indent=2) + "\n")
    print(f"\nseconds per step, medians of {TIMED_STEPS} steps (table in {given.out})\n{format_table(cases)}")


if __name__ == "__main__":
    main()
