"""Closed surfaces filled with tetrahedra: volumes, sharp edges, bodies and cavities; and surfaces that are no body."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from functools import partial
from math import pi
from pathlib import Path

import meshio
import numpy as np
import pytest

from fracsim.meshes import BUILDERS, MeshError
from fracsim.meshes.data import Indices, Points
from fracsim.meshes.quality import mesh_quality
from fracsim.meshes.read import read_contents
from fracsim.meshes.surfaces.closed import closed_surface, read_surface
from fracsim.meshes.surfaces.fill import expected_cells, fill_closed, fill_surface
from fracsim.meshes.time_limit import call_with_time_limit
from fracsim.meshes.topology import boundary_facets, signed_measures

Shell = tuple[Points, Indices]
Made = Callable[[], Shell]  # called in the test, not while tests are collected


@pytest.fixture
def own_process() -> None:
    """gmsh works in a process of its own, as it does for users."""


@pytest.fixture(autouse=True)
def _filled_here(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """gmsh works in this process, but where a test asks for `own_process`: starting one takes longer than the cells."""
    if "own_process" not in request.fixturenames:
        monkeypatch.setattr(
            "fracsim.meshes.surfaces.fill.call_with_time_limit", lambda seconds, work, *given: work(*given)
        )


def skin(name: str, **parameters: object) -> Shell:
    """The boundary of a builder's mesh, without its inner nodes."""
    mesh = BUILDERS[name](**parameters).build()
    used, triangles = np.unique(boundary_facets(mesh.cells), return_inverse=True)
    return mesh.points[used], triangles.reshape(-1, 3)


def cube(size: float = 1.0, at: float = 0.0) -> Shell:
    """Twelve triangles, normals outwards, around the point (at, at, at)."""
    return skin("box", size=(size,) * 3, origin=(at - size / 2,) * 3, h=size)


def torus(ring: float = 0.5, tube: float = 0.2, around: int = 48, across: int = 20) -> Shell:
    """A torus as a polyhedron: its volume is below 2 pi^2 ring tube^2."""
    i, j = np.meshgrid(np.arange(around), np.arange(across), indexing="ij")
    u, v = 2 * pi * i / around, 2 * pi * j / across
    reach = ring + tube * np.cos(v)
    points = np.stack([reach * np.cos(u), reach * np.sin(u), tube * np.sin(v)], axis=-1).reshape(-1, 3)
    a, b = i * across + j, (i + 1) % around * across + j
    c, d = (i + 1) % around * across + (j + 1) % across, i * across + (j + 1) % across
    return points, np.concatenate([np.stack([a, b, c], -1).reshape(-1, 3), np.stack([a, c, d], -1).reshape(-1, 3)])


def save(path: Path, *shells: Shell) -> Path:
    starts = np.cumsum([0] + [len(points) for points, _ in shells])
    triangles = np.concatenate([t + start for (_, t), start in zip(shells, starts, strict=False)])
    meshio.Mesh(np.concatenate([p for p, _ in shells]), [("triangle", triangles)]).write(path)
    return path


def volume(shell: Shell) -> float:
    return float(np.linalg.det(shell[0][shell[1]]).sum() / 6)


@pytest.mark.parametrize("ending", ["stl", "ply", "obj", "off", "vtk"])
def test_cube_from_every_format(tmp_path: Path, ending: str, capfd: pytest.CaptureFixture[str]) -> None:
    path = save(tmp_path / f"cube.{ending}", cube())
    capfd.readouterr()
    mesh = fill_surface(path, h=0.25)
    assert signed_measures(mesh.points, mesh.cells).sum() == pytest.approx(1.0, rel=1e-6)
    assert mesh.notes == ()
    assert mesh_quality(mesh)["edge_median"] == pytest.approx(0.25, rel=0.1)
    assert len(mesh.facet_groups["surface"]) == len(boundary_facets(mesh.cells))
    assert capfd.readouterr() == ("", "")


