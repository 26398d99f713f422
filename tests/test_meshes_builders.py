"""Builders against closed forms: volume, boundary, groups, bounds; and their messages."""

from __future__ import annotations

import json
import signal
import sys
from dataclasses import replace
from functools import cache
from math import comb, cos, log, pi, radians, sin, tan
from subprocess import run
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from fracsim.errors import Stopped
from fracsim.meshes import BUILDERS, MeshData, MeshError
from fracsim.meshes.builders.figure import BLEND, RoundCone
from fracsim.meshes.builders.vase import CONTROL
from fracsim.meshes.check import check_mesh
from fracsim.meshes.data import Indices, Points
from fracsim.meshes.quality import mesh_quality
from fracsim.meshes.surfaces.level_set import level_surface
from fracsim.meshes.topology import boundary_facets, distinct_rows, facets_of, signed_measures

CASES: list[tuple[str, dict[str, Any]]] = [
    ("box", {"size": (1.0, 2.0), "h": 0.2}),
    ("box", {"size": (1.0, 0.5, 0.5), "h": 0.2, "origin": (0.1, -1.0, 3.0)}),
    ("box", {"size": (1.0, 2.0), "h": 0.2, "pattern": "unstructured"}),
    ("box", {"size": (1.0, 0.5, 0.5), "h": 0.2, "origin": (1.0, 2.0, 3.0), "pattern": "unstructured"}),
    ("sphere", {}),
    ("sphere", {"radius": 0.3, "h": 0.15}),
    ("capsule", {"h": 0.015}),
    ("capsule", {"h": 0.015, "length": 0.1, "axis": "y"}),
    ("cylinder", {"h": 0.015}),
    ("cylinder", {"h": 0.015, "axis": "x"}),
    ("disk", {}),
    ("disk", {"arc": 10.0}),
    ("figure", {}),
    ("figure", {"height": 0.4, "wall": 0.0095, "h": 0.0115}),
    ("loaf", {"h": 0.012}),
    ("notched-bar", {"h": 0.002, "h_notch": 0.0004}),
    ("notched-bar", {"thickness": 0.0}),
    ("notched-bar", {"thickness": 0.0, "notch": "U", "span": 0.0}),
    ("notched-bar", {"thickness": 0.0, "notch": "slit", "refined": 0.004}),
    ("l-panel", {}),
    ("l-panel", {"thickness": 0.1, "h": 0.05, "h_corner": 0.03}),
    ("notched-plate", {}),
    ("notched-plate", {"thickness": 0.004, "h": 0.003, "h_tip": 0.001}),
    ("plate-hole", {}),
    ("plate-hole", {"length": 0.04, "thickness": 0.01, "h_hole": 0.002}),
    ("boat", {}),
    ("ornament", {}),
    ("ornament", {"neck": 0.0, "h": 0.01}),
    ("stones", {"count": 12, "aside": (3, 2)}),
    ("vase", {"h": 0.01}),
    ("vase", {"wall": 0.0, "h": 0.012}),
    ("vase", {"wall": 0.004, "h": 0.008, "height": 0.3}),
    ("notched-plate", {"length": 1e-3, "height": 1e-3, "notch_length": 5e-4, "notch_width": 5e-6, "h": 4e-5}),
]


def names(case: tuple[str, dict[str, Any]]) -> str:
    return case[0] + "-" + "-".join(str(v) for v in case[1].values())


@cache
def made(name: str, parameters: str = "{}") -> tuple[Any, MeshData]:
    """A builder, of parameters as JSON, and its mesh: made once."""
    builder: Any = BUILDERS[name](**json.loads(parameters))
    return builder, builder.build()


@pytest.fixture(scope="module", params=CASES, ids=names)
def built(request: pytest.FixtureRequest) -> tuple[Any, MeshData]:
    name, parameters = request.param
    return made(name, json.dumps(parameters))


def facet_measures(points: Points, facets: Indices) -> npt.NDArray[np.float64]:
    """Lengths of edges (2D), or areas of triangles by Heron's formula."""
    sides = np.linalg.norm(points[facets] - points[np.roll(facets, 1, axis=1)], axis=2)
    if facets.shape[1] == 2:
        return sides[:, 0]
    half = sides.sum(axis=1) / 2
    return np.sqrt(half * np.prod(half[:, None] - sides, axis=1))


def volume(mesh: MeshData) -> float:
    return float(signed_measures(mesh.points, mesh.cells).sum())


