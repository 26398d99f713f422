"""A long body in three pieces that press one another in explicit steps; run by test_partitioned_surface."""

from __future__ import annotations

import sys

import numpy as np
import numpy.typing as npt
from mpi4py import MPI
from scipy.sparse import csr_matrix

from fracsim.contact.element_exchange import ElementRows, ElementSet, PointRows, exchange_elements
from fracsim.contact.penalty_contact import PenaltyContact
from fracsim.mesh.split_surface.closed_surface import row_keys
from support.scenes import break_across, make_scene, march

Values = npt.NDArray[np.float64]
SOFT = {"energy": "neo-hookean", "young": 1e4, "poisson": 0.3, "density": 100.0}
SIZE = 5.0


def pressed(dim: int, itself: bool | str) -> dict[str, npt.NDArray[np.generic]]:
    """Elements of each rank, and contacts of all by keys of points, after steps in which the ends come together."""
    comm = MPI.COMM_WORLD
    scene, state = make_scene(
        mesh={"builder": "box", "size": [SIZE, *[0.5] * (dim - 1)], "h": 0.22, "pattern": "unstructured"},
        material=SOFT, contact={"itself": itself, "friction": 0.2}, fracture={"strength": 1e9},
        time={"scheme": "explicit", "step": 1.0, "end": 10.0},
    )  # fmt: skip
    for share in (0.31, 0.68):
        break_across(scene, [1.0] + [0.1] * (dim - 1), share * SIZE)
    state.remember()
    x = scene.domain.nodes[: scene.domain.node_count]
    v = np.zeros_like(x)
    v[:, 0] = -0.4 * (x[:, 0] - 0.5 * SIZE)
    v[:, 1] = 0.2 * np.sin(3.0 * x[:, 0])
    state.v = v.reshape(-1)
    state.settle()
    march(scene, state, 30)
    (term,) = [term for term in scene.balance.terms if isinstance(term, PenaltyContact)]
    surface = term.surface
    (part,) = surface.current.parts
    near = part.pairs.near_contacts(term._end_positions())
    numbers, points = near.points, part.pairs.keys
    rows = np.column_stack([points[numbers], np.round(near.gap / 1e-9).astype(np.int64)])
    counts = len(surface.element_set.elements.corners), len(surface.current.elements)
    gathered = comm.gather((rows, near.stiffness, counts))
    u = scene.domain.input_numbering.gather_nodes(state.u.reshape(-1, dim))
    if gathered is None or u is None:
        return {}
    all_rows, stiffness, all_counts = zip(*gathered, strict=True)
    contacts, k = np.concatenate(all_rows), np.concatenate(stiffness)
    order = np.lexsort(contacts[:, :-1].T)
    return {
        "points": contacts[order, :-1], "gap": 1e-9 * contacts[order, -1], "stiffness": k[order], "u": u,
        "counts": np.array(all_counts), "stored": np.array([len(k)]),
    }  # fmt: skip


def missing_elements() -> int:
    """Elements of other ranks within the reach of its own that no rank gets, of random triangles (collective)."""
    comm, reach, missing = MPI.COMM_WORLD, 0.05, 0
    for seed in range(4):
        rng = np.random.default_rng(seed)
        owner = rng.integers(comm.size, size=400)
        centres = rng.uniform(size=(400, 1, 3))
        centres[:, 0, 0] += 0.7 * owner
        corners = centres + rng.normal(
            scale=rng.choice([0.01, 0.2], size=(400, 1, 1), p=[0.95, 0.05]), size=(400, 3, 3)
        )
        boxes = np.stack([corners.min(axis=1), corners.max(axis=1)], axis=1)
        selected = np.flatnonzero(owner == comm.rank)
        lead, none = (3 * selected[:, None] + np.arange(3)).reshape(-1), csr_matrix((3 * len(selected), 1))
        zero = np.zeros(len(lead))
        points = PointRows(
            row_keys(lead[:, None]), lead, corners[selected].reshape(-1, 3), np.zeros((len(lead), 3)), none, none,
            zero, zero, zero,
        )  # fmt: skip
        rows = np.arange(len(lead)).reshape(-1, 3)
        elements = ElementRows(rows, owner[selected], np.zeros(len(selected), bool))
        result = exchange_elements(comm, ElementSet(points, elements), boxes[selected], boxes[selected], reach)
        received = result.points.lead[result.elements.corners].min(axis=1) // 3
        np.testing.assert_array_equal(result.elements.rank, owner[received])
        np.testing.assert_array_equal(result.points.middle[result.elements.corners], corners[received])
        apart = np.maximum(boxes[:, None, 0] - boxes[None, selected, 1], boxes[None, selected, 0] - boxes[:, None, 1])
        near = np.flatnonzero((apart.max(axis=2) <= reach).any(axis=1))
        missing += len(np.setdiff1d(near, received))
    return int(comm.allreduce(missing))


def main(path: str) -> None:
    """Save what each case gives (collective)."""
    arrays: dict[str, npt.NDArray[np.generic]] = {"missing": np.array([missing_elements()])}
    for dim in (2, 3):
        for itself in (True, "pieces"):
            result = pressed(dim, itself)
            arrays |= {f"{dim}-{itself}-{name}": values for name, values in result.items()}
    if MPI.COMM_WORLD.rank == 0:
        np.savez(path, **arrays)  # type: ignore[arg-type]


if __name__ == "__main__":
    main(sys.argv[1])
