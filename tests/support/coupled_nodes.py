"""What test_coupled_nodes compares: plates pressed together, contact beside the tangent and in it, on any ranks."""

from __future__ import annotations

import sys

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc

from fracsim.contact.self_contact import SelfContact
from fracsim.solvers.coupled_nodes import CoupledNodesPreconditioner, LowRankOperator
from support.scenes import make_scene
from support.stacked import MESH

FIXED = {"on": {"point": [0.0, 0.0, 0.0], "normal": [0.0, 0.0, 1.0]}, "fix": "xyz"}
PITCH, CLOSED = 0.0101, 8e-5  # m, of the plates, and by how much each gap of 1e-4 m is closed


def main(path: str) -> None:
    """Differences of products, of A P r and r at coupled dofs, and what is left of a linear system."""
    comm = MPI.COMM_WORLD
    scene, walk = make_scene(
        mesh={"file": str(MESH)}, material={"energy": "neo-hookean", "young": 1e7, "poisson": 0.3, "density": 1000.0},
        contact={"friction": 0.0}, boundary=[FIXED], solver={"ksp_rtol": 1e-10},
        time={"scheme": "backward-euler", "step": 1e-3, "end": 0.1},
    )  # fmt: skip
    SelfContact.allows_exact_tangent = False  # which a second tangent at the same place would be
    balance, linear = scene.balance, scene.stepper.solver.linear
    scene.stepper.inelastic.begin_step(walk.state, 1e-3)
    z = scene.domain.nodes[: scene.domain.node_count, 2]
    u = np.zeros((len(z), 3))
    u[:, 2] = -CLOSED * np.floor((z + 1e-6) / PITCH)
    balance.set_displacement(u.reshape(-1))
    tangent, force = balance.tangent, np.sin(np.arange(*balance.work_vector.getOwnershipRange()))
    balance.work_vector.array_w[:] = force * balance.motion.free_dofs
    assert linear.solve()
    coupling = tangent.couplings.beside
    assert coupling is not None
    A, x, (y, inverse) = LowRankOperator(tangent.matrix, tangent), linear.correction, tangent.matrix.createVecs()
    A.mult(tangent.matrix, x, y)
    errors = {"solution": (y - balance.work_vector).norm() / balance.work_vector.norm(), "iterations": linear.ksp.its}
    CoupledNodesPreconditioner(linear.preconditioner.serving, coupling, tangent, x).apply(None, x, inverse)
    A.mult(tangent.matrix, inverse, y)
    difference = np.abs(y.array_r - x.array_r)[coupling.dofs].max(initial=0.0)
    errors["inverse"] = comm.allreduce(float(difference), op=MPI.MAX) / x.norm(PETSc.NormType.INFINITY)
    A.mult(tangent.matrix, x, y)
    tangent.couplings.keep_beside(False)
    tangent.assemble()
    assert tangent.couplings.beside is None
    tangent.matrix.mult(x, inverse)
    errors["product"] = (y - inverse).norm() / y.norm()
    if comm.rank == 0:
        np.savez(path, coupled=len(coupling.numbers), **errors)


if __name__ == "__main__":
    main(sys.argv[1])