def test_cells_are_positive_and_the_check_has_nothing_to_say(built: tuple[Any, MeshData]) -> None:
    builder, mesh = built
    assert signed_measures(mesh.points, mesh.cells).min() > 0
    notes = check_mesh(mesh).notes
    assert len(notes) == 1 and "12 bodies that share no node" in notes[0] if builder.name == "stones" else not notes
    if mesh.shell is not None:
        return  # its cells are as flat as it is thin; its triangles are what is solved on
    quality = mesh_quality(mesh)
    # gmsh may not move the surface of a figure, so that it cannot mend every cell below it: a few in ten thousand
    assert quality["radius_ratio_min"] > (0.05 if builder.name == "figure" else 0.15)
    assert quality["poor_cells"] <= 5e-4 * quality["cells"]


@pytest.mark.parametrize("size", [(1.0, 2.0), (1.0, 0.5, 0.25)])
def test_a_conforming_mesh_stays_as_it_is_unless_its_cells_are_flat(size: tuple[float, ...]) -> None:
    """The full check, which does not know that the box is conforming, changes nothing either."""
    box = BUILDERS["box"](size=size, h=0.25)
    assert box.is_conforming and not replace(box, pattern="unstructured").is_conforming
    mesh = box.build()
    checked = check_mesh(mesh)
    assert check_mesh(mesh, conforming=True) is mesh and not checked.notes
    np.testing.assert_array_equal(checked.points, mesh.points)
    np.testing.assert_array_equal(checked.cells, mesh.cells)
    assert list(checked.facet_groups) == list(mesh.facet_groups)
    for name, facets in mesh.facet_groups.items():
        np.testing.assert_array_equal(checked.facet_groups[name], facets)
    # the sides of cells are as long as the round-off of coordinates
    far = replace(box, origin=(2e15,) * len(size)).build()
    with pytest.raises(MeshError, match="cells have no"):
        check_mesh(far, conforming=True)


def test_facets_are_shared_by_two_cells_and_the_boundary_is_closed(built: tuple[Any, MeshData]) -> None:
    _, mesh = built
    _, counts, _ = distinct_rows(np.sort(facets_of(mesh.cells).reshape(-1, mesh.dim), axis=1))
    assert set(counts) <= {1, 2}
    # The boundary of a boundary is empty: every edge (2D: node) of the boundary lies in exactly two of its facets.
    boundary = boundary_facets(mesh.cells)
    ridges = facets_of(boundary).reshape(-1, 2) if mesh.dim == 3 else boundary.reshape(-1, 1)
    assert set(distinct_rows(np.sort(ridges, axis=1))[1]) == {2}


def test_boundary_normals_point_outwards(built: tuple[Any, MeshData]) -> None:
    """Divergence theorem: the volume is the surface integral of x . n / d."""
    _, mesh = built
    corners = mesh.points[boundary_facets(mesh.cells)]
    centred = corners - mesh.points.mean(axis=0)
    enclosed = np.linalg.det(centred).sum() / (2 if mesh.dim == 2 else 6)
    assert enclosed == pytest.approx(volume(mesh), rel=1e-9)


def test_groups_are_those_announced_and_cover_the_boundary_once(built: tuple[Any, MeshData]) -> None:
    builder, mesh = built
    assert tuple(mesh.facet_groups) and set(mesh.facet_groups) == set(builder.groups)
    assert all(len(facets) for facets in mesh.facet_groups.values())
    # The patches and the grips of a loaf lie in other groups; all others share the boundary among them.
    parts = [f for name, f in mesh.facet_groups.items() if name not in ("support-left", "support-right", "load")]
    if builder.name == "loaf":
        parts = [mesh.facet_groups["bottom"], mesh.facet_groups["crust"]]
    covered = np.concatenate([np.sort(part, axis=1) for part in parts])
    boundary = distinct_rows(np.sort(boundary_facets(mesh.cells), axis=1))[0]
    np.testing.assert_array_equal(distinct_rows(covered)[0], boundary)
    assert len(covered) == len(boundary)


def test_bounds_are_known_before_building(built: tuple[Any, MeshData]) -> None:
    builder, mesh = built
    low, high = builder.bounds()
    size = np.subtract(high, low)
    # A polygon with longest edge e in a circle misses its extremes by up to r (1 - cos(e / 2r)) ~ e^2 / 8r.
    # The blended figure reaches beyond its parts: at a tip of two deep parts, by up to blend * log(2).
    is_round = builder.name in ("capsule", "cylinder", "disk", "ornament", "sphere", "vase")
    facets = mesh.points[boundary_facets(mesh.cells)]
    longest = np.linalg.norm(facets - np.roll(facets, 1, axis=1), axis=2).max()
    slack = max(builder.h, longest) ** 2 / (8 * builder.radius) if is_round else 0.0
    if builder.name == "figure":
        slack = builder.h**2 / (8 * builder.height * 0.03) + builder.height * BLEND * log(2)
    np.testing.assert_allclose(mesh.points.min(axis=0), low, atol=slack + 1e-12 * size.max())
    np.testing.assert_allclose(mesh.points.max(axis=0), high, atol=slack + 1e-12 * size.max())