def test_quads_are_cut(tmp_path: Path) -> None:
    corners = "".join(f"v {x} {y} {z}\n" for z in (0, 1) for y in (0, 1) for x in (0, 1))
    quads = ["1 3 4 2", "5 6 8 7", "1 2 6 5", "3 7 8 4", "1 5 7 3", "2 4 8 6"]
    (tmp_path / "cube.obj").write_text(corners + "".join(f"f {quad}\n" for quad in quads))
    mesh = fill_surface(tmp_path / "cube.obj", h=0.4)
    assert signed_measures(mesh.points, mesh.cells).sum() == pytest.approx(1.0, rel=1e-6)


QUADS = ["1 3 4 2", "5 6 8 7", "1 2 6 5", "3 7 8 4", "1 5 7 3", "2 4 8 6"]  # of a box, outwards


def obj_of_a_box(style: str) -> str:
    """A box of 0.06 x 0.04 x 0.02 as different programs write it."""
    corners = [(0.06 * x, 0.04 * y, 0.02 * z) for z in (0, 1) for y in (0, 1) for x in (0, 1)]
    points = [f"v {x} {y} {z}" for x, y, z in corners]
    faces = [[int(word) for word in quad.split()] for quad in QUADS]
    if style == "from the end":
        return "\n".join([*points, *(f"f {' '.join(str(k - 9) for k in face)}" for face in faces)])
    if style == "face by face":  # each with points of its own, and others after it
        return "\n".join("\n".join([*(points[k - 1] for k in face), "g side", "f -4 -3 -2 -1"]) for face in faces)
    if style == "normals and textures":
        lines = ["# Blender", "mtllib it.mtl", "o Box", *points, "vn 0 0 1", "vt 0 0", "vt 1 1", "s off", "usemtl none"]
        return "\n".join([*lines, *("f " + " ".join(f"{k - 9}/-1/-1" for k in face) for face in faces)])
    if style == "colours":
        return "\n".join([*(f"{point} 0.8 0.8 0.8" for point in points), *("f " + quad for quad in QUADS)])
    return "\n".join([*points, *(f"f {a} {b} \\\n  {c} {d} # side" for a, b, c, d in faces)])


@pytest.mark.parametrize("style", ["from the end", "face by face", "normals and textures", "colours", "lines go on"])
def test_obj_of_other_programs(tmp_path: Path, style: str) -> None:
    """Volume and area of the box; the corners of its faces as VTK's reader has them."""
    from vtkmodules.util.numpy_support import vtk_to_numpy
    from vtkmodules.vtkIOGeometry import vtkOBJReader

    path = tmp_path / "box.obj"
    path.write_text(obj_of_a_box(style))
    surface = read_surface(path)
    assert surface.volume == pytest.approx(4.8e-5, rel=1e-12) and surface.area == pytest.approx(8.8e-3, rel=1e-12)
    assert surface.notes == () and len(surface.triangles) == 12
    if style in ("colours", "lines go on"):  # VTK knows neither
        return
    reader = vtkOBJReader()
    reader.SetFileName(str(path))
    reader.Update()
    theirs, contents = reader.GetOutput(), read_contents(path)
    points = vtk_to_numpy(theirs.GetPoints().GetData())
    for number, face in enumerate(face for block in contents.blocks for face in block.nodes):
        cell = theirs.GetCell(number)
        corners = points[[cell.GetPointId(i) for i in range(cell.GetNumberOfPoints())]]
        np.testing.assert_allclose(contents.points[face], corners, atol=1e-8)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("v 0 0 0\nv 1 0 0\nf -1 -2 -3", r"box\.obj', line 3: `f -1 -2 -3` does not name points that are there before"),
        ("v 0 0 0\nv 1 0 0\n\nf 1 0 2", r"box\.obj', line 4: `f 1 0 2` does not name points"),
        ("v 0 0 0\nv 1 0\n", r"box\.obj', line 2: `v 1 0` does not name three coordinates: v 0 0\.5 1"),
        ("v 0 0 0\nf 1 2 3\nv 1 0 0\nv 0 1 0\nf 2 3 4", r"box\.obj', line 5: there is no point 4, but 3 in all"),
    ],
)
def test_lines_of_an_obj_that_are_wrong(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "box.obj").write_text(text)
    with pytest.raises(MeshError, match=message):
        read_surface(tmp_path / "box.obj")


