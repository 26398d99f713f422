"""How far the edges of a mesh prefer some directions: cracks run along edges, and should not be led by them."""

from __future__ import annotations

import numpy as np

from .data import Indices, MeshData
from .topology import Floats, Mask, boundary_facets, edges_of

WITHIN = 3.5  # degrees from one of the three commonest directions, in a plane
CONE = 6.0  # degrees from the commonest direction in space
STEP = 0.5  # degrees between the directions that are tried in a plane
TRIED = 2000  # directions that are tried in space


def preferred(mesh: MeshData, most: int | None = None) -> dict[str, float]:
    """Share of edges near the commonest directions, over what it would be were all directions alike; 1 is isotropic.

    Some more than 1 comes of choosing the commonest: 1.1 for 10,000 edges in the plane, 1.4 for 1,000. Equilateral
    triangles in rows have 8.6. `most`: of a mesh with more cells, the edges of every so many cells alone.

    Returns:
        directions: of edges inside the body, since those of its boundary lie along it. 2D: within 3.5 degrees of the
            three commonest directions. 3D: within 6 degrees of the commonest.
        directions_faces: 3D only: of edges on the boundary, turned in its tangent plane from the axis that is least
            along the normal, within 3.5 degrees of the three commonest angles.
    """
    boundary, cells = boundary_facets(mesh.cells), mesh.cells
    if most is not None and len(cells) > most:
        cells = cells[:: 1 + len(cells) // most]
    edges = edges_of(cells)
    spans = mesh.points[edges[:, 1]] - mesh.points[edges[:, 0]]
    inner = spans[~_on(edges, boundary, len(mesh.points))]
    if mesh.dim == 2:
        return {"directions": _three(np.degrees(np.arctan2(inner[:, 1], inner[:, 0])))}
    return {"directions": _in_space(inner), "directions_faces": _three(_on_faces(mesh, boundary))}


def _on(edges: Indices, boundary: Indices, nodes: int) -> Mask:
    """Which edges (k, 2) are edges of boundary facets: (k,)."""
    return np.isin(edges @ [nodes, 1], edges_of(boundary) @ [nodes, 1])


def _three(angles: Floats) -> float:
    """Share of angles [degrees] near the three commonest, each with the edges of those before it left out."""
    tried = np.arange(0.0, 180.0, STEP)
    near, total = np.mod(angles, 180.0), 0
    for _ in range(3 if len(angles) else 0):
        ranked = np.sort(np.concatenate([near - 180.0, near, near + 180.0]))
        counts = np.searchsorted(ranked, tried + WITHIN, "right") - np.searchsorted(ranked, tried - WITHIN, "left")
        best = int(counts.argmax())
        total += int(counts[best])
        near = near[np.abs((near - tried[best] + 90.0) % 180.0 - 90.0) > WITHIN]
    return total / max(1, len(angles)) / (6 * WITHIN / 180.0)


def _in_space(spans: Floats) -> float:
    """Share of edges within a cone about the commonest of directions spread over the half sphere and the axes."""
    from scipy.spatial import cKDTree

    if len(spans) == 0:
        return 1.0
    unit = spans / np.linalg.norm(spans, axis=1, keepdims=True)
    k = np.arange(TRIED) + 0.5
    up, turn = 1 - k / TRIED, np.pi * (1 + 5**0.5) * k  # a Fibonacci spiral
    tried = np.stack([np.cos(turn) * np.sqrt(1 - up**2), np.sin(turn) * np.sqrt(1 - up**2), up], axis=1)
    reach = 2 * np.sin(np.radians(CONE) / 2)
    combined = cKDTree(np.concatenate([unit, -unit]))
    counts = combined.query_ball_point(np.concatenate([tried, np.eye(3)]), reach, return_length=True)
    return float(counts.max() / len(unit) / (1 - np.cos(np.radians(CONE))))


def _on_faces(mesh: MeshData, boundary: Indices) -> Floats:
    """Angle [degrees] of each edge of each boundary triangle in its plane: (3 k,)."""
    corners = mesh.points[boundary]
    sides = np.roll(corners, -1, axis=1) - corners
    normal = np.cross(sides[:, 0], sides[:, 1])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    axis = np.eye(3)[np.abs(normal).round(6).argmin(axis=1)]
    first = axis - normal * np.einsum("ki,ki->k", axis, normal)[:, None]
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    second = np.cross(normal, first)
    angles = np.arctan2(np.einsum("kei,ki->ke", sides, second), np.einsum("kei,ki->ke", sides, first))
    return np.degrees(angles).ravel()
