"""A long body in three pieces whose cracks are closed by the barrier; run by test_partitioned_surface."""

from __future__ import annotations

import sys

import numpy as np
import numpy.typing as npt
from mpi4py import MPI

from fracsim.contact import element_exchange
from fracsim.contact.self_contact import SelfContact
from fracsim.mechanics.extra_couplings import FewNodesCoupling
from support.scenes import Values, break_across, make_scene

SOFT = {"energy": "neo-hookean", "young": 1e4, "poisson": 0.3, "density": 100.0}
SIZE, SHARES = 5.0, (0.31, 0.68)


def closed(dim: int, itself: bool | str) -> dict[str, npt.NDArray[np.generic]]:
    """Forces, energy, stiffness and free ways of contact with lagged friction, before and after one end moves away.

    The middle piece keeps its place. The ends come near it by more than the gap of new cracks allows. The right one
    then moves away by three edges, farther than elements serve that were exchanged before, and back (collective).
    """
    comm = MPI.COMM_WORLD
    scene, state = make_scene(
        mesh={"builder": "box", "size": [SIZE, *[0.5] * (dim - 1)], "h": 0.22, "pattern": "unstructured"},
        material=SOFT, contact={"itself": itself, "friction": 0.2}, fracture={"strength": 1e9},
        time={"scheme": "backward-euler", "step": 0.01, "end": 1.0},
    )  # fmt: skip
    normal = [1.0] + [0.1] * (dim - 1)
    for share in SHARES:
        break_across(scene, normal, share * SIZE)
    (term,) = [term for term in scene.balance.terms if isinstance(term, SelfContact)]
    x, edge = scene.domain.nodes[: scene.domain.node_count], scene.domain.mean_edge_length
    piece = np.searchsorted(np.array(SHARES) * SIZE, x @ normal)
    closing = np.zeros_like(x)
    closing[:, 0] = (1 - piece) * 1.3 * term.surface.law.distance
    scene.balance.set_displacement(closing.reshape(-1))
    scene.balance.begin_step(state.t, 0.01, closing.reshape(-1), *(0 * closing.reshape(-1),) * 2)
    arrays, gather = dict[str, Values](), scene.domain.input_numbering.gather_nodes
    for name, way in (("closed", 0.0), ("away", 3.0 * edge), ("back", 0.0)):
        u = closing + 0.02 * term.surface.law.distance * np.sin(x[:, ::-1])
        u[:, 0] += way * (piece == 2)
        before, u = scene.balance.u.x.array[: u.size].copy(), u.reshape(-1)
        fraction = term.max_step_fraction(u - before)
        scene.balance.set_displacement(u)
        arrays[f"{name}-followed"] = gather(1.0 * term.followed_nodes()[:, None])
        forces = term.contact_forces()
        coupling = term.coupling_matrix()
        product = np.zeros_like(u)
        if isinstance(coupling, FewNodesCoupling):
            coupling.add_product(np.cos(x).reshape(-1), product)
        energies = comm.allreduce(np.array([term.stored_energy(), term.potential()]))
        arrays |= {f"{name}-{key}": gather(values.reshape(x.shape)) for key, values in (("f", forces), ("K", product))}
        arrays |= {f"{name}-fraction": np.array([fraction]), f"{name}-energies": energies}
        arrays[f"{name}-gap"] = np.array([term.min_gap() / term.surface.law.distance])
    surface = term.surface
    counts = len(surface.element_set.elements.corners), len(surface.current.elements), surface.exchange_count
    arrays["counts"] = np.array(comm.allgather(counts))
    return arrays


def main(path: str) -> None:
    """Save what each case gives (collective)."""
    arrays: dict[str, npt.NDArray[np.generic]] = {}
    for dim in (2, 3):
        if dim == 3:  # elements are exchanged at each displacement: no more of them than needed
            object.__setattr__(element_exchange.EXCHANGE, "barrier_margin", 0.0)
        for itself in (True, "pieces"):
            arrays |= {f"{dim}-{itself}-{name}": values for name, values in closed(dim, itself).items()}
    if MPI.COMM_WORLD.rank == 0:
        np.savez(path, **arrays)  # type: ignore[arg-type]


if __name__ == "__main__":
    main(sys.argv[1])