@pytest.mark.parametrize(
    ("name", "made", "h"),
    [
        ("cylinder", partial(skin, "cylinder", radius=0.3, length=1.0, h=0.1), 0.1),
        ("loaf", partial(skin, "loaf", h=0.02), 0.02),
        ("notched-bar", partial(skin, "notched-bar", h=0.004, h_notch=0.002, span=0.0), 0.002),
        ("torus", torus, 0.1),
    ],
)
def test_volume_is_that_of_the_surface(tmp_path: Path, name: str, made: Made, h: float) -> None:
    """Meshed anew, a round surface of radius R loses a share of about h^2 / (4 R^2): 6 % of the torus's tube."""
    shell = made()
    mesh = fill_surface(save(tmp_path / f"{name}.stl", shell), h)
    assert signed_measures(mesh.points, mesh.cells).sum() == pytest.approx(volume(shell), rel=0.06)
    assert mesh_quality(mesh)["edge_median"] == pytest.approx(h, rel=0.15)


@pytest.mark.usefixtures("own_process")
def test_sharp_edges_are_kept(tmp_path: Path) -> None:
    """A notched bar is flat but for its root: its volume is kept to a share far below (h / height)^2."""
    shell = skin("notched-bar", notch="slit", notch_width=0.001, h=0.004, span=0.0)
    mesh = fill_surface(save(tmp_path / "bar.stl", shell), h=0.002)
    assert signed_measures(mesh.points, mesh.cells).sum() == pytest.approx(volume(shell), rel=1e-6)


def test_two_bodies(tmp_path: Path) -> None:
    mesh = fill_surface(save(tmp_path / "two.stl", cube(), cube(0.5, at=2.0)), h=0.25)
    assert signed_measures(mesh.points, mesh.cells).sum() == pytest.approx(1.125, rel=1e-6)
    assert mesh.notes == ("The surface encloses 2 separate bodies; each needs its own supports.",)


@pytest.mark.parametrize("inwards", [True, False])
def test_cavity(tmp_path: Path, inwards: bool) -> None:
    points, triangles = cube(0.5)
    mesh = fill_surface(
        save(tmp_path / "hollow.stl", cube(), (points, triangles[:, ::-1] if inwards else triangles)), 0.2
    )
    assert signed_measures(mesh.points, mesh.cells).sum() == pytest.approx(1 - 0.125, rel=1e-6)
    assert "1 closed parts of the surface lie inside another and are taken as cavities." in mesh.notes


def test_body_inside_a_cavity(tmp_path: Path) -> None:
    mesh = fill_surface(save(tmp_path / "nut.stl", cube(), cube(0.7), cube(0.3)), h=0.15)
    assert signed_measures(mesh.points, mesh.cells).sum() == pytest.approx(1 - 0.343 + 0.027, rel=1e-6)


def test_inside_out_and_mixed_triangles_are_turned() -> None:
    points, triangles = cube()
    turned = closed_surface(points, triangles[:, ::-1], "S")
    assert turned.volume == pytest.approx(1.0) and turned.notes == (
        "1 parts of the surface were inside out and have been turned.",
    )
    triangles = triangles.copy()
    triangles[[2, 7]] = triangles[[2, 7], ::-1]
    mixed = closed_surface(points, triangles, "S")
    assert mixed.volume == pytest.approx(1.0)
    assert mixed.notes == ("2 of 12 surface triangles faced the other way than the rest; turned.",)


def test_points_that_nearly_coincide_are_joined() -> None:
    points, triangles = cube()
    apart = points[triangles].reshape(-1, 3)
    apart = apart + 1e-8 * np.random.default_rng(0).standard_normal(apart.shape)
    surface = closed_surface(apart, np.arange(36).reshape(-1, 3), "S")
    assert len(surface.points) == 8 and surface.volume == pytest.approx(1.0)


def test_open_surface_tells_where(tmp_path: Path) -> None:
    points, triangles = cube()
    with pytest.raises(MeshError, match=r"open.stl' is open: 3 edges belong to one triangle only, the first at \("):
        fill_surface(save(tmp_path / "open.stl", (points, triangles[1:])), 0.2)


def test_surface_that_branches_is_refused() -> None:
    points, triangles = cube()
    points = np.concatenate([points, [[3.0, 3, 3]]])
    a, b = triangles[0, :2]
    fin = np.array([[a, b, 8], [b, a, 8]])
    with pytest.raises(MeshError, match="S is not the surface of a body: 1 edges belong to more than two triangles"):
        closed_surface(points, np.concatenate([triangles, fin]), "S")