def test_cells_are_estimated(built: tuple[Any, MeshData]) -> None:
    builder, mesh = built
    assert 1 / 1.5 < builder.cells_estimate() / len(mesh.cells) < 1.5


def test_plane_groups_lie_on_their_planes(built: tuple[Any, MeshData]) -> None:
    builder, mesh = built
    if builder.name not in ("box", "notched-bar", "notched-plate"):
        pytest.skip("round")
    low, high = builder.bounds()
    up = mesh.dim - 1
    planes = {"left": (0, low), "right": (0, high), "bottom": (up, low), "top": (up, high)}
    if mesh.dim == 3:
        planes |= {"front": (1, low), "back": (1, high)}
    for name, (axis, corner) in planes.items():
        assert np.ptp(mesh.points[mesh.facet_groups[name], axis]) <= 1e-12
        np.testing.assert_allclose(mesh.points[mesh.facet_groups[name], axis], corner[axis], atol=1e-12)


# --- measures against closed forms ----------------------------------------------------------------------------------


def test_box_volume_and_sides() -> None:
    mesh = BUILDERS["box"](size=(1.0, 2.0, 0.5), h=0.25).build()
    assert volume(mesh) == pytest.approx(1.0, rel=1e-12)
    assert len(mesh.cells) == 6 * 4 * 8 * 2
    for name, area in {"left": 1.0, "right": 1.0, "front": 0.5, "back": 0.5, "bottom": 2.0, "top": 2.0}.items():
        assert facet_measures(mesh.points, mesh.facet_groups[name]).sum() == pytest.approx(area, rel=1e-12)


def test_box_has_at_least_one_step_a_side() -> None:
    assert BUILDERS["box"](size=(1.0, 0.01), h=1.0).build().cells.shape == (2, 3)


def test_box_edges_have_the_size_asked_for() -> None:
    """Structured: h along the axes; unstructured: half of the edges are shorter than h, half longer."""
    structured = mesh_quality(BUILDERS["box"](size=(1.0, 1.0, 1.0), h=0.1).build())
    assert structured["edge_min"] == pytest.approx(0.1) and structured["edge_max"] == pytest.approx(0.1 * 3**0.5)
    loose = mesh_quality(BUILDERS["box"](size=(1.0, 1.0, 1.0), h=0.1, pattern="unstructured").build())
    assert loose["edge_median"] == pytest.approx(0.1, rel=0.05)


def test_large_structured_box_has_its_cells() -> None:
    mesh = BUILDERS["box"](size=(1.0, 1.0, 2.0), h=1 / 20).build()
    assert len(mesh.cells) == 6 * 20 * 20 * 40 and len(mesh.points) == 21 * 21 * 41


def test_cylinder_volume_is_that_of_its_polygon() -> None:
    """The n nodes of the rim make a regular polygon of area n/2 r^2 sin(2 pi / n); nodes between the ends lie on the
    circle too, at other angles, and the triangles between them cut off a little more or less, of second order in h."""
    builder: Any = BUILDERS["cylinder"](radius=0.05, length=0.2, h=0.01)
    mesh = builder.build()
    rim = np.unique(mesh.facet_groups["bottom"])
    n = int((np.linalg.norm(mesh.points[rim, :2], axis=1) > 0.05 * (1 - 1e-9)).sum())
    polygon = n / 2 * 0.05**2 * sin(2 * pi / n)
    assert facet_measures(mesh.points, mesh.facet_groups["bottom"]).sum() == pytest.approx(polygon, rel=1e-9)
    assert facet_measures(mesh.points, mesh.facet_groups["top"]).sum() == pytest.approx(polygon, rel=1e-9)
    assert volume(mesh) < 0.2 * pi * 0.05**2
    assert volume(mesh) == pytest.approx(0.2 * polygon, rel=(0.01 / 0.05) ** 2 / 6)
    side = mesh.points[np.unique(mesh.facet_groups["side"])]
    np.testing.assert_allclose(np.linalg.norm(side[:, :2], axis=1), 0.05, rtol=1e-9)


