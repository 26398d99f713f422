"""What test_balancing compares: plates pressed together, contact beside the tangent and in it, on any ranks."""

from __future__ import annotations

import sys
from typing import Any

import numpy as np
import pytest
from mpi4py import MPI
from petsc4py import PETSc

from fracsim.contact.self_contact import SelfContact
from fracsim.scene import Scene
from fracsim.solvers.balancing import solve_nodes_exactly
from support.scenes import make_scene
from support.solver_policy import other_policy
from support.stacked import MESH

FIXED = {"on": {"point": [0.0, 0.0, 0.0], "normal": [0.0, 0.0, 1.0]}, "fix": "xyz"}
PITCH, CLOSED = 0.0101, 8e-5  # m, of the plates, and by how much each gap of 1e-4 m is closed
FRACTURE = {"strength": 1e12}  # Pa, which is never reached
# blocks, and multigrid that stays that of the body before
KEEPS_MULTIGRID: dict[str, Any] = {
    "min_block_dofs": 0, "vcycle_setup_cost": 10**6, "vcycle_refresh_cost": 10**6, "max_changed_share": 1.0,
}  # fmt: skip


def pressed(**tables: Any) -> Scene:
    """The plates, displaced towards one another, with forces at all free dofs as the residual."""
    scene, walk = make_scene(
        mesh={"file": str(MESH)}, material={"energy": "neo-hookean", "young": 1e7, "poisson": 0.3, "density": 1000.0},
        contact={"friction": 0.0}, boundary=[FIXED], solver={"ksp_rtol": 1e-10},
        time={"scheme": "backward-euler", "step": 1e-3, "end": 0.1}, **tables,
    )  # fmt: skip
    domain, balance = scene.domain, scene.balance
    scene.stepper.inelastic.begin_step(walk.state, 1e-3)
    z = domain.nodes[: domain.node_count, 2]
    u = np.zeros((len(z), 3))
    u[:, 2] = -CLOSED * np.floor((z + 1e-6) / PITCH)
    balance.set_displacement(u.reshape(-1))
    force = np.sin(np.add.outer(3 * domain.input_numbering.nodes[: domain.node_count], np.arange(3)))
    balance.work_vector.array_w[:] = force.reshape(-1) * balance.motion.free_dofs
    return scene


def solved(scene: Scene) -> dict[str, Any]:
    """Iterations of CG, and errors of its solution and of A P r at the dofs that P solves for exactly."""
    comm, balance, linear = scene.domain.comm, scene.balance, scene.stepper.solver.linear
    assert linear.solve()
    A, x, (y, inverse) = linear.operators.operator, linear.correction, balance.tangent.matrix.createVecs()
    A.mult(x, y)
    found = {"iterations": linear.ksp.its, "solution": (y - balance.work_vector).norm() / balance.work_vector.norm()}
    coupling, changed = balance.tangent.couplings.beside, linear.preconditioner.changed_nodes
    assert coupling is not None
    solve_nodes_exactly(linear.preconditioner.serving, balance.tangent, changed, x).apply(x, inverse)
    A.mult(inverse, y)
    exact = np.zeros((scene.domain.node_count, 2), dtype=bool)
    exact[coupling.nodes, 0] = True
    exact[[] if changed is None else changed, 1] = True
    difference = np.abs(y.array_r - x.array_r).reshape(-1, 3)[exact.any(axis=1)].max(initial=0.0)
    found["inverse"] = comm.allreduce(float(difference), op=MPI.MAX) / x.norm(PETSc.NormType.INFINITY)
    gather_nodes = scene.domain.input_numbering.gather_nodes
    return found | {"exact": gather_nodes(exact.astype(float)), "x": gather_nodes(x.array_r.reshape(-1, 3))}


def contact() -> dict[str, Any]:
    """`solved`, and the difference of products with contact beside the tangent and in it."""
    scene = pressed()
    found, tangent = solved(scene), scene.balance.tangent
    x, (y, other) = scene.stepper.solver.linear.correction, tangent.matrix.createVecs()
    scene.stepper.solver.linear.operators.operator.mult(x, y)
    tangent.couplings.keep_beside(False)
    tangent.assemble()
    assert tangent.couplings.beside is None
    tangent.matrix.mult(x, other)
    return found | {"product": (y - other).norm() / y.norm()}


def changed() -> dict[str, Any]:
    """`solved` after cells have become 30 times as stiff, with multigrid of the plates before."""
    with other_policy(**KEEPS_MULTIGRID):
        scene = pressed(fracture=FRACTURE)
    domain, chi = scene.domain, scene.balance.stress.chi
    assert chi is not None and scene.stepper.solver.linear.solve()
    is_stiff = np.cos(1e3 * domain.input_numbering.cells) > 0.9995
    chi.x.array[: domain.cell_count][is_stiff] = 30.0
    chi.x.scatter_forward()
    scene.balance.damage_changed()
    scene.stepper.solver.linear.preconditioner.edges_broke(0)
    return solved(scene)


def main(path: str) -> None:
    """Results of both bodies."""
    with pytest.MonkeyPatch.context() as patch:
        # which a second tangent at the same place would be
        patch.setattr(SelfContact, "allows_exact_tangent", False)
        found = {f"{case.__name__}-{key}": value for case in (contact, changed) for key, value in case().items()}
    if MPI.COMM_WORLD.rank == 0:
        np.savez(path, **found)


if __name__ == "__main__":
    main(sys.argv[1])
