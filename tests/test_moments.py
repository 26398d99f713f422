"""Volume, centre and inertia of what a split surface encloses, against closed forms and the cells themselves."""

from __future__ import annotations

import numpy as np
import pytest

from fracsim.mesh.split_surface.closed_surface import build_split_surface
from fracsim.mesh.split_surface.entity_numbering import EntityNumbering
from fracsim.mesh.split_surface.polyhedron_moments import PolyhedronMoments, moments
from fracsim.meshes.topology import signed_measures
from support.solids import cloud, lattice, patterns, separated, torn


@pytest.mark.parametrize("dim", [2, 3])
def test_whole_bodies_have_the_moments_of_their_cells(dim: int) -> None:
    """Degree-2 quadrature on every cell: weights and points that integrate x x^T exactly, and nothing of cones."""
    mesh = cloud(dim, 3)
    made = torn(mesh, np.zeros(len(EntityNumbering(mesh).edges), bool))
    found = moments(made.points + 5.0, made.elements, np.zeros(len(made.elements), int), 1)
    corners, volume = mesh.points[mesh.cells] + 5.0, signed_measures(mesh.points, mesh.cells)
    a = 1 / 6 if dim == 2 else (5 - 5**0.5) / 20
    inner = np.full((dim + 1, dim + 1), a) + (1 - (dim + 1) * a) * np.eye(dim + 1)
    at = np.einsum("qk,ckd->cqd", inner, corners).reshape(-1, dim)
    weight = np.repeat(volume / (dim + 1), dim + 1)
    centre = weight @ at / weight.sum()
    arm = at - centre
    assert found.volume[0] == pytest.approx(volume.sum(), rel=1e-13)
    assert np.allclose(found.centre[0], centre, rtol=1e-13)
    assert np.allclose(found.second[0], np.einsum("q,qi,qj->ij", weight, arm, arm), atol=1e-14)


def test_pieces_of_a_cut_block_are_boxes() -> None:
    """Cut across at x = 0.3 of 1: the inertia of a box of sides a, b, c per density is a b c (b^2 + c^2) / 12."""
    mesh, x = lattice(4, 2, 2, size=0.25), 0.3
    skeleton = EntityNumbering(mesh)
    low, high = mesh.points[skeleton.edges][:, :, 0].T
    broken = separated(skeleton, (mesh.points[:, 0] > x).astype(int))
    share = np.where(broken, (x - low) / np.where(broken, high - low, 1.0), np.nan)
    made = build_split_surface(skeleton, patterns(skeleton, broken), share)
    found = moments(made.points, made.elements, made.point_fragment[made.elements[:, 0]], made.fragment_count)
    for piece, length in enumerate((x, 1 - x)):
        sides = np.array([length, 0.5, 0.5])
        squares = sides**2
        assert np.allclose(found.inertia[piece], np.diag(sides.prod() * (squares.sum() - squares) / 12), atol=1e-15)
        assert np.allclose(found.centre[piece], [length / 2 if piece == 0 else (1 + x) / 2, 0.25, 0.25])


@pytest.mark.parametrize("dim", [2, 3])
def test_parts_sum_to_the_whole(dim: int) -> None:
    """Random cuts: volumes, first and second moments about one point (Steiner) are those of the whole body."""
    mesh = cloud(dim, 5)
    skeleton = EntityNumbering(mesh)
    rng = np.random.default_rng(2)
    broken = separated(skeleton, rng.integers(0, 4, len(mesh.points)))
    found = []
    for each in (broken, np.zeros_like(broken)):
        made = torn(mesh, each)
        of = moments(made.points, made.elements, made.point_fragment[made.elements[:, 0]], made.fragment_count)
        found.append(about_origin(of))
    assert made.fragment_count == 1
    for parts, whole in zip(*found, strict=True):
        assert np.allclose(parts, whole, atol=1e-13)


def about_origin(of: PolyhedronMoments) -> list[np.ndarray]:
    """Sums over bodies of volume, first and second moments about the origin."""
    carried = np.einsum("n,ni,nj->nij", of.volume, of.centre, of.centre)
    first = (of.volume[:, None] * of.centre).sum(axis=0)
    return [of.volume.sum(keepdims=True), first, (of.second + carried).sum(axis=0)]
