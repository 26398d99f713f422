"""Damaged meshes are named or mended; qualities against closed forms."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fracsim.meshes import BUILDERS, MeshData, MeshError
from fracsim.meshes.check import check_mesh
from fracsim.meshes.quality import mesh_quality
from fracsim.meshes.topology import boundary_facets, edges_of, facets_of, signed_measures, sorted_rows

pytestmark = pytest.mark.any_release

SQUARE = MeshData(np.array([[0.0, 0], [1, 0], [1, 1], [0, 1]]), np.array([[0, 1, 2], [0, 2, 3]]))


@pytest.fixture(params=[2, 3])
def mesh(request: pytest.FixtureRequest) -> MeshData:
    return BUILDERS["box"](size=(1.0,) * request.param, h=0.34).build()


def test_good_mesh_passes_unchanged(mesh: MeshData) -> None:
    checked = check_mesh(mesh)
    np.testing.assert_array_equal(checked.cells, mesh.cells)
    assert checked.notes == ()
    for name, facets in mesh.facet_groups.items():
        np.testing.assert_array_equal(checked.facet_groups[name], facets)


def test_orphan_nodes_are_removed_and_groups_follow(mesh: MeshData) -> None:
    shifted = MeshData(
        np.concatenate([np.full((3, mesh.dim), np.nan), mesh.points]),
        mesh.cells + 3,
        {name: facets + 3 for name, facets in mesh.facet_groups.items()},
        {"half": np.arange(2)},
    )
    checked = check_mesh(shifted)
    np.testing.assert_array_equal(checked.points, mesh.points)
    np.testing.assert_array_equal(checked.cells, mesh.cells)
    np.testing.assert_array_equal(checked.facet_groups["top"], mesh.facet_groups["top"])
    np.testing.assert_array_equal(checked.regions["half"], [0, 1])
    assert checked.notes == (f"3 of {len(mesh.points) + 3} nodes belong to no cell and were removed.",)


@settings(max_examples=20, deadline=None)
@given(st.integers(2, 3), st.randoms(use_true_random=False))
def test_inverted_cells_are_turned(dim: int, random: object) -> None:
    mesh = BUILDERS["box"](size=(1.0,) * dim, h=0.5).build()
    generator = np.random.default_rng(random.randint(0, 2**32))  # type: ignore[attr-defined]
    cells = generator.permuted(mesh.cells, axis=1)
    count = int((signed_measures(mesh.points, cells) < 0).sum())
    checked = check_mesh(replace(mesh, cells=cells))
    assert signed_measures(checked.points, checked.cells).min() > 0
    assert checked.notes == (
        (f"{count} of {len(cells)} cells were inverted and have been turned (two nodes swapped).",) if count else ()
    )


def test_coordinates_that_are_no_numbers_are_named(mesh: MeshData) -> None:
    points = mesh.points.copy()
    points[4, 1], points[7, 0] = np.nan, np.inf
    with pytest.raises(
        MeshError, match=r"2 nodes have coordinates that are not finite numbers: node 4, 7, the first at"
    ):
        check_mesh(replace(mesh, points=points))


@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e6])
@pytest.mark.parametrize("away", [0.0, 1e3])
def test_flat_cells_are_named_at_any_scale_and_place(mesh: MeshData, scale: float, away: float) -> None:
    flat = mesh.points.copy()
    inside = int(np.flatnonzero(((flat > 0.1) & (flat < 0.9)).all(axis=1))[0])
    cell = int(np.flatnonzero((mesh.cells == inside).any(axis=1))[0])
    others = mesh.cells[cell][mesh.cells[cell] != inside]
    flat[inside] = flat[others].mean(axis=0)
    good = replace(mesh, points=(mesh.points + away) * scale)
    assert check_mesh(good).notes == ()
    measure = "area" if mesh.dim == 2 else "volume"
    with pytest.raises(MeshError, match=rf"cells have no {measure}: cell .*, the first near \("):
        check_mesh(replace(mesh, points=(flat + away) * scale))


def test_thin_but_sound_cells_are_not_called_flat() -> None:
    """A cell 1e-6 as high as long is poor, but its measure is far above rounding (1e-16)."""
    points = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0.3, 0.3, 1e-6 / 3]])
    assert check_mesh(MeshData(points, np.array([[0, 1, 2, 3]]))).notes == ()


def test_cell_with_a_repeated_node_is_flat() -> None:
    with pytest.raises(MeshError, match="1 cells have no area: cell 1"):
        check_mesh(replace(SQUARE, cells=np.array([[0, 1, 2], [0, 2, 2]]), points=SQUARE.points[:3]))


def test_cell_given_twice_is_named(mesh: MeshData) -> None:
    cells = np.concatenate([mesh.cells, np.roll(mesh.cells[5:6], 1, axis=1)])
    with pytest.raises(MeshError, match=f"2 cells have the same nodes as another cell: cell 5, {len(mesh.cells)}"):
        check_mesh(replace(mesh, cells=cells))


def test_facet_of_three_cells_is_named() -> None:
    points = np.concatenate([SQUARE.points, [[2.0, 0.5]]])
    with pytest.raises(MeshError, match=r"1 facets belong to more than two cells, the first with nodes \[0, 2\]"):
        check_mesh(MeshData(points, np.concatenate([SQUARE.cells, [[0, 2, 4]]])))


def test_folded_cells_are_named() -> None:
    """Node 3 folded over the diagonal onto the side of node 1: turning the cell must not hide it."""
    points = SQUARE.points.copy()
    points[3] = [0.9, 0.05]
    with pytest.raises(MeshError, match=r"1 facets have two cells on the same side.*nodes \[0, 2\]"):
        check_mesh(replace(SQUARE, points=points))


def test_nodes_that_do_not_exist_are_named(mesh: MeshData) -> None:
    cells = mesh.cells.copy()
    cells[2, 1] = 10_000
    with pytest.raises(MeshError, match=r"1 of .* rows name nodes that do not exist .* the first cell 2"):
        check_mesh(replace(mesh, cells=cells))
    with pytest.raises(MeshError, match="group 'top': facet 0"):
        check_mesh(replace(mesh, facet_groups={"top": np.full((1, mesh.dim), -1)}))


def test_shapes_are_checked(mesh: MeshData) -> None:
    with pytest.raises(MeshError, match="points have the shape"):
        check_mesh(replace(mesh, points=np.zeros((4, 1))))
    with pytest.raises(MeshError, match=r"cells have the shape \(0, "):
        check_mesh(replace(mesh, cells=mesh.cells[:0]))
    with pytest.raises(MeshError, match="facets of group 'x' have the shape"):
        check_mesh(replace(mesh, facet_groups={"x": np.zeros((1, 5), np.int64)}))
    with pytest.raises(MeshError, match="Region 'x' names cells that do not exist"):
        check_mesh(replace(mesh, regions={"x": np.array([10_000])}))


def test_group_apart_from_the_body_is_named(mesh: MeshData) -> None:
    lost = np.array([[0, len(mesh.points) - 1, 1][: mesh.dim]])
    with pytest.raises(MeshError, match="1 of the 1 facets of group 'grip' are not facets of any cell"):
        check_mesh(replace(mesh, facet_groups={"grip": lost}))


def test_group_inside_the_body_is_noted_and_copies_are_dropped() -> None:
    groups = {"seam": np.array([[0, 2], [2, 0]]), "bottom": np.array([[0, 1]])}
    checked = check_mesh(replace(SQUARE, facet_groups=groups))
    assert checked.notes == ("1 of the 1 facets of group 'seam' lie inside the body, between two cells.",)


def test_bodies_apart_and_nodes_not_joined_are_noted(mesh: MeshData) -> None:
    """A second box beside the first, touching it without sharing nodes."""
    beside = mesh.points + np.eye(mesh.dim)[0]
    two = MeshData(np.concatenate([mesh.points, beside]), np.concatenate([mesh.cells, mesh.cells + len(mesh.points)]))
    notes = check_mesh(two).notes
    common = len(np.unique(mesh.facet_groups["right"]))
    assert notes[0] == "The mesh has 2 bodies that share no node; each needs its own supports."
    assert notes[1].startswith(f"{2 * common} nodes coincide with nodes of another body, the first at (1, ")
    assert "[mesh] join = true" in notes[1]
    assert len(notes) == 2


@pytest.mark.parametrize("noise", [0.0, 1e-7])
def test_bodies_are_joined_where_their_nodes_coincide(mesh: MeshData, noise: float) -> None:
    """Three boxes in a row; with a crack within the first one, which stays open."""
    count, common = len(mesh.points), len(np.unique(mesh.facet_groups["right"]))
    move = np.eye(mesh.dim)[0]
    points = np.concatenate([mesh.points + shift * move for shift in range(3)])
    points += noise * np.random.default_rng(3).uniform(-1, 1, points.shape)
    cells = np.concatenate([mesh.cells + shift * count for shift in range(3)])
    ends = {"left": mesh.facet_groups["left"], "right": mesh.facet_groups["right"] + 2 * count}
    three = MeshData(points, cells, ends, {"middle": np.arange(len(mesh.cells), 2 * len(mesh.cells))})
    joined = check_mesh(three, join=True)
    assert joined.notes == (
        f"{2 * common} nodes were joined with coincident nodes of another body: 3 bodies are 1 now.",
    )
    assert len(joined.points) == 3 * count - 2 * common and len(joined.cells) == 3 * len(mesh.cells)
    facets = facets_of(joined.cells).reshape(-1, mesh.dim)
    _, counts = np.unique(np.sort(facets, axis=1), axis=0, return_counts=True)
    per_end = len(mesh.facet_groups["right"])
    before = np.unique(np.sort(facets_of(three.cells).reshape(-1, mesh.dim), axis=1), axis=0)
    assert len(counts) == len(before) - 2 * per_end
    for name, at in (("left", 0.0), ("right", 3.0)):
        np.testing.assert_allclose(joined.points[joined.facet_groups[name]][..., 0], at, atol=1e-6)
    where = joined.points[joined.cells[joined.regions["middle"]]].mean(axis=1)[:, 0]
    assert ((where > 1) & (where < 2)).all()


def test_a_crack_stays_open_where_bodies_are_joined() -> None:
    points = np.array([[0.0, 0], [1, 0], [1, 1], [0, 1], [1, 1], [2, 0], [2, 1], [1, 0], [1, 1]])
    cells = np.array([[0, 1, 2], [0, 4, 3], [7, 5, 6], [7, 6, 8]])
    with pytest.raises(MeshError, match=r"1 nodes coincide with two nodes of one other body, the first at \(1, 1\) m"):
        check_mesh(MeshData(points, cells), join=True)
    crack = np.array([[0.0, 0], [1, 0], [1, 1], [0, 1], [1, 1]])
    beside = np.array([[0.0, 0], [0, 1], [-1, 0]])
    two = MeshData(np.concatenate([crack, beside]), np.array([[0, 1, 2], [0, 4, 3], [5, 6, 7]]))
    joined = check_mesh(two, join=True)
    assert len(joined.points) == 6
    assert any("1 nodes lie exactly on another node" in note for note in joined.notes)


def test_join_without_coincident_nodes(mesh: MeshData) -> None:
    assert check_mesh(mesh, join=True).notes == ("[mesh] join = true: the mesh is one body already.",)
    away = mesh.points + 5.0
    two = MeshData(np.concatenate([mesh.points, away]), np.concatenate([mesh.cells, mesh.cells + len(mesh.points)]))
    with pytest.raises(MeshError, match="no nodes of the 2 bodies are at the same place"):
        check_mesh(two, join=True)


def test_bodies_that_touch_in_a_node_or_edge_are_noted() -> None:
    flat = MeshData(np.array([[0.0, 0], [1, 0], [0, 1], [-1, 0], [0, -1]]), np.array([[0, 1, 2], [0, 3, 4]]))
    assert "1 part of the mesh touches the rest in a node only" in check_mesh(flat).notes[0]
    points = np.array([[0.0, 0, 0], [0, 0, 1], [1, 0, 0], [0, 1, 0], [-1, 0, 0], [0, -1, 0]])
    solid = MeshData(points, np.array([[0, 1, 2, 3], [0, 1, 4, 5]]))
    assert "1 part of the mesh touches the rest in an edge or a node only" in check_mesh(solid).notes[-1]


def test_cells_in_two_regions_are_noted() -> None:
    checked = check_mesh(replace(SQUARE, regions={"a": np.array([0, 1]), "b": np.array([1])}))
    assert checked.notes == ("1 cells are in more than one region.",)


# --- quality --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("scale", [1e-3, 1.0, 50.0])
def test_regular_simplices(scale: float) -> None:
    """Equilateral triangle: angles 60, height a sqrt(3)/2, area sqrt(3)/4 a^2. Regular tetrahedron: dihedral angle
    arccos(1/3), height a sqrt(2/3), volume a^3 / (6 sqrt(2)). The radius ratio is 1 for both."""
    triangle = MeshData(scale * np.array([[0.0, 0], [1, 0], [0.5, 3**0.5 / 2]]), np.array([[0, 1, 2]]))
    q = mesh_quality(triangle)
    assert q["radius_ratio_min"] == pytest.approx(1) and q["angle_min"] == pytest.approx(60)
    assert q["aspect_max"] == pytest.approx(2 / 3**0.5) and q["volume"] == pytest.approx(3**0.5 / 4 * scale**2)
    corners = np.array([[1.0, 1, 1], [-1, -1, 1], [-1, 1, -1], [1, -1, -1]]) / 8**0.5
    q = mesh_quality(MeshData(scale * corners, np.array([[0, 2, 1, 3]])))
    assert q["radius_ratio_min"] == pytest.approx(1) and q["angle_max"] == pytest.approx(np.degrees(np.arccos(1 / 3)))
    assert q["aspect_max"] == pytest.approx((3 / 2) ** 0.5) and abs(q["volume"]) == pytest.approx(scale**3 / 72**0.5)
    assert q["edge_min"] == pytest.approx(scale) and q["poor_cells"] == 0


def test_corner_tetrahedron() -> None:
    """Corner of a unit cube: volume 1/6; r = 3 V / A = 1/2 / (3/2 + sqrt(3)/2) = 1 / (3 + sqrt 3); R = sqrt(3)/2;
    three right dihedral angles and three of arctan(sqrt 2); shortest height 1/sqrt(3), longest edge sqrt(2)."""
    mesh = MeshData(np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]]), np.array([[0, 1, 2, 3]]))
    q = mesh_quality(mesh)
    assert q["radius_ratio_min"] == pytest.approx(3 / (3 + 3**0.5) / (3**0.5 / 2))
    assert q["angle_max"] == pytest.approx(90) and q["angle_min"] == pytest.approx(np.degrees(np.arctan(2**0.5)))
    assert q["aspect_max"] == pytest.approx(6**0.5)


def test_poor_cells_are_counted() -> None:
    points = np.array([[0.0, 0], [1, 0], [0.5, 0.01], [0.5, 1]])
    q = mesh_quality(MeshData(points, np.array([[0, 1, 2], [0, 2, 3], [2, 1, 3]])))
    assert q["poor_cells"] == 1 and q["nodes"] == 4 and q["cells"] == 3


# --- topology -------------------------------------------------------------------------------------------------------


def test_euler_characteristic(mesh: MeshData) -> None:
    """Nodes - edges + faces (- cells) = 1 for a body without holes; its boundary has 0 (a ring) or 2 (a sphere)."""
    facets = np.unique(np.sort(facets_of(mesh.cells).reshape(-1, mesh.dim), axis=1), axis=0)
    counts = [len(mesh.points), len(edges_of(mesh.cells)), len(mesh.cells)]
    boundary = boundary_facets(mesh.cells)
    rim = len(np.unique(boundary))
    if mesh.dim == 2:
        assert counts[0] - counts[1] + counts[2] == 1 and len(facets) == counts[1]
        assert rim - len(boundary) == 0
    else:
        assert counts[0] - counts[1] + len(facets) - counts[2] == 1
        assert rim - len(edges_of(boundary)) + len(boundary) == 2


@pytest.mark.parametrize("width", (1, 2, 3, 4, 10))
def test_rows_are_sorted_as_by_numpy(width: int) -> None:
    rows = np.random.default_rng(width).integers(-9, 9, size=(200, width))
    np.testing.assert_array_equal(sorted_rows(rows), np.sort(rows, axis=1))
    assert sorted_rows(rows[:0]).shape == (0, width)