def test_klein_bottle_is_refused() -> None:
    """A square whose sides are joined, one pair of them reversed: closed, but with one side only."""
    n = 6
    number = np.arange(n * n).reshape(n, n)
    corner = lambda i, j: number[i % n, (j if i < n else -j) % n]  # noqa: E731
    squares = [
        (corner(i, j), corner(i + 1, j), corner(i + 1, j + 1), corner(i, j + 1)) for i in range(n) for j in range(n)
    ]
    triangles = np.array([t for a, b, c, d in squares for t in ((a, b, c), (a, c, d))])
    points = np.random.default_rng(1).random((n * n, 3))
    with pytest.raises(MeshError, match="S has one side only"):
        closed_surface(points, triangles, "S")


def test_points_that_are_no_numbers_are_named() -> None:
    points, triangles = cube()
    points[3, 0] = np.nan
    with pytest.raises(MeshError, match=r"S has 1 points that are not finite numbers of .*, the first is point 3"):
        closed_surface(points, triangles, "S")


def test_flat_body_is_refused() -> None:
    points = np.array([[0.0, 0, 0], [1, 0, 0], [2, 0, 0], [0, 1, 1]])
    with pytest.raises(MeshError, match="S is open: 4 edges"):
        closed_surface(points, np.array([[0, 1, 2], [0, 1, 3], [1, 2, 3], [0, 2, 3]]), "S")


def test_coarse_size_keeps_the_surface_and_says_so(tmp_path: Path) -> None:
    """At h of half the tube a torus would lose its shape."""
    shell = torus(around=24, across=10)
    mesh = fill_surface(save(tmp_path / "torus.stl", shell), h=0.35)
    assert signed_measures(mesh.points, mesh.cells).sum() == pytest.approx(volume(shell), rel=1e-5)
    assert "keeps its own 480 triangles" in mesh.notes[0]


@pytest.mark.usefixtures("own_process")
def test_surface_that_cuts_itself_is_refused(tmp_path: Path) -> None:
    """One corner of a cube is pulled out through the opposite face."""
    points, triangles = cube()
    corner = int(np.argmax(points.sum(axis=1)))
    points = points.copy()
    points[corner] = [-0.6, 0.2, 0.1]
    with pytest.raises(MeshError, match=r"Surface file '.*fold.stl'"):
        fill_surface(save(tmp_path / "fold.stl", (points, triangles)), 0.3)


def test_bodies_that_cut_each_other_are_refused(tmp_path: Path) -> None:
    with pytest.raises(MeshError, match=r"cross.stl' has parts that cut each other, near"):
        fill_surface(save(tmp_path / "cross.stl", cube(), cube(at=0.4)), h=0.3)


def test_bodies_that_overlap_along_an_axis_are_refused() -> None:
    """All corners of one lie on the other, and edges cross in common planes alone; bodies that touch are two."""
    points, triangles = cube()

    def pair(shift: list[float]) -> tuple[np.ndarray, np.ndarray, str]:
        return np.concatenate([points, points + shift]), np.concatenate([triangles, triangles + len(points)]), "S"

    with pytest.raises(MeshError, match="S has parts that cut each other, near"):
        closed_surface(*pair([0.5, 0.0, 0.0]))
    for shift in ([1.0, 0.5, 0.25], [1.5, 0.0, 0.0]):
        assert len(closed_surface(*pair(shift)).bodies) == 2


@pytest.mark.parametrize("unit", [1e-3, 1e3])
@pytest.mark.parametrize(("name", "shell", "h"), [("cube", cube(), 0.3), ("torus", torus(around=24, across=10), 0.2)])
def test_the_unit_of_length_does_not_matter(tmp_path: Path, name: str, shell: Shell, h: float, unit: float) -> None:
    """A body and its h in another unit: the same cells, the same nodes to the last digits."""
    expected = fill_surface(save(tmp_path / f"{name}.vtk", shell), h)
    mesh = fill_surface(save(tmp_path / f"{name}-large.vtk", (shell[0] * unit, shell[1])), h * unit)
    assert np.array_equal(mesh.cells, expected.cells)
    np.testing.assert_allclose(mesh.points, expected.points * unit, rtol=0, atol=1e-11 * unit)


