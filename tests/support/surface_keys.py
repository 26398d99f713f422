"""Points of the split surface of each rank after edges broke in two stages; run by test_surface_keys."""

from __future__ import annotations

import sys

import numpy as np
import numpy.typing as npt
from mpi4py import MPI

from fracsim.contact.contact_surface import ContactSurface
from fracsim.contact.pose import Pose, PosedShape
from fracsim.contact.shapes import HalfSpace
from fracsim.mesh.edge_graph import EdgeGraph
from support.scenes import make_scene

Values = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]
SHARES = 0.25, 0.5  # of the edges, that are broken after each stage


def broken_stages(dim: int, order: int) -> list[tuple[Ints, Values, list[tuple[int, ...]]]]:
    """Keys, areas and descriptions of this rank's points in each stage; edges break by their places (collective).

    A description has the rounded position of a point in the reference configuration and the nodes that it follows.
    """
    mesh = {"builder": "box", "size": [1.0] * dim, "h": 0.3, "pattern": "unstructured", "order": order}
    scene, _ = make_scene(mesh=mesh)
    domain, graph, stages = scene.domain, EdgeGraph(scene.domain), []
    surface = ContactSurface(domain, 0.01)
    far = PosedShape(HalfSpace((1.0,) + (0.0,) * (dim - 1)), Pose.at_point(np.full(dim, -9.0)))
    middles = domain.nodes[graph.edge_nodes].mean(axis=1)
    noise = np.modf(1e4 * np.sin(1e3 * np.round(middles, 6) @ np.array([1.0, 2.7, 7.3])[:dim]))[0] ** 2
    for share in SHARES:
        graph.break_edges(noise < share)
        surface.edges_broke(graph.pattern, None, np.zeros(domain.node_count * dim), [far])
        rest, mean = surface.point_map.rest, surface.point_map._mean
        descriptions = [
            (*np.rint(1e7 * rest[point]).astype(int).tolist(), *np.sort(surface.columns[mean[point].indices]).tolist())
            for point in range(len(rest))
        ]
        area = surface.sum_at_points(np.arange(len(rest)), surface.area[:, None])[:, 0]
        stages.append((surface.keys, area, descriptions))
    return stages


def main(path: str) -> None:
    """Save the distinct keys of all ranks, and the area at each, in both stages."""
    comm, arrays = MPI.COMM_WORLD, {}
    for dim, order in ((2, 1), (3, 1), (2, 2), (3, 2)):
        for number, (keys, area, _) in enumerate(broken_stages(dim, order)):
            parts = comm.gather((keys, area))
            if parts is not None:
                every, first = np.unique(np.concatenate([part for part, _ in parts]), return_index=True)
                name = f"{dim}-{order}-{number}"
                arrays[f"{name}-keys"] = every
                arrays[f"{name}-area"] = np.concatenate([part for _, part in parts])[first]
                arrays[f"{name}-count"] = np.array(sum(len(part) for part, _ in parts))
    if comm.rank == 0:
        np.savez(path, **arrays)


if __name__ == "__main__":
    main(sys.argv[1])
