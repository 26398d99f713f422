"""Drawn surfaces of broken bodies whose points contact, obstacles and smooth cuts move, on any number of ranks."""

from __future__ import annotations

import sys
from typing import Any

import numpy as np
import numpy.typing as npt
from mpi4py import MPI

from fracsim.fracture.edge_history import EdgeHistory
from fracsim.mechanics.term_protocols import SurfaceSeparator, fulfilling
from fracsim.output.surface.surface_output import SurfaceOutput

from .scenes import make_scene

Arrays = dict[str, npt.NDArray[Any]]
# by dimension: around points of a crack, without nodes
BALLS = {
    2: {"name": "ball", "shape": "sphere", "radius": 0.04, "at": [0.53, 1.48]},
    3: {"name": "ball", "shape": "sphere", "radius": 0.05, "at": [0.512, 1.39, 0.367]},
}
IMPLICIT = {"scheme": "backward-euler", "step": 0.01, "end": 1.0}
EXPLICIT = {"scheme": "explicit", "step": 1.0, "end": 10.0}
CASES: dict[str, tuple[int, dict[str, Any], bool]] = {
    "cut": (3, {"time": IMPLICIT}, False),
    "cut-2d": (2, {"time": IMPLICIT}, False),
    "smooth": (3, {"time": IMPLICIT}, True),
    "smooth-2d": (2, {"time": IMPLICIT}, True),
    "ball": (3, {"time": IMPLICIT, "obstacle": [BALLS[3]]}, True),
    "ball-2d": (2, {"time": IMPLICIT, "obstacle": [BALLS[2]]}, False),
    "itself": (3, {"time": IMPLICIT, "contact": {"itself": True}}, False),
    "pieces": (3, {"time": IMPLICIT, "contact": {"itself": "pieces"}, "obstacle": [BALLS[3]]}, False),
    "pieces-2d": (2, {"time": IMPLICIT, "contact": {"itself": "pieces"}}, True),
    "explicit-itself": (3, {"time": EXPLICIT, "contact": {"itself": True}}, False),
    "explicit-itself-2d": (2, {"time": EXPLICIT, "contact": {"itself": True}}, False),
    "explicit-pieces": (3, {"time": EXPLICIT, "contact": {"itself": "pieces"}}, True),
}
# break the edges across planes of these normals at these distances; inside the last one no fragment
PLANES = (([1.0, 0.2, 0.1], 0.7), ([0.1, 1.0, 0.2], 0.55))


def drawn(dim: int, tables: dict[str, Any], *, smooth: bool) -> Arrays:
    """Points, elements and pieces of the whole surface on rank 0 (collective)."""
    scene, walk = make_scene(**{
        "mesh": {"builder": "box", "size": [1.5, *[1.0] * (dim - 1)], "h": 0.24 if dim == 3 else 0.09,
                 "pattern": "unstructured"},
        "material": {"energy": "neo-hookean", "young": 1e4, "poisson": 0.3, "density": 100.0},
        "fracture": {"strength": 1e9}, "solver": {}, **tables,
    })  # fmt: skip
    domain = scene.domain
    assert scene.fracture is not None
    graph, record = scene.fracture.graph, EdgeHistory(scene.fracture.graph)
    nodes, x = domain.nodes, domain.nodes[: domain.node_count]
    terms = fulfilling(scene.balance.terms, SurfaceSeparator)
    output = SurfaceOutput(None, domain, 100.0, record, apart=terms, smooth=smooth)
    ends = nodes[graph.edge_nodes]
    for t, (normal, distance) in enumerate(PLANES):
        sides = ends @ np.array(normal[:dim]) > distance
        # the last crack ends in the body
        graph.break_edges((sides[:, 0] != sides[:, 1]) & ((t == 0) | (ends[:, :, 0].max(axis=1) < 1.2)))
    graph.break_unloaded_edges()
    record.record_breaks(0.0)
    scene.fracture.mark_changed()
    scene.balance.edges_broke(graph.pattern)
    side = x @ np.array(PLANES[0][0][:dim]) > PLANES[0][1]
    # far up, so that the ball is not at the body at rest
    u = 0.03 * np.sin(2.0 * x + np.arange(dim)) + 0.02 * side[:, None] + 0.5 * (np.arange(dim) == 1)
    walk.u = u.reshape(-1)
    frame = output.make_frame(walk.state, []).gather()
    if frame is None:
        return {}
    return {
        "points": frame.points,
        "triangles": frame.triangles,
        "segments": frame.segments,
        "reference": frame.points - frame.point_fields["displacement"],
        "piece": frame.point_fields["piece"],
    }


def main(path: str) -> None:
    """Save the surfaces of all cases (collective)."""
    arrays: Arrays = {}
    for name, (dim, tables, smooth) in CASES.items():
        arrays |= {f"{name}-{key}": values for key, values in drawn(dim, tables, smooth=smooth).items()}
    if MPI.COMM_WORLD.rank == 0:
        np.savez(path, **arrays)


if __name__ == "__main__":
    main(sys.argv[1])
