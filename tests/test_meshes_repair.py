"""`[mesh] repair = true`: holes, self-intersections and crossing parts, against trimesh (closed), ipctk (no triangles
that pass through others) and the volumes of the bodies that were damaged."""

from __future__ import annotations

import struct
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from fracsim.errors import InputError
from fracsim.meshes import MeshError
from fracsim.meshes.data import Indices, Points
from fracsim.meshes.surfaces import repair as repairing
from fracsim.meshes.surfaces import self_intersection
from fracsim.meshes.surfaces.closed import ClosedSurface, RepairableSurfaceError
from fracsim.meshes.surfaces.fill import fill_surface
from fracsim.meshes.surfaces.repair import read_body, repair_triangles
from fracsim.meshes.surfaces.self_intersection import crossing_triangles
from fracsim.meshes.topology import signed_measures
from fracsim.study import MeshSettings
from fracsim.study.mesh_source import build_mesh, open_surface

trimesh = pytest.importorskip("trimesh")
pytest.importorskip("pymeshfix")
pytest.importorskip("manifold3d")
ipctk = pytest.importorskip("ipctk")
Surface = tuple[Points, Indices]


@pytest.fixture
def own_process() -> None:
    """The repair works in a process of its own, as it does for users."""


@pytest.fixture(autouse=True)
def _here(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Repair and gmsh work in this process, but where a test asks for `own_process`: starting one takes longer."""
    if "own_process" not in request.fixturenames:
        for module in ("repair", "fill"):
            monkeypatch.setattr(
                f"fracsim.meshes.surfaces.{module}.call_with_time_limit", lambda seconds, work, *given: work(*given)
            )


def of(mesh: object) -> Surface:
    return np.array(mesh.vertices, float), np.array(mesh.faces, np.int64)  # type: ignore[attr-defined]


def sphere(level: int = 3) -> Surface:
    return of(trimesh.creation.icosphere(subdivisions=level))


def box(size: tuple[float, float, float], at: tuple[float, float, float] = (0, 0, 0), level: int = 2) -> Surface:
    made = trimesh.creation.box(extents=size)
    for _ in range(level):
        made = made.subdivide()
    return np.array(made.vertices) + at, np.array(made.faces, np.int64)


def joined(*surfaces: Surface) -> Surface:
    starts = np.cumsum([0] + [len(points) for points, _ in surfaces])
    faces = [triangles + start for (_, triangles), start in zip(surfaces, starts, strict=False)]
    return np.concatenate([points for points, _ in surfaces]), np.concatenate(faces)


def without(surface: Surface, *near: tuple[float, float, float], reach: float = 0.3) -> Surface:
    points, triangles = surface
    middles = points[triangles].mean(axis=1)
    away = [np.linalg.norm(middles - place, axis=1) > reach for place in near]
    return points, triangles[np.all(away, axis=0)]


def volume(surface: Surface) -> float:
    a, b, c = surface[0][surface[1]].transpose(1, 0, 2)
    return float(np.einsum("ki,ki", a, np.cross(b, c)) / 6)


def as_blender(path: Path, surface: Surface) -> Path:
    """Text STL, binary STL, OBJ or PLY as Blender's exporters write them."""
    points, triangles = surface
    if path.suffix == ".stl":
        rows = np.zeros(len(triangles), [("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
        rows["corners"] = points[triangles]
        head = b"Exported from Blender-4.2.0".ljust(80, b"\0") + struct.pack("<I", len(rows))
        path.write_bytes(head + rows.tobytes())
    elif path.suffix == ".obj":
        lines = ["# Blender 4.2.0", "# www.blender.org", "mtllib part.mtl", "o Part.001"]
        lines += [f"v {x:.6f} {y:.6f} {z:.6f}" for x, y, z in points] + [
            "vn 0.0000 0.0000 1.0000",
            "vt 0.500000 0.500000",
        ]
        lines += ["s 1", "usemtl Material"] + ["f " + " ".join(f"{i + 1}/1/1" for i in face) for face in triangles]
        path.write_text("\n".join(lines) + "\n")
    else:  # MeshLab's binary PLY
        head = ["ply", "format binary_little_endian 1.0", "comment VCGLIB generated", f"element vertex {len(points)}"]
        head += [f"property double {axis}" for axis in "xyz"] + [f"element face {len(triangles)}"]
        head += ["property list uchar int vertex_indices", "end_header"]
        faces = np.zeros(len(triangles), [("count", "u1"), ("nodes", "<i4", 3)])
        faces["count"], faces["nodes"] = 3, triangles
        path.write_bytes(("\n".join(head) + "\n").encode() + points.astype("<f8").tobytes() + faces.tobytes())
    return path


def pushed_through(depth: float) -> Surface:
    """A ball with a narrow dent: its point lies `depth` below a pole."""
    points, triangles = sphere(4)
    away = np.exp(-((points - points[0]) ** 2).sum(axis=1) / 0.03)
    return points - depth * away[:, None] * points[0], triangles


def saved(folder: Path, surface: Surface) -> Path:
    return as_blender(folder / "part.ply", surface)


def assert_sound(surface: ClosedSurface) -> None:
    """Closed and turned alike by trimesh; nothing passes through anything by ipctk."""
    assert trimesh.Trimesh(surface.points, surface.triangles, process=False).is_volume
    assert not passes_through(surface.points, surface.triangles)


def passes_through(points: Points, triangles: Indices) -> bool:
    edges = ipctk.edges(triangles.astype(np.int32))
    mesh = ipctk.CollisionMesh(points, edges, triangles.astype(np.int32))
    return bool(ipctk.has_intersections(mesh, points))


@pytest.mark.parametrize("ending", ["stl", "obj", "ply"])
def test_holes_are_filled(tmp_path: Path, ending: str) -> None:
    whole = sphere()
    damaged = without(whole, (0, 0, 1), (1, 0, 0), reach=0.25)
    path = as_blender(tmp_path / f"part.{ending}", damaged)
    with pytest.raises(RepairableSurfaceError, match=r"is open: \d+ edges .* the first at \("):
        read_body(path)
    surface = read_body(path, repair=True)
    assert_sound(surface)
    assert surface.volume == pytest.approx(volume(whole), rel=0.01)
    rim = trimesh.Trimesh(*damaged, process=False)
    sides = rim.edges_sorted[trimesh.grouping.group_rows(rim.edges_sorted, require_count=1)]
    longest = np.linalg.norm(damaged[0][sides[:, 0]] - damaged[0][sides[:, 1]], axis=1).max()
    (note,) = surface.notes
    assert note.startswith(f"Repair: a part of the surface had 2 holes (longest edge {longest:.3g} m")
    assert f"to {surface.volume:.4g} m^3" in note


@pytest.mark.usefixtures("own_process")
def test_a_box_without_a_lid_is_closed_flat_and_filled(tmp_path: Path) -> None:
    points, triangles = box((2, 1, 1))
    path = saved(tmp_path, (points, triangles[points[triangles].mean(axis=1)[:, 0] < 0.999]))
    mesh = fill_surface(path, 0.3, repair=True)
    assert signed_measures(mesh.points, mesh.cells).sum() == pytest.approx(2.0, rel=1e-9)
    assert np.ptp(mesh.points, axis=0) == pytest.approx([2, 1, 1], rel=1e-9)
    assert any("1 holes" in note and "volume went from 2 to 2 m^3" in note for note in mesh.notes)


def test_much_new_area_is_said_loudly(tmp_path: Path) -> None:
    points, triangles = box((1, 1, 1))
    path = saved(tmp_path, (points, triangles[points[triangles].mean(axis=1)[:, 2] < 0.499]))
    (note,) = read_body(path, repair=True).notes
    assert note.startswith("LOOK AT THE SHAPE: ") and "0.17 of its area is new" in note


@pytest.mark.parametrize("inside_out", [False, True])
def test_boxes_that_cross_are_one_body(tmp_path: Path, inside_out: bool) -> None:
    first, second = box((2, 1, 1)), box((1, 1, 1), (1, 0.3, 0.2))
    path = saved(tmp_path, joined(first, (second[0], second[1][:, ::-1]) if inside_out else second))
    with pytest.raises(RepairableSurfaceError, match=r"(cut each other|pass through others), .*near \("):
        read_body(path)
    surface = read_body(path, repair=True)
    assert_sound(surface)
    assert len(surface.bodies) == 1
    assert surface.volume == pytest.approx(2 + 1 - 0.5 * 0.7 * 0.8, rel=1e-9)
    assert "2 closed parts of the surface that cross or touch were made one" in surface.notes[0]
    assert "their volumes, 3 m^3 together, became 2.72 m^3" in surface.notes[0]
    mesh = fill_surface(path, 0.4, repair=True)
    assert signed_measures(mesh.points, mesh.cells).sum() == pytest.approx(2.72, rel=0.01)


@pytest.mark.parametrize(
    ("size", "at", "united"),
    [
        ((1, 1, 1), (1, 0, 0), 2.0),  # a face in common
        ((1, 0.6, 0.6), (0.5, 0, 0.2), 1.36 - 0.5 * 0.6 * 0.6),  # tops in one plane, nodes in common
        ((1, 1, 0.5), (1, 0, 0.25), 1.5),  # half a face in common
    ],
)
def test_boxes_with_points_in_common(
    tmp_path: Path, size: tuple[float, ...], at: tuple[float, ...], united: float
) -> None:
    both = joined(box((1, 1, 1)), box(size, at))  # type: ignore[arg-type]
    path = as_blender(tmp_path / "part.obj", both)
    with pytest.raises(RepairableSurfaceError, match=r"more than two triangles, the first at \("):
        read_body(path)
    surface = read_body(path, repair=True)
    assert_sound(surface)
    assert len(surface.bodies) == 1 and surface.volume == pytest.approx(united, rel=1e-9)
    with pytest.raises(MeshError, match="more than two triangles"):  # it does not say which triangles are a part
        read_body(as_blender(tmp_path / "part.stl", both), repair=True)


def test_two_bars_through_each_other_were_two_bodies(tmp_path: Path) -> None:
    """No corner of one lies within the other: read as 6 m^3 before."""
    path = saved(tmp_path, joined(box((3, 1, 1), level=0), box((1, 3, 1), level=0)))
    with pytest.raises(RepairableSurfaceError, match="has parts that cut each other"):
        read_body(path)
    surface = read_body(path, repair=True)
    assert_sound(surface)
    assert surface.volume == pytest.approx(5.0, rel=1e-9)


def test_rods_through_a_ball_with_a_hole(tmp_path: Path) -> None:
    """Holes first, then the union, against the volume by trimesh's winding of random points."""
    ball, rods = sphere(), (box((3, 0.3, 0.3)), box((0.3, 3, 0.3), (0.05, 0, 0.5)))
    path = saved(tmp_path, joined(without(ball, (0, 0, -1)), *rods))
    surface = read_body(path, repair=True)
    assert_sound(surface)
    assert len(surface.bodies) == 1
    probes = np.random.default_rng(0).uniform(-1.5, 1.5, (200_000, 3))
    inside = np.linalg.norm(probes, axis=1) < 0.995
    for size, at in (((3, 0.3, 0.3), (0, 0, 0)), ((0.3, 3, 0.3), (0.05, 0, 0.5))):
        inside |= (abs(probes - np.array(at)) < np.array(size) / 2).all(axis=1)
    assert surface.volume == pytest.approx(27 * inside.mean(), rel=0.02)


def test_a_dent_pushed_through_the_other_side(tmp_path: Path) -> None:
    """One part that cuts itself: what sticks out is cut off, the bounding box is the ball's again."""
    path = saved(tmp_path, pushed_through(2.08))
    with pytest.raises(RepairableSurfaceError, match=r"cuts itself: \d+ of its 5120 triangles .* near \("):
        read_body(path)
    surface = read_body(path, repair=True)
    assert_sound(surface)
    assert "triangles that pass through others; its volume went from" in surface.notes[0]
    assert np.ptp(surface.points, axis=0) == pytest.approx([2, 2, 2], abs=0.15)


def test_each_of_two_bodies_keeps_its_place_and_scraps_go(tmp_path: Path) -> None:
    """MeshFix by itself keeps the largest part only."""
    scrap = (np.array([[3.0, 0, 0], [3.01, 0, 0], [3, 0.01, 0]]), np.array([[0, 1, 2]]))
    one, two = without(sphere(), (0, 0, 1)), without(box((1, 1, 1), (5, 0, 0)), (5, 0, 0.5))
    surface = read_body(saved(tmp_path, joined(one, two, scrap)), repair=True)
    assert_sound(surface)
    assert len(surface.bodies) == 2
    assert surface.volume == pytest.approx(volume(sphere()) + 1, rel=0.02)
    assert surface.points[:, 0].max() == pytest.approx(5.5)
    assert any("1 open parts of the surface were left out" in note and "(3.003, 0.00" in note for note in surface.notes)


def test_a_cavity_stays(tmp_path: Path) -> None:
    inner = sphere()
    shells = joined(without(sphere(), (0, 0, 1)), (0.5 * inner[0], inner[1][:, ::-1]))
    surface = read_body(saved(tmp_path, shells), repair=True)
    assert surface.volume == pytest.approx(volume(sphere()) * (1 - 0.125), rel=0.02)


def test_a_sound_surface_is_as_it_was(tmp_path: Path) -> None:
    path = saved(tmp_path, box((1, 2, 3)))
    plain, surface = read_body(path), read_body(path, repair=True)
    assert plain.notes == () and "its shape is as it was" in surface.notes[0]
    assert surface.volume == pytest.approx(6, rel=1e-12) and len(surface.triangles) == len(plain.triangles)


def moebius() -> Surface:
    turn = np.linspace(0, 2 * np.pi, 40, endpoint=False)
    across = np.stack([np.cos(turn / 2) * np.cos(turn), np.cos(turn / 2) * np.sin(turn), np.sin(turn / 2)], axis=1)
    middle = np.stack([np.cos(turn), np.sin(turn), 0 * turn], axis=1)
    points = np.concatenate([middle - 0.2 * across, middle + 0.2 * across])
    quads = [(i, i + 1, i + 41, i + 40) for i in range(39)] + [(39, 40, 0, 79)]
    return points, np.array([t for a, b, c, d in quads for t in ((a, b, c), (a, c, d))])


def fin() -> Surface:
    points, triangles = box((1, 1, 1), level=0)
    return np.concatenate([points, [[0, 0, 2.0]]]), np.concatenate([triangles, [[*triangles[0, :2], len(points)]]])


def half_a_ball() -> Surface:
    points, triangles = sphere()
    return points, triangles[points[triangles].mean(axis=1)[:, 2] < 0]


def hollow_cross() -> Surface:
    return joined(box((2, 2, 2)), box((0.5, 0.5, 0.5)), box((3, 0.4, 0.4), (0.1, 0.05, 0.02)))


@pytest.mark.usefixtures("own_process")
@pytest.mark.parametrize(
    ("made", "message"),
    [
        (moebius, "one side only, like a Moebius strip"),
        (fin, r"1 edges belong to more than two triangles, the first at \("),
        (half_a_ball, r"(?s)change the shape grossly.*1 holes .*near \(.*0.3\d of its area is new.*\[mesh\] shell"),
        (hollow_cross, r"another part within them, near \(0, 0, 0\) m; whether it is a cavity"),
    ],
)
def test_gross_changes_are_refused(tmp_path: Path, made: object, message: str) -> None:
    with pytest.raises(MeshError, match=message):
        read_body(saved(tmp_path, made()), repair=True)  # type: ignore[operator]


def test_a_spike_far_out_is_not_cut_off_in_silence(tmp_path: Path) -> None:
    """Through the other side by half of the ball: MeshFix cuts it off, and the box with it."""
    with pytest.raises(MeshError, match="change the shape grossly"):
        read_body(saved(tmp_path, pushed_through(3.0)), repair=True)


def test_what_cuts_itself_after_the_repair_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A repair that leaves its surface as it was."""
    monkeypatch.setattr(repairing, "repair_triangles", lambda points, triangles, source: (points, triangles, ()))
    for damaged, wrong in ((pushed_through(2.08), "cuts itself"), (without(sphere(), (0, 0, 1)), "is open")):
        with pytest.raises(MeshError, match=rf"part.ply', repaired, {wrong}"):
            read_body(saved(tmp_path, damaged), repair=True)


def table(path: Path, **keys: object) -> MeshSettings:
    return MeshSettings.model_validate({"surface": path, "h": 0.5} | keys)


def test_the_study_names_the_key(tmp_path: Path) -> None:
    path = saved(tmp_path, without(box((2, 1, 1)), (1, 0, 0)))
    for damaged in (path, as_blender(tmp_path / "cross.stl", joined(box((2, 1, 1)), box((1, 1, 1), (1, 0.3, 0.2))))):
        with pytest.raises(InputError, match=r"\(.*\[mesh\] repair = true"):
            open_surface(table(damaged))
        assert open_surface(table(damaged, repair=True)) is not None
    with pytest.raises(InputError, match=r"mesh.repair = 1: whether holes are filled"):
        open_surface(table(path, repair=1))
    assert len(build_mesh(table(path, repair=True, scale=2.0)).cells) > 100


def test_without_the_wheels(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("pymeshfix", "manifold3d"):
        monkeypatch.setitem(sys.modules, name, None)
    assert read_body(saved(tmp_path, sphere())).notes == ()
    with pytest.raises(MeshError, match=r"needs pymeshfix, .*pip install fracsim\[repair\]"):
        repair_triangles(*without(sphere(), (0, 0, 1)), "S")
    with pytest.raises(MeshError, match="needs manifold3d"):
        repair_triangles(*joined(box((2, 1, 1)), box((1, 1, 1), (1, 0.3, 0.2))), "S")


@pytest.mark.parametrize(
    ("failure", "message"),
    [
        (TimeoutError(), r"had not ended within 7 s \(1280 triangles\)|had not ended"),
        (repairing.ProcessDiedError("signal 11"), "signal 11"),
    ],
)
def test_a_repair_that_hangs_or_crashes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, failure: Exception, message: str
) -> None:
    def fails(seconds: float, *arguments: object) -> None:
        assert seconds == 7
        raise failure

    monkeypatch.setattr(repairing, "call_with_time_limit", fails)
    with pytest.raises(MeshError, match=message):
        read_body(saved(tmp_path, sphere()), repair=True, time_limit=7)


@pytest.mark.parametrize("seed", range(8))
def test_crossings_against_ipctk(seed: int) -> None:
    """Separate triangles, from few to many that cross; each pair asked of ipctk alone."""
    random = np.random.default_rng(seed)
    corners = random.uniform(0, 1, (30, 1, 3)) + random.uniform(-1, 1, (30, 3, 3)) * random.uniform(0.05, 0.5)
    points, triangles = corners.reshape(-1, 3), np.arange(90).reshape(-1, 3)
    pairs = [
        (i, j) for i in range(30) for j in range(i) if passes_through(corners[[j, i]].reshape(-1, 3), triangles[:2])
    ]
    found = crossing_triangles(points, triangles)
    assert sorted(map(tuple, found.tolist())) == sorted((j, i) for i, j in pairs)
    assert len(pairs) or seed


def test_neighbours_and_parts_that_touch_do_not_cross() -> None:
    for surface in (sphere(4), box((1, 1, 1)), joined(box((1, 1, 1)), box((1, 1, 1), (1, 0.3, 0.2)))):
        assert len(crossing_triangles(*surface)) == 0


def test_a_search_that_is_not_ended_is_no_sound_surface(monkeypatch: pytest.MonkeyPatch) -> None:
    """Before, what had been found by then was taken for all of it."""
    points = np.random.default_rng(0).random((600, 3))
    limits = replace(self_intersection.CROSSING, max_pairs=1000, max_pairs_per_triangle=1)
    monkeypatch.setattr(self_intersection, "CROSSING", limits)
    with pytest.raises(MeshError, match="200 triangles was not searched to the end"):
        crossing_triangles(points, np.arange(600).reshape(-1, 3))


def test_a_face_folded_over_its_edge_is_found() -> None:
    corners = np.array([[x, y, z] for z in (0, 1) for x, y in ((0, 0), (1, 0), (1, 1), (0, 1))], float)
    points = np.concatenate([corners, [[0.5, 1.3, 1.0]]])  # the middle of the upper face, beyond its edge 6-7
    sides = [[0, 2, 1], [0, 3, 2], [0, 1, 5], [0, 5, 4], [1, 2, 6], [1, 6, 5], [2, 3, 7], [2, 7, 6]]
    sides += [[3, 0, 4], [3, 4, 7]]
    lid = [[4, 5, 8], [5, 6, 8], [6, 7, 8], [7, 4, 8]]
    assert 13 in crossing_triangles(points, np.array(sides + lid), closed=True)


def test_neighbours_are_left_out_of_the_exact_test(monkeypatch: pytest.MonkeyPatch) -> None:
    """A ball of a million triangles is searched in the time in which it is read."""
    tested = 0
    exact = self_intersection._crossed

    def counted(points: Points, triangles: Indices, pairs: Indices, *rest: float) -> object:
        nonlocal tested
        tested += len(pairs)
        return exact(points, triangles, pairs, *rest)

    monkeypatch.setattr(self_intersection, "_crossed", counted)
    points, triangles = sphere(5)
    assert len(crossing_triangles(points, triangles)) == 0
    assert tested < 0.5 * len(triangles)
    assert len(crossing_triangles(*pushed_through(2.2))) > 0