def test_sharp_v_notch_area() -> None:
    """A triangle of height a and half-angle t is cut out: a^2 tan t."""
    builder: Any = BUILDERS["notched-bar"](thickness=0.0, notch_radius=0.0)
    wanted = 0.055 * 0.010 - 0.002**2 * tan(radians(22.5))
    assert volume(builder.build()) == pytest.approx(wanted, rel=1e-12)
    assert builder.mouth() == pytest.approx(2 * 0.002 * tan(radians(22.5)))


@pytest.mark.parametrize("notch", ["V", "U"])
def test_rounded_notch_area(notch: str) -> None:
    """Half-angle t (0 for a U), root radius r, depth a. The flanks touch the root circle, of centre (0, a - r), at
    x = r cos t, y = a - r (1 - sin t). Below y lies a trapezoid of half-widths w = x + y tan t and x; above it the
    circular segment of half-angle pi/2 - t: r^2 (pi/2 - t - sin t cos t). The arc is drawn as k chords, which hug the
    notch side of nothing: they leave the segments of the chords, r^2 k (c - sin c) / 2 with c = (pi - 2 t) / k,
    to the body."""
    r, a, t = 0.0005, 0.002, radians(22.5) if notch == "V" else 0.0
    bar = BUILDERS["notched-bar"](thickness=0.0, notch=notch, notch_radius=r, h_notch=5e-5)
    mesh = bar.build()
    x, y = r * cos(t), a - r * (1 - sin(t))
    notch_area = (2 * x + y * tan(t)) * y + r**2 * (pi / 2 - t - sin(t) * cos(t))
    middles = mesh.points[mesh.facet_groups["notch"]].mean(axis=1)
    k = int((middles[:, 1] > y).sum())
    chord = (pi - 2 * t) / k
    left_to_body = r**2 * k * (chord - sin(chord)) / 2
    assert k > 10
    assert volume(mesh) == pytest.approx(0.055 * 0.010 - notch_area + left_to_body, rel=1e-9)


def test_charpy_supports_lie_where_they_should() -> None:
    _, mesh = made("notched-bar", json.dumps({"h": 0.002, "h_notch": 0.0004}))
    for name, x, z in (("support-left", 0.0075, 0.0), ("support-right", 0.0475, 0.0), ("load", 0.0275, 0.010)):
        patch = mesh.facet_groups[name]
        assert facet_measures(mesh.points, patch).sum() == pytest.approx(0.001 * 0.010, rel=1e-9)
        assert mesh.points[np.unique(patch), 0].min() == pytest.approx(x - 0.0005)
        assert mesh.points[np.unique(patch), 0].max() == pytest.approx(x + 0.0005)
        np.testing.assert_allclose(mesh.points[np.unique(patch), 2], z, atol=1e-15)


@pytest.mark.parametrize("name", ["notched-bar", "notched-plate"])
def test_slit_area(name: str) -> None:
    """Flanks w apart to a - w/2, then a right-angled point of height w/2: w (a - w/2) + w^2/4."""
    if name == "notched-bar":
        mesh, a, w, body = BUILDERS[name](thickness=0.0, notch="slit").build(), 0.002, 0.0005, 0.055 * 0.01
    else:
        mesh, a, w, body = BUILDERS[name]().build(), 0.05, 0.0005, 0.1 * 0.04
    assert volume(mesh) == pytest.approx(body - (w * (a - w / 2) + w**2 / 4), rel=1e-12)
    # flanks and the two sides of the point, each w / sqrt(2)
    length = 2 * (a - w / 2) + 2 * w / 2**0.5
    assert facet_measures(mesh.points, mesh.facet_groups["notch"]).sum() == pytest.approx(length, rel=1e-9)


def test_an_l_is_three_quarters_of_a_square() -> None:
    """And its inner corner and the seat are nodes."""
    mesh = BUILDERS["l-panel"](seat=0.04).build()
    assert volume(mesh) == pytest.approx(0.75 * 0.25, rel=1e-12)
    assert facet_measures(mesh.points, mesh.facet_groups["corner"]).sum() == pytest.approx(0.5, rel=1e-9)
    for wanted in ([0.25, 0.25], [0.46, 0.25]):
        assert np.linalg.norm(mesh.points - wanted, axis=1).min() < 1e-12


def test_cells_are_fine_ahead_of_the_tip_only() -> None:
    mesh = BUILDERS["notched-plate"](h=0.002, h_tip=0.0005, refined=0.02).build()
    middles = mesh.points[mesh.cells].mean(axis=1)
    size = np.sqrt(signed_measures(mesh.points, mesh.cells) / 0.433)
    ahead = (np.abs(middles[:, 1] - 0.02) < 0.0005) & (middles[:, 0] > 0.05) & (middles[:, 0] < 0.07)
    assert np.median(size[ahead]) == pytest.approx(0.0005, rel=0.25)
    assert np.median(size[middles[:, 0] < 0.03]) == pytest.approx(0.002, rel=0.25)


