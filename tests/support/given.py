"""A bar whose mesh another DOLFINx program made: what breaks, and the map to that mesh, on any number of ranks."""

from __future__ import annotations

import sys
from typing import Any

import numpy as np
import numpy.typing as npt
import ufl
from dolfinx import mesh as dolfinx_mesh
from mpi4py import MPI

import fracsim

STUDY: dict[str, Any] = {
    "title": "given",
    "material": {"young": 1e5, "poisson": 0.35, "density": 300.0, "soft": {"young": 9e4}},
    "fracture": {"strength": 1e4, "radius": 0.03},
    "boundary": [{"on": "left", "fix": "xy"}, {"on": "right", "velocity": [0.5, 0.0]}],
    "time": {"step": 5e-3, "end": 0.1},
}


def plate(ghost_mode: dolfinx_mesh.GhostMode) -> dict[str, Any]:
    """Mesh, tagged ends and a tagged half, as Simulation takes them."""
    comm, corners = MPI.COMM_WORLD, [[0.0, 0.0], [0.4, 0.1]]
    mesh = dolfinx_mesh.create_rectangle(
        comm, corners, (20, 5), dolfinx_mesh.CellType.triangle, ghost_mode=ghost_mode
    )  # fmt: skip
    mesh.topology.create_connectivity(1, 2)
    ends = [dolfinx_mesh.locate_entities_boundary(mesh, 1, lambda x, at=at: np.isclose(x[0], at)) for at in (0.0, 0.4)]
    facets, values = np.concatenate(ends), np.repeat(np.int32([5, 9]), [len(end) for end in ends])
    order = np.argsort(facets)
    cells = dolfinx_mesh.locate_entities(mesh, 2, lambda x: x[0] > 0.2 - 1e-9)
    return {
        "mesh": mesh,
        "facets": (dolfinx_mesh.meshtags(mesh, 1, facets[order], values[order]), {"left": 5, "right": 9}),
        "regions": (dolfinx_mesh.meshtags(mesh, 2, cells, np.full(len(cells), 3, np.int32)), {"soft": 3}),
    }


def shear(stress: Any, edges: Any, strength: Any) -> Any:
    """Load of an edge: its normal stress, and some of the greatest shear."""
    principal = np.linalg.eigvalsh(stress)
    normal = np.einsum("nki,nij,nkj->nk", edges, stress, edges)
    return np.maximum(normal, 0.9 * (principal[:, -1:] - principal[:, :1])) / strength


class Foundation(fracsim.Term):
    """Springs on the tagged left end, k u . w dA."""

    name, linear = "foundation", True

    def __init__(self, body: Any) -> None:
        self._u, self._ds = body.u, body.facet_measure("left")

    def virtual_work(self, w: Any, dx: Any) -> Any:
        return 1e6 * ufl.inner(self._u, w) * self._ds

    def tangent_form(self, v: Any, w: Any, dx: Any) -> Any:
        return 1e6 * ufl.inner(v, w) * self._ds


def soft(mu: Any, lmbda: Any) -> Any:
    """Saint Venant-Kirchhoff."""

    class Law:
        def psi(self, F: Any) -> Any:
            E = (F.T * F - ufl.Identity(3)) / 2
            return mu * ufl.inner(E, E) + lmbda / 2 * ufl.tr(E) ** 2

    return Law()


def pull(t: float, x: npt.NDArray[np.float64]) -> Any:
    return np.stack([0.5 * t + 0.2 * t * x[:, 1], np.zeros(len(x))], axis=1)


PHYSICS: dict[str, Any] = {
    "energy": soft, "criterion": shear, "edge_law": lambda load: np.clip(3 - 2 * load, 0, 1), "terms": [Foundation],
    "boundary": [{"on": "right", "displacement": pull}],
}  # fmt: skip


def compared() -> dict[str, npt.NDArray[np.generic]]:
    """Broken edges by input nodes, energies, pieces, and distances between nodes and cells and those mapped to."""
    comm, result = MPI.COMM_WORLD, dict[str, npt.NDArray[np.generic]]()
    for mode in ("none", "shared_facet", "physics"):
        handed = plate(dolfinx_mesh.GhostMode.shared_facet if mode == "shared_facet" else dolfinx_mesh.GhostMode.none)
        mesh, own = handed["mesh"], PHYSICS if mode == "physics" else {}
        study = STUDY | {"boundary": []} if own else STUDY
        with fracsim.Simulation(study, **handed, **own) as simulation:
            simulation.run()
            domain, graph = simulation.scene.domain, simulation.scene.fracture.graph
            keys = comm.gather(graph.keys.of_edges(np.flatnonzero(graph.broken)))
            nodes = comm.gather((simulation.node_numbers, domain.nodes[: domain.node_count]))
            cells = comm.gather((simulation.cell_numbers, domain.nodes[domain.cell_nodes].mean(axis=1)))
            theirs = comm.gather((mesh.geometry.input_global_indices, mesh.geometry.x[:, :2]))
            owned = mesh.topology.index_map(2).size_local
            centres = mesh.geometry.x[_cells(mesh)[:owned], :2].mean(axis=1)
            their_cells = comm.gather((mesh.topology.original_cell_index[:owned], centres))
            pieces, surface = simulation.fragments(), simulation.surface()
            soft = comm.allreduce(np.count_nonzero(domain.cell_region == 0))
            if comm.rank == 0:
                result |= {
                    f"{mode}-broken": np.unique(np.concatenate(keys), axis=0), f"{mode}-mass": pieces["mass"],
                    f"{mode}-elastic": simulation.history["elastic"], f"{mode}-faces": np.array(surface.n_cells),
                    f"{mode}-nodes": _distances(nodes, theirs), f"{mode}-cells": _distances(cells, their_cells),
                    f"{mode}-soft": np.array(soft),
                }  # fmt: skip
    return result


def main(path: str) -> None:
    """Rank 0 saves."""
    found = compared()
    if MPI.COMM_WORLD.rank == 0:
        np.savez(path, **found)


def _cells(mesh: Any) -> Any:
    from fracsim.mesh.dolfinx_compat import cell_geometry

    return cell_geometry(mesh.geometry)


def _distances(ours: Any, theirs: Any) -> npt.NDArray[np.float64]:
    """(n,) distance of each entity from the one of the same number in the mesh that was handed over."""
    numbers, places = (np.concatenate(parts) for parts in zip(*theirs, strict=True))
    sorted_numbers, first = np.unique(numbers, return_index=True)
    own_numbers, own_places = (np.concatenate(parts) for parts in zip(*ours, strict=True))
    np.testing.assert_array_equal(np.sort(own_numbers), sorted_numbers)
    return np.linalg.norm(places[first][np.searchsorted(sorted_numbers, own_numbers)] - own_places, axis=1)


if __name__ == "__main__":
    main(sys.argv[1])
