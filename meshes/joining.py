"""Nodes of different bodies at the same place: told of, and joined where parts of a file are meant to be one body."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from .data import Indices, MeshData, MeshError, format_point
from .topology import components, edges_of

SAME_PLACE = 1e-6  # nodes nearer than this share of the mesh's size coincide


def label_bodies(mesh: MeshData) -> tuple[int, Indices]:
    """The number of bodies, which share no node, and the body of each node: (n,)."""
    return components(edges_of(mesh.cells), len(mesh.points))


def coincident_nodes(mesh: MeshData, body: Indices) -> Indices:
    """Pairs of nodes of different bodies that coincide: (k, 2)."""
    from scipy.spatial import cKDTree  # for meshes of several bodies only

    reach = SAME_PLACE * float(np.ptp(mesh.points, axis=0).max())
    pairs: Indices = cKDTree(mesh.points).query_pairs(reach, output_type="ndarray").astype(np.int64)
    return pairs[body[pairs[:, 0]] != body[pairs[:, 1]]]


def join_bodies(mesh: MeshData) -> MeshData:
    """The mesh with one node in place of the coincident nodes of different bodies, and a note.

    Nodes of one body at the same place stay apart, as along a crack.

    Raises:
        MeshError: several bodies without coincident nodes, or nodes that coincide with two nodes of one other body.
    """
    count, body = label_bodies(mesh)
    if count == 1:
        return replace(mesh, notes=(*mesh.notes, "[mesh] join = true: the mesh is one body already."))
    pairs = coincident_nodes(mesh, body)
    if len(pairs) == 0:
        raise MeshError(
            f"[mesh] join = true, and no nodes of the {count} bodies are at the same place (within {SAME_PLACE:g} of "
            "the mesh's size). Mesh the parts so that common faces have common nodes, or leave join out."
        )
    clusters, cluster = components(pairs, len(mesh.points))
    _refuse_cracks(mesh, body, cluster)
    retained = np.unique(cluster, return_index=True)[1]
    groups = {name: cluster[facets] for name, facets in mesh.facet_groups.items()}
    joined = replace(mesh, points=mesh.points[retained], cells=cluster[mesh.cells], facet_groups=groups)
    left = label_bodies(joined)[0]
    note = (
        f"{len(mesh.points) - clusters} nodes were joined with coincident nodes of another body: {count} bodies are "
        f"{left} now."
    )
    return replace(joined, notes=(*mesh.notes, note))


def _refuse_cracks(mesh: MeshData, body: Indices, cluster: Indices) -> None:
    """MeshError where two nodes of one body would become one by way of another body."""
    order = np.lexsort((body, cluster))
    same = (np.diff(cluster[order]) == 0) & (np.diff(body[order]) == 0)
    if same.any():
        where = format_point(mesh.points[order[np.flatnonzero(same)[0]]])
        raise MeshError(
            f"[mesh] join = true: {int(same.sum())} nodes coincide with two nodes of one other body, the first at "
            f"{where} m: that body is open there, as along a crack, and which side is joined is not known. Join these "
            "nodes in the file, or move them apart."
        )