def test_disk_with_arcs_has_its_platens() -> None:
    """Arcs of angle a: chords that miss the arc by a share of (h / r)^2 / 24; their ends and the axes' are nodes."""
    r, h, arc = 0.05, 0.004, 10.0
    mesh = BUILDERS["disk"](radius=r, h=h, arc=arc).build()
    for name, sign in (("top", 1), ("bottom", -1)):
        facets = mesh.facet_groups[name]
        assert facet_measures(mesh.points, facets).sum() == pytest.approx(r * radians(arc), rel=(h / r) ** 2 / 6)
        ends = r * np.array([sin(radians(arc / 2)), sign * cos(radians(arc / 2))])
        for wanted in (ends, ends * [-1, 1], [0, sign * r]):
            assert np.linalg.norm(mesh.points[facets].reshape(-1, 2) - wanted, axis=1).min() < 1e-12
    for wanted in ([r, 0], [-r, 0]):
        assert np.linalg.norm(mesh.points - wanted, axis=1).min() < 1e-12


def test_plate_with_a_hole_lacks_a_quarter_circle() -> None:
    """Area L H - pi r^2 / 4; the hole's polygon of chords h takes a share of about (h / r)^2 / 6 less."""
    r, fine = 0.01, 0.0005
    mesh = BUILDERS["plate-hole"](length=0.05, height=0.04, radius=r, h=0.004, h_hole=fine).build()
    assert volume(mesh) == pytest.approx(0.05 * 0.04 - pi * r**2 / 4, abs=pi * r**2 / 4 * (fine / r) ** 2 / 3)
    hole = mesh.points[np.unique(mesh.facet_groups["hole"])]
    np.testing.assert_allclose(np.linalg.norm(hole, axis=1), r, rtol=1e-9)
    assert facet_measures(mesh.points, mesh.facet_groups["hole"]).mean() == pytest.approx(fine, rel=0.2)


def test_loaf_without_dome_is_a_block_with_round_edges() -> None:
    """Steiner's formula for a box with edges p, q, s thickened by r: pqs + 2r(pq + qs + sp) + pi r^2 (p + q + s)
    + 4/3 pi r^3. Facets on the round parts cut off a share of about (h / r)^2 / 24 of their volume."""
    r, size, h = 0.025, (0.25, 0.11, 0.10), 0.0125
    mesh = BUILDERS["loaf"](size=size, h=h, rounding=r, bottom_rounding=r, dome=0.0, flare=0.0).build()
    p, q, s = (length - 2 * r for length in size)
    rounded = pi * r**2 * (p + q + s) + 4 / 3 * pi * r**3
    wanted = p * q * s + 2 * r * (p * q + q * s + s * p) + rounded
    assert volume(mesh) == pytest.approx(wanted, abs=rounded * (h / r) ** 2 / 6)


def test_loaf_has_a_flat_bottom_grips_and_a_dome() -> None:
    _, mesh = made("loaf", json.dumps({"h": 0.012}))
    assert np.ptp(mesh.points[mesh.facet_groups["bottom"], 2]) <= 0.1 * np.finfo(float).eps
    assert mesh.points[mesh.facet_groups["left"], 0].max() <= -0.125 + 0.03
    assert mesh.points[mesh.facet_groups["right"], 0].min() >= 0.125 - 0.03
    middle = np.abs(mesh.points[:, 0]) < 0.02
    end = np.abs(mesh.points[:, 0]) > 0.10
    assert mesh.points[middle, 2].max() > 1.05 * mesh.points[end, 2].max()


def test_vase_is_a_body_of_revolution() -> None:
    """Pappus: pi times the integral of r^2 dz, here by Simpson's rule over the points of the Bezier curve itself,
    r = sum B_i(t) c_i and z = t height, scaled so that the belly has the radius asked for. The outside is a polyhedron
    with its nodes on the surface, which takes off a share of about (h / r)^2 / 6 of what a solid vase holds."""
    builder: Any = BUILDERS["vase"](wall=0.0, height=0.3, radius=0.1, h=0.015)
    t = np.linspace(0.0, 1.0, 2001)
    basis = np.array([comb(6, i) * t**i * (1 - t) ** (6 - i) for i in range(7)])
    r = np.array(CONTROL) @ basis
    r *= 0.1 / r.max()
    simpson = np.r_[1.0, np.tile([4.0, 2.0], 999), 4.0, 1.0] / 6000
    wanted = pi * 0.3 * float(simpson @ r**2)
    assert builder.volume() == pytest.approx(wanted, rel=1e-6)
    assert volume(builder.build()) == pytest.approx(wanted, rel=(0.015 / 0.06) ** 2 / 6)


