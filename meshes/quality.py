"""Quality measures of the cells of a mesh."""

from __future__ import annotations

import numpy as np

from .data import Indices, MeshData, Points
from .topology import Floats, edges_of, signed_measures

POOR = 0.2  # radius ratio below which a cell is counted as poor


def mesh_quality(mesh: MeshData) -> dict[str, float | int]:
    """Sizes, radius ratios, angles and aspect ratios of a mesh of triangles or tetrahedra.

    Returns:
        nodes, cells: counts.
        edge_min, edge_median, edge_max: lengths over all edges, each once [m].
        volume: of all cells [m^3], or their area in 2D [m^2].
        radius_ratio_min, radius_ratio_median: d r / R with r the radius of the inscribed and R of the circumscribed
            circle or sphere; 1 for a regular cell, 0 for a flat one.
        angle_min, angle_max: angles between facets: dihedral, or the triangle's own in 2D [degrees]. A regular
            tetrahedron has 70.5 and an equilateral triangle 60.
        aspect_max: longest edge over shortest height; 1.22 for a regular tetrahedron, 1.15 for a triangle.
        poor_cells: cells with a radius ratio below 0.2.
    """
    edges = _lengths(mesh.points, edges_of(mesh.cells))
    gradients = _height_vectors(mesh.points, mesh.cells)
    ratio = radius_ratios(mesh.points, mesh.cells)
    angles = _angles(gradients)
    pairs = np.triu_indices(mesh.dim + 1, k=1)
    longest = _lengths(mesh.points, mesh.cells[:, np.stack(pairs, axis=1)]).max(axis=1)
    return {
        "nodes": len(mesh.points),
        "cells": len(mesh.cells),
        "edge_min": float(edges.min()),
        "edge_median": float(np.median(edges)),
        "edge_max": float(edges.max()),
        "volume": float(signed_measures(mesh.points, mesh.cells).sum()),
        "radius_ratio_min": float(ratio.min()),
        "radius_ratio_median": float(np.median(ratio)),
        "angle_min": float(np.degrees(angles.min())),
        "angle_max": float(np.degrees(angles.max())),
        "aspect_max": float((longest * np.linalg.norm(gradients, axis=2).max(axis=1)).max()),
        "poor_cells": int((ratio < POOR).sum()),
    }


def radius_ratios(points: Points, cells: Indices) -> Floats:
    """(m,) radius ratio d r / R of each cell, in [0, 1].

    r = 1 / sum_i |g_i| with g_i the gradients of the barycentric coordinates; the circumcentre c (seen from the first
    node) solves 2 (x_i - x_0) . c = |x_i - x_0|^2, and R = |c|.
    """
    dim = points.shape[1]
    inner = 1.0 / np.linalg.norm(_height_vectors(points, cells), axis=2).sum(axis=1)
    spans = points[cells[:, 1:]] - points[cells[:, :1]]
    squares = np.einsum("mij,mij->mi", spans, spans)
    centre = np.linalg.solve(2 * spans, squares[:, :, None])[:, :, 0]
    return dim * inner / np.linalg.norm(centre, axis=1)


def _height_vectors(points: Points, cells: Indices) -> Floats:
    """(m, d + 1, d) gradients of the barycentric coordinates [1/m]: along the heights, one over their length."""
    spans = points[cells[:, 1:]] - points[cells[:, :1]]
    gradients = np.linalg.inv(spans).transpose(0, 2, 1)
    return np.concatenate([-gradients.sum(axis=1, keepdims=True), gradients], axis=1)


def _angles(gradients: Floats) -> Floats:
    """(m, pairs) angle between each two facets of each cell [rad]: pi less the angle between their inner normals."""
    unit = gradients / np.linalg.norm(gradients, axis=2, keepdims=True)
    first, second = np.triu_indices(gradients.shape[1], k=1)
    return np.arccos(np.clip(-np.einsum("mpi,mpi->mp", unit[:, first], unit[:, second]), -1.0, 1.0))


def _lengths(points: Points, pairs: Indices) -> Floats:
    """(...) lengths of node pairs (..., 2) [m]."""
    return np.linalg.norm(points[pairs[..., 0]] - points[pairs[..., 1]], axis=-1)
