"""Meshes with damage for the tests of the split surface, and what a closed surface must satisfy."""

from __future__ import annotations

import math
from itertools import permutations

import numpy as np
import numpy.typing as npt
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import Delaunay

from fracsim.mesh.split_surface.closed_surface import SplitSurface, build_split_surface
from fracsim.mesh.split_surface.entity_numbering import EntityNumbering
from fracsim.meshes.data import MeshData
from fracsim.meshes.topology import orient_cells, signed_measures

Values = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]
Flags = npt.NDArray[np.bool_]
EPS = np.finfo(float).eps


def one_cell(dim: int) -> MeshData:
    """A skew simplex."""
    points = np.vstack([np.zeros(dim), np.eye(dim)]) + 0.1 * np.arange(dim * (dim + 1)).reshape(-1, dim) ** 0.5
    return MeshData(points, orient_cells(points, np.arange(dim + 1)[None])[0])


def two_cells(dim: int) -> MeshData:
    """Two simplices with a facet in common."""
    points = np.vstack([np.zeros(dim), np.eye(dim), np.full(dim, 0.9)])
    cells = np.array([np.arange(dim + 1), np.arange(1, dim + 2)])
    return MeshData(points, orient_cells(points, cells)[0])


def four_cells(dim: int) -> MeshData:
    """Four cells around an inner edge of tetrahedra or an inner node of triangles."""
    ring = [[1, 0], [0, 1], [-1, 0], [0, -1]]
    if dim == 2:
        points = np.array([[0.1, 0.2], *ring])
        cells = np.array([[0, 1 + k, 1 + (k + 1) % 4] for k in range(4)])
    else:
        points = np.array([[0.1, 0.2, -1], [0, 0.1, 1], *([x, y, 0.1 * x] for x, y in ring)])
        cells = np.array([[0, 1, 2 + k, 2 + (k + 1) % 4] for k in range(4)])
    return MeshData(points, orient_cells(points, cells)[0])


def cloud(dim: int, seed: int, nodes: int = 40) -> MeshData:
    """The Delaunay triangulation of random points: cells of every shape."""
    points = np.random.default_rng(seed).random((nodes, dim))
    return MeshData(points, orient_cells(points, Delaunay(points).simplices.astype(np.int64))[0])


def copies(mesh: MeshData, count: int) -> MeshData:
    """The same body many times, side by side."""
    shift = np.zeros((count, 1, mesh.dim))
    shift[:, 0, 0] = 3.0 * np.arange(count) / count  # they overlap, which does not matter, and stay near the origin
    cells = mesh.cells + len(mesh.points) * np.arange(count)[:, None, None]
    return MeshData((mesh.points + shift).reshape(-1, mesh.dim), cells.reshape(-1, mesh.dim + 1))


def lattice(*numbers: int, size: float = 1.0) -> MeshData:
    """numbers[0] x ... cubes (squares) of side `size`, each cut into d! simplices after Kuhn."""
    dim = len(numbers)
    grid = np.indices([n + 1 for n in numbers]).reshape(dim, -1).T
    number = np.arange(len(grid)).reshape([n + 1 for n in numbers])
    base = np.indices(numbers).reshape(dim, -1).T
    corners = [base + np.cumsum(np.vstack([np.zeros(dim, int), np.eye(dim, dtype=int)[list(order)]]), axis=0)[:, None]
               for order in permutations(range(dim))]  # fmt: skip
    cells = np.concatenate([number[tuple(np.moveaxis(corner, -1, 0))].T for corner in corners])
    points = grid * size
    return MeshData(points.astype(float), orient_cells(points.astype(float), cells)[0])


def patterns(skeleton: EntityNumbering, broken: Flags) -> npt.NDArray[np.uint8]:
    """Bit k of a cell: its local edge k is broken."""
    return (broken[skeleton.cell_edges] @ (1 << np.arange(skeleton.cell_edges.shape[1]))).astype(np.uint8)


def torn(mesh: MeshData, broken: Flags, cut: Values | None = None) -> SplitSurface:
    """The split surface of a mesh with broken edges (E,)."""
    skeleton = EntityNumbering(mesh)
    return build_split_surface(skeleton, patterns(skeleton, broken), cut)


def separated(skeleton: EntityNumbering, part: Ints) -> Flags:
    """(E,) edges between nodes of different parts (N,)."""
    return part[skeleton.edges[:, 0]] != part[skeleton.edges[:, 1]]


# --- what must hold ---


def assert_closed(made: SplitSurface) -> None:
    """3D: every directed edge of a triangle stands there once, and once reversed. 2D: a vertex has one in, one out."""
    corners, size = made.elements, len(made.points)
    if corners.shape[1] == 2:
        into, out = (np.bincount(each, minlength=size) for each in corners.T)
        assert np.array_equal(into, out)
        assert out.max() == 1
        return
    first, second = np.concatenate([corners[:, [0, 1]], corners[:, [1, 2]], corners[:, [2, 0]]]).T
    there, back = first * size + second, second * size + first
    assert len(np.unique(there)) == len(there)
    assert np.array_equal(np.sort(there), np.sort(back))


def enclosed(points: Values, corners: Ints, label: Ints, count: int) -> tuple[Values, float]:
    """Volume enclosed by each label, sum of det(x_0 .. x_d-1) / d!, and a bound on its round-off."""
    each = np.linalg.det(points[corners]) / math.factorial(points.shape[1])
    slack = (20 + len(each) ** 0.5) * EPS * float(np.abs(each).sum())
    return np.bincount(label, each, minlength=count), slack


def assert_volume(mesh: MeshData, made: SplitSurface) -> float:
    """The divergence theorem gives the volume of the mesh; returns the relative error."""
    (found,), slack = enclosed(made.points, made.elements, np.zeros(len(made.elements), int), 1)
    expected = signed_measures(mesh.points, mesh.cells).sum()
    assert abs(found - expected) <= slack
    return float(abs(found - expected) / expected)


def assert_pieces(mesh: MeshData, made: SplitSurface, broken: Flags) -> None:
    """Parts of the surface that share points lie in one component of the graph, and every component has some."""
    skeleton = EntityNumbering(mesh)
    count, piece = components(len(mesh.points), skeleton.edges[~broken])
    assert made.fragment_count == count
    assert len(np.unique(np.stack([piece, made.node_fragment]), axis=1).T) == count
    assert np.all(np.diff(np.unique(made.node_fragment, return_index=True)[1]) > 0)  # numbered by their lowest node
    follow = made.parents
    of_parent = piece[follow.parents]
    lowest = np.minimum.reduceat(of_parent, follow.start[:-1])
    assert np.array_equal(lowest, np.maximum.reduceat(of_parent, follow.start[:-1]))  # parents of one piece
    links = np.concatenate([made.elements[:, [k, k + 1]] for k in range(made.elements.shape[1] - 1)])
    _, part = components(len(made.points), links)
    used = np.unique(made.elements)
    pairs = np.unique(np.stack([part[used], lowest[used]], axis=1), axis=0)
    assert len(np.unique(pairs[:, 0])) == len(pairs)  # a part of the surface is of one piece
    assert np.array_equal(np.unique(pairs[:, 1]), np.arange(count))  # every piece has a surface


def components(count: int, links: Ints) -> tuple[int, Ints]:
    graph = coo_matrix((np.ones(len(links)), links.T), shape=(count, count))
    number, label = connected_components(graph, directed=False)
    return int(number), label