def test_a_hollow_vase_has_a_wall_and_a_floor() -> None:
    """The inside lies `wall` nearer to the axis than the outside, above a floor as thick; volumes as of two solids."""
    builder: Any = BUILDERS["vase"](wall=0.006, h=0.008)
    mesh = builder.build()
    inside = mesh.points[np.unique(mesh.facet_groups["inside"])]
    outside = mesh.points[np.unique(mesh.facet_groups["side"])]
    assert inside[:, 2].min() == pytest.approx(0.006)
    wall = inside[inside[:, 2] > 0.006 + 1e-9]
    np.testing.assert_allclose(np.hypot(*wall[:, :2].T), builder.outline()(wall[:, 2]) - 0.006, atol=1e-6)
    np.testing.assert_allclose(np.hypot(*outside[:, :2].T), builder.outline()(outside[:, 2]), atol=1e-6)
    z = np.linspace(0.006, 0.25, 4001)
    hole = np.trapezoid((builder.outline()(z) - 0.006) ** 2, z) * pi
    solid: Any = BUILDERS["vase"](wall=0.0)
    assert builder.volume() == pytest.approx(solid.volume() - hole, rel=1e-6)
    assert volume(mesh) == pytest.approx(builder.volume(), rel=3.5e-3)


def test_a_round_cone_is_the_hull_of_its_balls() -> None:
    """Its depth is the largest over many balls between the ends, and the gradient that of finite differences."""
    cone = RoundCone((0.1, -0.2, 0.3), (0.6, 0.4, 0.1), 0.3, 0.12)
    points = np.random.default_rng(1).uniform(-0.8, 1.2, (200, 3))
    t = np.linspace(0.0, 1.0, 4001)[:, None]
    centres = np.array(cone.start) + t * np.subtract(cone.end, cone.start)
    radii = 0.3 + t[:, 0] * (0.12 - 0.3)
    wanted = [(radii - np.linalg.norm(point - centres, axis=1)).max() for point in points]
    found, gradient = cone.depth(points)
    np.testing.assert_allclose(found, wanted, atol=1e-6)
    for axis, step in enumerate(1e-6 * np.eye(3)):
        slope = (cone.depth(points + step)[0] - cone.depth(points - step)[0]) / 2e-6
        np.testing.assert_allclose(slope, gradient[:, axis], atol=1e-5)


def test_level_surface_of_a_ball() -> None:
    """Closed (Euler: V - E + F = 2), every node on the sphere, edges of about h, volume short by about (h / r)^2 / 4,
    that of a polyhedron of even triangles inscribed in the sphere."""
    r, h = 0.5, 0.06

    def depth(points: Any) -> tuple[Any, Any]:
        distance = np.linalg.norm(points, axis=1)
        return r - distance, -points / np.maximum(distance, 1e-12)[:, None]

    points, triangles = level_surface(depth, np.full(3, -r), np.full(3, r), h)
    edges = distinct_rows(np.sort(triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1))
    assert set(edges[1]) == {2} and len(points) - len(edges[0]) + len(triangles) == 2
    np.testing.assert_allclose(np.linalg.norm(points, axis=1), r, rtol=1e-9)
    lengths = np.linalg.norm(points[edges[0][:, 0]] - points[edges[0][:, 1]], axis=1)
    assert np.median(lengths) == pytest.approx(h, rel=0.15) and lengths.min() > 0.3 * h and lengths.max() < 2 * h
    oriented = np.abs(np.linalg.det(points[triangles])).sum() / 6
    assert 1 - (h / r) ** 2 / 2 < oriented / (4 / 3 * pi * r**3) < 1


def test_figure_is_symmetric_and_held_at_its_hands_and_feet() -> None:
    """Volume: a sampling of the body at points of its own (not of a lattice); hands and feet lie at its extremes."""
    builder, mesh = made("figure")
    low, high = (np.array(corner) for corner in builder.bounds())
    points = np.random.default_rng(2).uniform(low, high, (150_000, 3))
    wanted = np.prod(high - low) * float((builder.depth(points)[0] > 0).mean())
    assert builder.volume() == pytest.approx(wanted, rel=0.02)
    # nodes on the surface: short by (h / r)^2 / 4 of a body of radius r, limbs of 15 mm and more
    assert 1 - (0.01 / 0.015) ** 2 / 4 < volume(mesh) / wanted < 1
    for left, right in (("left-hand", "right-hand"), ("left-foot", "right-foot")):
        areas = [facet_measures(mesh.points, mesh.facet_groups[name]).sum() for name in (left, right)]
        assert areas[0] == pytest.approx(areas[1], rel=0.05)
        assert mesh.points[mesh.facet_groups[left], 0].min() > 0.03
        assert mesh.points[mesh.facet_groups[right], 0].max() < -0.03
    assert mesh.points[mesh.facet_groups["left-hand"], 0].max() == pytest.approx(high[0], abs=1e-3)


