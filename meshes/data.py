"""The simplex mesh that builders and readers return, its error, and coordinates as text for messages."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

Points = npt.NDArray[np.float64]
Indices = npt.NDArray[np.int64]
AXES = "xyz"


class MeshError(ValueError):
    """A mesh that cannot be built or used; the message tells what is wrong, where, and what to do."""


@dataclass(frozen=True, eq=False)
class Shell:
    """Middle surface of a mesh of n nodes below and n above it, three cells for each triangle (meshes.shell).

    Attributes:
        middle: (2 n, 3) point of the middle surface for each node of the mesh [m].
        triangles: (m, 3) between the first n nodes.
        thickness: [m].
    """

    middle: Points
    triangles: Indices
    thickness: float


@dataclass(frozen=True, eq=False)  # compared by identity, so that a mesh can be a key of what is computed from it
class MeshData:
    """A simplex mesh in arrays, with named groups.

    Attributes:
        points: (n, d) node coordinates in metres, d = 2 or 3.
        cells: (m, d + 1) node indices of triangles (d = 2) or tetrahedra (d = 3), positively oriented.
        facet_groups: name -> (k, d) node indices of boundary edges (d = 2) or triangles (d = 3).
            A facet may be in more than one group.
        regions: name -> (k,) cell indices. Empty: the body is of one material.
        notes: messages to the user about what was mended, one sentence each.
        shell: the middle surface; None of a solid.
        middles: (k, d) midside points of the edges (topology.edges_of) [m]; None: the midpoints.
    """

    points: Points
    cells: Indices
    facet_groups: dict[str, Indices] = field(default_factory=dict)
    regions: dict[str, Indices] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    shell: Shell | None = None
    middles: Points | None = None

    @property
    def dim(self) -> int:
        """Dimension of space, 2 or 3."""
        return int(self.points.shape[1])


def mesh_fingerprint(mesh: MeshData) -> str:
    """First digits of the SHA-256 of a mesh's nodes, cells, groups and regions."""
    parts: list[npt.NDArray[Any]] = [mesh.points, mesh.cells, *([] if mesh.middles is None else [mesh.middles])]
    groups = [*mesh.facet_groups.items(), *mesh.regions.items()]
    for name, members in sorted(groups, key=lambda group: group[0]):
        parts += [np.frombuffer(name.encode(), np.uint8), members]
    return hash_arrays(parts)


def hash_arrays(arrays: Iterable[npt.NDArray[Any]]) -> str:
    """First digits of the SHA-256 of the bytes of arrays."""
    digest = hashlib.sha256()
    for values in arrays:
        digest.update(np.ascontiguousarray(values).reshape(-1).view(np.uint8))
    return digest.hexdigest()[:16]


def format_point(point: Iterable[float]) -> str:
    """A point [m] as text: "(0, 0.5, 1)"."""
    return "(" + ", ".join(f"{value:.4g}" for value in point) + ")"


def list_some(items: Iterable[object], most: int = 5) -> str:
    """The first items, separated by commas, and how many more there are: "a, b and 3 more"; "none" of no items."""
    texts = [str(item) for item in items]
    count = f" and {len(texts) - most} more" if len(texts) > most else ""
    return ", ".join(texts[:most]) + count if texts else "none"


def format_midpoint(points: Points, nodes: Indices) -> str:
    """The centroid of the given nodes as text: "(0, 0.5, 1) m"."""
    return format_point(points[nodes].mean(axis=0)) + " m"