def test_size_above_a_metre(tmp_path: Path) -> None:
    mesh = fill_surface(save(tmp_path / "cube.stl", cube(20.0)), 4.0)
    assert mesh_quality(mesh)["edge_median"] == pytest.approx(4.0, rel=0.1)


def test_scale_of_the_file(tmp_path: Path) -> None:
    millimetres = save(tmp_path / "cube.vtk", cube(20.0))
    mesh = fill_surface(millimetres, 0.005, scale=1e-3)
    assert np.ptp(mesh.points, axis=0) == pytest.approx([0.02] * 3, rel=1e-12)
    with pytest.raises(MeshError, match=r"h = 0.005 m would make about .* measures 20 x 20 x 20 m: .* scale = 1e-3"):
        fill_surface(millimetres, 0.005)
    with pytest.raises(MeshError, match=r"h = 0.5 m is larger than the whole body. The body measures 0.02 x 0.02"):
        fill_surface(millimetres, 0.5, scale=1e-3)


@pytest.mark.usefixtures("own_process")
def test_gmsh_is_stopped_where_it_takes_too_long(tmp_path: Path) -> None:
    """A million cells and more in a second: gmsh is at work within its library when its time is up."""
    with pytest.raises(MeshError, match=r"gmsh had not filled it within 1 s \(about 1,.* cells of h = 0.02 m in"):
        fill_surface(save(tmp_path / "cube.stl", cube()), 0.02, time_limit=1)


@pytest.mark.parametrize(
    ("made", "h"),
    [(cube, 0.15), (torus, 0.07), (partial(skin, "vase", h=0.012, wall=0.006), 0.012)],
    ids=("cube", "torus", "vase"),
)
def test_cells_are_expected_within_a_factor(tmp_path: Path, made: Made, h: float) -> None:
    """Solid bodies and a shell whose wall has room for one cell."""
    surface = read_surface(save(tmp_path / "body.stl", made()))
    assert expected_cells(surface, h) == pytest.approx(len(fill_closed(surface, h, "S").cells), rel=0.5)


@pytest.mark.usefixtures("python_started")
def test_work_in_a_process_of_its_own() -> None:
    """Results and exceptions come back; what takes too long or dies is told."""
    assert call_with_time_limit(20, divmod, 7, 2) == (3, 1)
    with pytest.raises(ZeroDivisionError):
        call_with_time_limit(20, divmod, 7, 0)
    with pytest.raises(TimeoutError):
        call_with_time_limit(0.2, time.sleep, 60)
    with pytest.raises(MeshError, match="signal 6"):
        call_with_time_limit(20, os.abort)


def test_size_must_be_sensible(tmp_path: Path) -> None:
    path = save(tmp_path / "cube.stl", cube())
    with pytest.raises(MeshError, match="h = 0 must be a positive number"):
        fill_surface(path, 0)
    with pytest.raises(MeshError, match=r"h = 0.0001 m would make about"):
        fill_surface(path, 0.0001)


def test_volume_mesh_is_no_surface(tmp_path: Path) -> None:
    mesh = BUILDERS["box"](h=0.25).build()
    meshio.Mesh(mesh.points, [("tetra", mesh.cells)]).write(tmp_path / "solid.vtu")
    with pytest.raises(MeshError, match="holds no triangles in space"):
        fill_surface(tmp_path / "solid.vtu", 0.1)


@pytest.mark.usefixtures("python_started")
def test_arrays_of_another_process_are_not_copied() -> None:
    """They can be written to, and Python allocates no memory of their size."""
    import tracemalloc

    tracemalloc.start()
    try:
        values, none = call_with_time_limit(60, np.meshgrid, np.arange(2000.0), np.arange(0))
        ones = call_with_time_limit(60, np.ones, (1000, 2000))
        assert tracemalloc.get_traced_memory()[1] < 0.3 * ones.nbytes
    finally:
        tracemalloc.stop()
    assert values.shape == none.shape == (0, 2000) and ones.shape == (1000, 2000) and (ones == 1).all()
    ones[500, 3] = 2
    assert ones.sum() == 1 + ones.size