def test_a_hollow_figure_is_nowhere_thinner_than_its_wall() -> None:
    """The least distance between nodes of the inside and of the outside is the wall, less what facets cut off."""
    from scipy.spatial import cKDTree

    mesh = BUILDERS["figure"](wall=0.007, h=0.008).build()
    inside = mesh.points[np.unique(mesh.facet_groups["inside"])]
    outside = mesh.points[np.setdiff1d(np.unique(boundary_facets(mesh.cells)), np.unique(mesh.facet_groups["inside"]))]
    distance = cKDTree(outside).query(inside)[0]
    assert distance.min() > 0.007 * (1 - 1e-6)
    assert np.median(distance) < 0.007 + 0.5 * 0.008


# --- behaviour ------------------------------------------------------------------------------------------------------


def test_the_same_parameters_make_the_same_mesh_quietly(capfd: pytest.CaptureFixture[str]) -> None:
    first, second = (BUILDERS["loaf"](h=0.02).build() for _ in range(2))
    np.testing.assert_array_equal(first.points, second.points)
    np.testing.assert_array_equal(first.cells, second.cells)
    assert capfd.readouterr() == ("", "")


def test_importing_builders_loads_neither_gmsh_nor_meshio() -> None:
    code = (
        "import sys, fracsim.meshes as m; m.BUILDERS['loaf'](); print({'gmsh', 'meshio', 'dolfinx'} & set(sys.modules))"
    )
    done = run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "set()"


def test_stones_are_icosahedra_that_do_not_touch() -> None:
    """Unscattered: 5 (3 + sqrt 5) / 12 a^3 each, the side a = 4 r / sqrt(10 + 2 sqrt 5). Scattered: the balls that
    they lie in are apart."""
    r, side = 0.2, 4 * 0.2 / (10 + 2 * 5**0.5) ** 0.5
    mesh = BUILDERS["stones"](count=5, radius=r, spread=0.0).build()
    assert volume(mesh) == pytest.approx(5 * 5 * (3 + 5**0.5) / 12 * side**3, rel=1e-12)
    stones = BUILDERS["stones"](count=30, aside=(2, 3), radius=r, spread=0.5).build().points.reshape(30, 13, 3)
    reach = np.linalg.norm(stones[:, 1:] - stones[:, :1], axis=2).max(axis=1)
    apart = np.linalg.norm(stones[:, None, 0] - stones[:, 0], axis=2) - reach[:, None] - reach
    assert reach.max() <= 1.5 * r and apart[~np.eye(30, dtype=bool)].min() > 0


def test_gmsh_is_ended_after_an_error() -> None:
    import gmsh

    from fracsim.meshes.gmsh_session import session

    with pytest.raises(MeshError, match=r"gmsh could not make the mesh: .+"), session() as g:
        g.model.mesh.setNode(77, [0, 0, 0], [])
    assert not gmsh.isInitialized()


