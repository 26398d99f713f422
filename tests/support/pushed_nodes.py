"""Torn bodies between obstacles: contact of few nodes, on any number of ranks; run by test_obstacle_patch."""

from __future__ import annotations

import sys
from typing import Any

import numpy as np
from mpi4py import MPI

from fracsim.contact.obstacle_term import ObstaclePatch, ObstacleTerm
from fracsim.mechanics.term_protocols import PatchContactTerm, fulfilling
from fracsim.mesh.parallel import allgather
from fracsim.scene import Scene
from fracsim.solvers import nonlinear_elimination
from support.scenes import Values, break_across, make_scene, march
from support.solver_policy import other_policy
from support.torn import TIGHT

SOFT = {"energy": "neo-hookean", "young": 1e4, "poisson": 0.3, "density": 100.0}
DISTANCE = 0.01


def pressed_study(dim: int, energy: str, scheme: str, **ball: Any) -> dict[str, Any]:
    """A block on a plane with friction, that a small ball presses into."""
    middle, up = [0.5] + [0.25] * (dim - 2), [0.0] * (dim - 1) + [1.0]
    place = {"at": [*middle, 0.5 + 0.2 + 2 * DISTANCE], "velocity": [0.05] + [0.0] * (dim - 2) + [-0.3]}
    return {
        "mesh": {"builder": "box", "size": [1.0, *[0.5] * (dim - 1)], "h": 0.2, "pattern": "unstructured"},
        "material": SOFT | {"energy": energy}, "fracture": {"strength": 1e9}, "solver": TIGHT,
        "contact": {"itself": False, "distance": DISTANCE}, "time": {"scheme": scheme, "step": 0.02, "end": 1.0},
        "obstacle": [
            {"name": "floor", "shape": "plane", "at": [0.0] * dim, "normal": up, "friction": 0.3},
            {"name": "ball", "shape": "sphere", "radius": 0.2, "friction": 0.2} | place | ball,
        ],
    }  # fmt: skip


STUDIES: dict[str, dict[str, Any]] = {
    "2d": pressed_study(2, "corotated", "backward-euler"),
    "newmark": pressed_study(2, "neo-hookean", "newmark"),
    "generalized-alpha": pressed_study(3, "neo-hookean", "generalized-alpha"),
    "3d": pressed_study(3, "corotated", "backward-euler"),
    "free": pressed_study(3, "neo-hookean", "backward-euler", mass=2.0),
}


def pressed(name: str) -> tuple[Scene, ObstacleTerm, Values]:
    """The scene with a torn body in contact, its contact, and the displacement of the owned nodes (n, d), m."""
    scene, state = make_scene(**STUDIES[name])
    dim = scene.domain.dim
    break_across(scene, [1.0] + [0.1] * (dim - 1), 0.52)
    break_across(scene, [0.1] * (dim - 1) + [1.0], 0.3)
    (contact,) = [term for term in scene.balance.terms if isinstance(term, ObstacleTerm)]
    march(scene, state, 5)
    return scene, contact, state.u.reshape(-1, dim).copy()


def nodes_in_contact(scene: Scene, contact: ObstacleTerm, count: int) -> np.ndarray:
    """(count,) global numbers, ascending, of the nodes with the largest contact forces (collective)."""
    first = scene.domain.space.dofmap.index_map.local_range[0]
    force = np.linalg.norm(contact.contact_forces().reshape(-1, scene.domain.dim), axis=1)
    rows = allgather(scene.domain.comm, (first + np.arange(len(force)), force))
    numbers, forces = (np.concatenate(parts) for parts in zip(*rows, strict=True))
    return np.sort(numbers[np.argsort(-forces, kind="stable")[:count]])


def make_patch(scene: Scene, nodes: np.ndarray) -> ObstaclePatch:
    """Contact of nodes (k,) from the current displacement (collective)."""
    (term,) = fulfilling(scene.balance.terms, PatchContactTerm)
    patch = term.patch(nodes)
    assert isinstance(patch, ObstaclePatch)
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
            u[own] += 0.05 * DISTANCE * np.cos(np.arange(u.shape[1]))
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
