"""A block cut in two but for one edge around which all cells are of one half: halves that hang on a node."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from fracsim.fracture.energy.hinges import HingeRelease
from fracsim.mesh.edge_graph import EdgeGraph
from fracsim.mesh.fragments import find_fragments
from fracsim.meshes.data import MeshData
from fracsim.meshes.topology import edges_of
from fracsim.scene import Scene

from .scenes import make_scene
from .torn import Found

Ints = npt.NDArray[np.int64]
# (place of the cut along x, pieces afterwards): the half with the node of the hinge is the smaller one, and the larger
CASES = {"short": 0.5, "long": 1.0}


def block(**fracture: bool) -> Scene:
    """An unbroken block of random tetrahedra; keys of its fracture."""
    return make_scene(
        mesh={"builder": "box", "size": [1.5, 0.6, 0.6], "h": 0.15, "pattern": "unstructured"},
        fracture={"strength": 1.0, "energy": 1.0, **fracture},
    )[0]


def halves(scene: Scene, cut: float) -> tuple[npt.NDArray[np.bool_], Ints]:
    """(points,) whether a point of the input mesh is of the left half, and (2,) the ends of the edge of the hinge."""
    comm = scene.domain.comm
    mesh = scene.domain.input_mesh
    return comm.bcast(_halves(mesh, cut) if mesh is not None and comm.rank == 0 else None)  # type: ignore[no-any-return]


def _halves(mesh: MeshData, cut: float) -> tuple[npt.NDArray[np.bool_], Ints]:
    first, second = np.triu_indices(4, 1)
    pairs = np.sort(mesh.cells[:, [first, second]].reshape(-1, 2), axis=1)
    middle = mesh.points[np.unique(pairs, axis=0)].mean(axis=1)
    centre = np.array([cut, 0.3, 0.3])
    edge = np.unique(pairs, axis=0)[np.argmin(np.linalg.norm(middle - centre, axis=1))].astype(np.int64)
    here, there = edge[np.argsort(mesh.points[edge, 0])]
    around = (mesh.cells == here).any(axis=1) & (mesh.cells == there).any(axis=1)
    left = mesh.points[:, 0] < cut
    left[mesh.cells[around].reshape(-1)] = False
    left[here] = True
    return left, np.array([here, there])


def cut_but_for(graph: EdgeGraph, left: npt.NDArray[np.bool_], hinge: Ints) -> None:
    """Break the edges between the halves, except that of the hinge."""
    ends = graph.domain.input_numbering.nodes[graph.edge_nodes]
    is_hinge = (np.sort(ends, axis=1) == np.sort(hinge)).all(axis=1)
    graph.break_edges((left[ends[:, 0]] != left[ends[:, 1]]) & ~is_hinge)


def bridged_block() -> tuple[Scene, HingeRelease]:
    """Two halves and a node between them without an unsplit cell, which one edge attaches to each; and the rule."""
    scene = block(crumbs=False)
    graph, comm, mesh = scene.fracture.graph, scene.domain.comm, scene.domain.input_mesh
    rule = HingeRelease(graph, np.full(len(graph.split), 0.2), scene.fracture.criterion._node_attachment)
    left, kept, cut = comm.bcast(_bridge(mesh) if mesh is not None and comm.rank == 0 else None)
    ends = graph.domain.input_numbering.nodes[graph.edge_nodes]
    is_kept, is_cut = (
        (np.sort(ends, axis=1)[:, None] == np.sort(pairs, axis=1)).all(axis=2).any(axis=1) for pairs in (kept, cut)
    )
    graph.break_edges((left[ends[:, 0]] != left[ends[:, 1]]) & ~is_kept | is_cut)
    graph.retain_edges(is_kept)
    return scene, rule


def _bridge(mesh: MeshData) -> tuple[npt.NDArray[np.bool_], Ints, Ints]:
    """(points,) whether a point is of the left half, (2, 2) a node amid the cut with a node of each half, and (n, 2)
    edges which split all cells of the first node."""
    left, edges = mesh.points[:, 0] < 0.7, edges_of(mesh.cells)
    node = int(np.argmin(np.linalg.norm(mesh.points - [0.7, 0.3, 0.3], axis=1)))
    around = np.setdiff1d(edges[(edges == node).any(axis=1)], node)
    ends = np.array([around[left[around]][0], around[~left[around]][0]])
    cut = [[node, other] for other in np.setdiff1d(around, ends)]
    for end in ends:
        ring = mesh.cells[(mesh.cells == node).any(axis=1) & (mesh.cells == end).any(axis=1)]
        cut += [[end, other] for other in np.setdiff1d(ring, [node, end])]
    return left, np.array([[node, end] for end in ends]), np.array(cut)


def compared() -> Found:
    """For each case pieces before and after the release, and the keys of all broken edges then, on rank 0."""
    scene, rule = bridged_block()
    graph = scene.fracture.graph
    before = find_fragments(graph).count
    graph.break_edges(rule(np.zeros((len(graph.split), 6))))
    found: Found = {"hinged-bridge-pieces": np.array([before, find_fragments(graph).count])}
    if (keys := graph.broken_keys()) is not None:
        found["hinged-bridge-broken"] = keys
    for name, cut in CASES.items():
        scene = block()
        graph = scene.fracture.graph
        rule = HingeRelease(graph, np.full(len(graph.split), 0.2), None)
        cut_but_for(graph, *halves(scene, cut))
        before = find_fragments(graph).count
        graph.break_edges(rule(np.zeros((len(graph.split), 6))))
        keys = graph.broken_keys()
        found[f"hinged-{name}-pieces"] = np.array([before, find_fragments(graph).count])
        if keys is not None:
            found[f"hinged-{name}-broken"] = keys
    return found