@pytest.mark.parametrize("dim", [2, 3])
def test_a_signal_while_gmsh_meshes_ends_the_run(dim: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """What a handler raises is neither taken for a failure of gmsh, nor a reason to try another algorithm."""
    import gmsh

    generate, asked = gmsh.model.mesh.generate, []

    def signalled(of: int) -> None:
        asked.append(of)
        if of == dim:
            signal.raise_signal(signal.SIGUSR1)
        generate(of)

    def stop(*_: object) -> None:
        raise Stopped("stopped by signal SIGUSR1")

    monkeypatch.setattr(gmsh.model.mesh, "generate", signalled)
    before = signal.signal(signal.SIGUSR1, stop)
    try:
        with pytest.raises(Stopped, match="SIGUSR1"):
            BUILDERS["cylinder"](radius=0.1, length=0.2, h=0.1).build()
    finally:
        signal.signal(signal.SIGUSR1, before)
    assert asked.count(dim) == 1 and not gmsh.isInitialized()


@pytest.mark.parametrize("size", [(1.0, 1.0), (1.0, 1.0, 1.0)])
def test_another_seed_is_another_mesh_of_the_same_body(size: tuple[float, ...]) -> None:
    """As fine, of the same measure, with other points; the same seed gives the same mesh."""
    one, again, other = (
        BUILDERS["box"](size=size, h=0.25, pattern="unstructured", seed=seed).build() for seed in (1, 1, 2)
    )
    np.testing.assert_array_equal(one.points, again.points)
    np.testing.assert_array_equal(one.cells, again.cells)
    assert not np.array_equal(one.points, other.points)
    assert np.abs(signed_measures(other.points, other.cells)).sum() == pytest.approx(1.0, rel=1e-12)
    assert len(other.cells) == pytest.approx(len(one.cells), rel=0.2)


BAD: list[tuple[str, dict[str, Any], str]] = [
    ("box", {"size": (1.0,)}, r"box: size = \[1.0\] must have two entries"),
    ("box", {"size": (1.0, -1.0)}, r"box: size\[1\] = -1.0 must be a positive number"),
    ("box", {"h": float("nan")}, "box: h = nan must be a positive number"),
    ("box", {"h": "fine"}, "box: h = 'fine' must be a positive number"),
    ("box", {"h": 1e-6}, "h = 1e-06 m would make about .* cells"),
    ("box", {"origin": (0.0, 0.0)}, "origin = .* must have as many numbers as size"),
    ("box", {"pattern": "unstructured", "seed": 0}, "box: seed = 0 must be 1 or more"),
    ("box", {"seed": 2}, 'seed is of random points: give pattern = "unstructured"'),
    ("box", {"pattern": "hex"}, "pattern = 'hex' is not one of structured, unstructured"),
    ("cylinder", {"length": 0.0}, "cylinder: length = 0.0 must be a positive number"),
    ("cylinder", {"axis": "w"}, "axis = 'w' is not one of x, y, z"),
    ("disk", {"radius": -1.0}, "disk: radius = -1.0"),
    ("notched-bar", {"notch_depth": 0.02}, "notch_depth = 0.02 must be less than height = 0.01"),
    ("notched-bar", {"notch_depth": 1e-5}, "more than the .* m that the root of the notch takes"),
    ("notched-bar", {"notch_angle": 200.0}, "notch_angle = 200.0 must lie between 0 and 180 degrees"),
    ("notched-bar", {"notch_angle": 176.0}, "the notch is .* m wide, length = 0.055 m only"),
    ("notched-bar", {"span": 0.054}, "span = 0.054 leaves no room"),
    ("notched-bar", {"notch": "W"}, "notch = 'W' is not one of V, U, slit"),
    ("notched-plate", {"notch_length": 0.2}, "notch_length = 0.2 must be less than length = 0.1"),
    ("notched-plate", {"notch_position": 0.04}, "does not lie within height = 0.04"),
    ("l-panel", {"seat": 0.3}, "seat = 0.3 must be less than half of size = 0.5"),
    ("notched-plate", {"notch_width": 0.0}, "notch_width = 0.0 must be a positive number"),
    ("notched-plate", {"thickness": -1.0}, "thickness = -1.0 must be zero or a positive number"),
    ("disk", {"arc": 180.0}, "arc = 180.0 must be at least 0 and less than 180 degrees"),
    ("plate-hole", {"radius": 0.05}, "radius = 0.05 must be less than length = 0.05 and height = 0.05"),
    ("plate-hole", {"h_hole": -1.0}, "h_hole = -1.0 must be a positive number"),
    ("loaf", {"rounding": 0.06}, "rounding = 0.06 .* do not fit a block"),
    ("loaf", {"grip": 0.2}, "grip = 0.2 must be less than half of the length"),
    ("vase", {"wall": 0.05}, "wall = 0.05 must be less than the radius of the neck"),
    ("vase", {"wall": -0.01}, "vase: wall = -0.01 must be zero or a positive number"),
    ("figure", {"wall": 0.05}, "wall = 0.05 must be no more than .* of the thinnest"),
    ("figure", {"wall": 0.004}, "h = 0.01 must be no more than 0.006 m, 1.5 times the wall"),
    ("figure", {"h": 0.05}, "h = 0.05 must be less than .* of the thinnest part"),
    ("stones", {"count": 0}, "stones: count = 0 must be from 1"),
    ("stones", {"aside": (0, 2)}, "aside = .* must be two numbers of 1 or more"),
    ("stones", {"spread": 0.7}, "spread = 0.7 must be at most 0.5"),
    ("loaf", {"dome": 2.0}, "dome = 2.0 must lie between 0 and 1"),
]


@pytest.mark.parametrize(("name", "parameters", "message"), BAD)
def test_bad_parameters_are_named(name: str, parameters: dict[str, Any], message: str) -> None:
    with pytest.raises(MeshError, match=message):
        BUILDERS[name](**parameters)
