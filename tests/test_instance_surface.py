"""The surface of copies of one mesh against that of one mesh of all of them."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest

from fracsim.mesh.split_surface.entity_numbering import EntityNumbering
from fracsim.output.rigid_frames import InstanceSurface
from fracsim.output.surface.body_surface import BodySurface
from fracsim.rigid.instance_placement import InstancePlacement, InstancePoses, place_mesh
from support.solids import lattice, patterns, separated

Values = npt.NDArray[np.float64]
DENSITY = 3.0


def test_it_is_that_of_the_mesh_of_all_copies() -> None:
    """One of three breaks, then another: names, masses, volumes, triangles, and the cells and edges behind them."""
    mesh, still = lattice(3, 2, 2), np.zeros(3)
    places = [InstancePlacement(np.array([5.0 * k, 0, 0]), np.array([0.1 * k, 0.2, 0]), still, still) for k in range(3)]
    whole, copies = place_mesh(mesh, places), InstanceSurface(mesh, InstancePoses.from_placements(places), DENSITY)
    expected, skeleton = BodySurface(whole, DENSITY), EntityNumbering(whole)
    assert copies.edge_count == len(skeleton.edges)
    label = np.zeros(len(whole.points), int)
    pattern, broken = np.zeros(len(whole.cells), np.uint8), np.zeros(len(skeleton.edges), bool)
    for number, x in ((2, 1.5), (0, 0.5)):
        mine = np.arange(len(mesh.points)) + number * len(mesh.points)
        label[mine[mesh.points[:, 0] > x]] = 1
        broken = separated(skeleton, label)
        pattern, cut = patterns(skeleton, broken), np.where(broken, 0.3, np.nan)
        assert np.array_equal(copies.broken_edges(pattern), broken)
        assert copies.update(pattern, cut) and expected.update(pattern, cut)
        assert not copies.update(pattern, cut)
        assert np.array_equal(copies.fragment_names, expected.fragment_names)
        assert copies.volume == pytest.approx(expected.volume)
        assert copies.mass == pytest.approx(expected.mass)
        assert np.array_equal(copies.split.node_fragment, expected.split.node_fragment)
        for mine_rows, rows in zip(rows_of(copies), rows_of(expected), strict=True):
            assert np.allclose(mine_rows, rows)


def rows_of(surface: BodySurface) -> list[Values]:
    """Middles (m, 3) of the triangles, in some order of places, and (m, 4) their pieces, cells, edges and origins."""
    made = surface.split
    middle = made.points[made.elements].mean(axis=1)
    piece = surface.fragment_names[made.point_fragment[made.elements[:, 0]]]
    order = np.lexsort((piece, *np.round(middle, 9).T))
    return [middle[order], np.column_stack([piece, made.cell, made.edge, made.origin])[order]]


def test_pieces_of_earlier_frames_have_their_names_again() -> None:
    """After a restart: the same names as a run that saw them break."""
    mesh, still = lattice(3, 1, 1), np.zeros(3)
    places = [InstancePlacement(np.array([5.0 * k, 0, 0]), still, still, still) for k in range(2)]
    seen, again = (InstanceSurface(mesh, InstancePoses.from_placements(places), DENSITY) for _ in range(2))
    skeleton = EntityNumbering(place_mesh(mesh, places))
    x = np.tile(mesh.points[:, 0], 2)
    first, second = ((x > 1.5) & (np.arange(len(x)) >= len(x) // 2)), x > 0.5
    early = separated(skeleton, first.astype(int))
    late = early | separated(skeleton, second.astype(int))
    seen.update(patterns(skeleton, early))
    seen.update(patterns(skeleton, late))
    again.replay_fragment_names(np.where(early, 1.0, np.where(late, 2.0, np.inf)), [0.0, 1.0])
    again.update(patterns(skeleton, late))
    assert np.array_equal(seen.fragment_names, again.fragment_names) and len(seen.fragment_names) == 5
