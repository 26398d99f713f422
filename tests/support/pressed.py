"""Bodies torn and pushed together: contact around few nodes, on any number of ranks; run by test_contact_patch."""

from __future__ import annotations

import sys
from typing import Any

import numpy as np
from mpi4py import MPI

from fracsim.contact.contact_patch import SelfContactPatch
from fracsim.contact.self_contact import SelfContact
from fracsim.mechanics.term_protocols import PatchContactTerm, fulfilling
from fracsim.mesh.parallel import allgather
from fracsim.scene import Scene
from fracsim.solvers import nonlinear_elimination
from support.scenes import Values, make_scene, march
from support.solver_policy import other_policy
from support.torn import MESHES, RUNS, TIGHT

STUDIES: dict[str, dict[str, Any]] = {
    "2d": RUNS["shut"] | {"solver": TIGHT},
    "newmark": RUNS["shut"] | {"solver": TIGHT, "time": RUNS["shut"]["time"] | {"scheme": "newmark"}},
    "generalized-alpha": RUNS["shut"] | {
        "solver": TIGHT, "time": RUNS["shut"]["time"] | {"scheme": "generalized-alpha"}},
    "3d": RUNS["shut"] | {
        "mesh": MESHES["3d"], "solver": TIGHT, "fracture": {"strength": 0.1, "radius": 0.25},
        "boundary": [{"on": "left", "fix": "xyz"}, {"on": "right", "displacement": {
            "time": [0.0, 0.125, 0.4], "value": [[0.0, 0.0, 0.0], [0.1, 0.02, 0.01], [-0.15, 0.0, 0.0]]}}],
    },
}  # fmt: skip


def pressed(name: str) -> tuple[Scene, SelfContact, Values]:
    """The scene with crack faces in contact, its contact, and the displacement of the owned nodes (n, d), m."""
    scene, state = make_scene(**STUDIES[name])
    (contact,) = [term for term in scene.balance.terms if isinstance(term, SelfContact)]
    while not scene.domain.comm.allreduce(float(np.abs(contact.contact_forces()).max(initial=0.0)), op=MPI.MAX):
        march(scene, state, 1)
    march(scene, state, 1)
    return scene, contact, state.u.reshape(-1, scene.domain.dim).copy()


def nodes_in_contact(scene: Scene, contact: SelfContact, count: int) -> np.ndarray:
    """(count,) global numbers, ascending, of the nodes with the largest contact forces (collective)."""
    first = scene.domain.space.dofmap.index_map.local_range[0]
    force = np.linalg.norm(contact.contact_forces().reshape(-1, scene.domain.dim), axis=1)
    rows = allgather(scene.domain.comm, (first + np.arange(len(force)), force))
    numbers, forces = (np.concatenate(parts) for parts in zip(*rows, strict=True))
    return np.sort(numbers[np.argsort(-forces, kind="stable")[:count]])


def make_patch(scene: Scene, nodes: np.ndarray) -> SelfContactPatch:
    """Contact of nodes (k,) from the current displacement (collective)."""
    (term,) = fulfilling(scene.balance.terms, PatchContactTerm)
    patch = term.patch(nodes)
    assert isinstance(patch, SelfContactPatch)
    return patch


def main(path: str) -> None:
    """Save values of a patch, and where nodes come to rest that were displaced (collective)."""
    arrays = dict[str, Values]()
    comm = MPI.COMM_WORLD
    for name in ("2d", "3d"):
        with other_policy(max_relaxed_nodes=0.3) as policy:
            scene, contact, u = pressed(name)
            nodes, gather = nodes_in_contact(scene, contact, 5), scene.domain.input_numbering.gather_nodes
            first = scene.domain.space.dofmap.index_map.local_range[0]
            own = nodes[(nodes >= first) & (nodes < first + len(u))] - first
            value = make_patch(scene, nodes).evaluate(np.zeros((len(nodes), u.shape[1])))
            forces = np.zeros_like(u)
            forces[own] = value.forces[np.isin(nodes, own + first)]
            arrays[f"{name} forces"] = gather(forces)
            u[own] += 0.05 * contact.surface.law.distance * np.cos(np.arange(u.shape[1]))
            scene.balance.set_displacement(u.reshape(-1))
            scene.balance.update_forces()
            few = nonlinear_elimination.create_elimination(scene.balance, policy)
            assert few is not None and few.relax_nodes(0.0)
            at_rest = scene.balance.u.x.array[: u.size].reshape(u.shape)
            arrays[f"{name} at rest"] = gather(at_rest)
            arrays[f"{name} moved"] = gather(1.0 * (np.abs(at_rest - u) > 1e-9))
    if comm.rank == 0:
        np.savez(path, **arrays)  # type: ignore[arg-type]


if __name__ == "__main__":
    main(sys.argv[1])
