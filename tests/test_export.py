"""Exported surfaces, opened again by readers that share no code with what wrote them: closed, with their volumes."""

from __future__ import annotations

import csv
import json
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
import pyvista

from fracsim.errors import InputError
from fracsim.output.surface.body_surface import BodySurface
from fracsim.output.surface.vtk_files import SurfaceFiles, rotation_quaternions
from fracsim.report.export import export_surfaces
from fracsim.report.export_surfaces import corner_normals
from support.exported import PIECES, broken_bar, dropped_bar
from support.solids import lattice

Values = npt.NDArray[np.float64]


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return broken_bar(tmp_path_factory.mktemp("bar"))


def volume(mesh: Any) -> float:
    """Of a closed surface; refuses one that is open."""
    mesh = mesh.extract_surface().triangulate()
    assert mesh.n_open_edges == 0 and mesh.is_manifold
    x = np.asarray(mesh.points, float)
    x = (x - x.mean(axis=0))[mesh.regular_faces]
    return float(np.linalg.det(x).sum() / 6)


def of_obj(path: Path) -> list[Any]:
    """By VTK's reader, which gives each normal a point of its own; the floor lies lower than all pieces."""
    bodies = pyvista.read(path).clean(tolerance=0.0).split_bodies()
    return [each.extract_surface() for each in bodies if each.bounds[4] > -1e-3]


def of_ply(path: Path) -> list[Any]:
    return list(pyvista.read(path).split_bodies())


def of_glb(path: Path) -> list[Any]:
    """By VTK's reader of glTF, whose colours tear points apart where they differ."""
    pytest.importorskip("trimesh")
    reader = pyvista.get_reader(path)
    blocks = reader.read()
    found: list[Any] = []

    def walk(block: Any) -> None:
        for each in block:
            walk(each) if isinstance(each, pyvista.MultiBlock) else found.append(each)

    walk(blocks)
    joined = pyvista.merge([each for each in found if each is not None and each.n_cells])
    return list(joined.extract_surface().clean(tolerance=1e-7).split_bodies())


def of_usd(path: Path) -> list[Any]:
    """Fragments at the last time, by the arrays that USD hands over; skin and inside have their own points."""
    from pxr import Usd, UsdGeom

    stage = Usd.Stage.Open(str(path))  # which goes with its name
    end, found = stage.GetEndTimeCode(), []
    placed = UsdGeom.XformCache(end)
    for prim in stage.Traverse():
        shown = prim.IsA(UsdGeom.Mesh) and UsdGeom.Imageable(prim).ComputeVisibility(end) == "inherited"
        if not shown or not str(prim.GetPath()).startswith(("/run/body", "/run/piece")):
            continue
        mesh, turn = UsdGeom.Mesh(prim), np.array(placed.GetLocalToWorldTransform(prim))
        points = np.array(mesh.GetPointsAttr().Get(end), float).reshape(-1, 3)
        faces = np.array(mesh.GetFaceVertexIndicesAttr().Get(end)).reshape(-1, 3)
        found.append(pyvista.PolyData.from_regular_faces(points @ turn[:3, :3] + turn[3, :3], faces))
    if len(found) > 2:
        return found
    return list(pyvista.merge(found).extract_surface().clean(tolerance=1e-7).split_bodies())


READERS: dict[str, Callable[[Path], list[Any]]] = {"ply": of_ply, "obj": of_obj, "glb": of_glb, "usd": of_usd}


@pytest.mark.parametrize("kind", READERS)
def test_what_is_read_again_is_closed_with_its_volume(kind: str, run: Path, tmp_path: Path) -> None:
    """Three pieces, each as large as it was, to 1e-6; before it broke one of 6 m^3."""
    pytest.importorskip("pxr" if kind == "usd" else "trimesh")
    made = export_surfaces(run, kind, tmp_path)
    assert len(made) == (1 if kind == "usd" else 2) and all(path.parent == tmp_path for path in made)
    found = sorted(volume(each) for each in READERS[kind](made[-1]))
    expected = sorted(_cut_volumes(run))
    assert found == pytest.approx(expected, rel=1e-6) and sum(found) == pytest.approx(6.0, rel=1e-6)
    if kind != "usd":
        assert [volume(each) for each in READERS[kind](made[0])] == pytest.approx([6.0], rel=1e-6)


def _cut_volumes(run: Path) -> list[float]:
    rows = [line.split(",") for line in (run / "pieces.csv").read_text().splitlines()[1:]]
    return [float(row[4]) for row in rows if float(row[0]) == 1.0]


def by_trimesh(path: Path) -> list[Any]:
    """Pieces of a GLB, whose skin and inside are two meshes of trimesh; the floor is none."""
    trimesh = pytest.importorskip("trimesh")
    scene, parts = trimesh.load(path), dict[str, list[Any]]()
    for node in scene.graph.nodes_geometry:
        if node.startswith("piece_"):
            parts.setdefault(node[: len("piece_000000")], []).append(scene.geometry[scene.graph[node][1]])
    return [trimesh.util.concatenate(part) for part in parts.values()]


def volume_in_single(mesh: Any) -> float:
    """Of a surface in single precision, in which corners of slivers fall together: each side is one of an even number
    of triangles that are left."""
    is_vtk = isinstance(mesh, pyvista.PolyData)
    given, faces = (mesh.points, mesh.regular_faces) if is_vtk else (mesh.vertices, mesh.faces)
    points, number = np.unique(np.asarray(given, float), axis=0, return_inverse=True)
    corners = number.reshape(-1)[faces]
    flat = (corners == np.roll(corners, 1, axis=1)).any(axis=1)
    sides = np.sort(np.concatenate([np.roll(corners[~flat], n, axis=1)[:, :2] for n in range(3)]), axis=1)
    assert not np.any(np.unique(sides, axis=0, return_counts=True)[1] % 2) and np.count_nonzero(flat) < 0.1 * len(flat)
    x = points - points.mean(axis=0)
    return float(np.linalg.det(x[corners]).sum() / 6)


@pytest.fixture(scope="module")
def rigid(tmp_path_factory: pytest.TempPathFactory) -> Path:
    pytest.importorskip("mujoco", reason="an environment made without a network")
    return dropped_bar(tmp_path_factory.mktemp("rigid") / "out")


@pytest.mark.parametrize("kind", READERS)
def test_rigid_pieces_are_closed_with_their_volumes(kind: str, rigid: Path, tmp_path: Path) -> None:
    """As many as pieces.csv has, each as large, to 1e-6; all together 0.024 m^3. The floor is none of them."""
    pytest.importorskip("pxr" if kind == "usd" else "trimesh")
    frame = None if kind == "usd" else -1
    made, volume_of = export_surfaces(rigid, kind, tmp_path, frame=frame)[-1], volume_in_single
    if kind == "ply":
        volume_of = volume
    reader = by_trimesh if kind == "glb" else READERS[kind]
    found = sorted(volume_of(each) for each in reader(made))
    rows = last_rows(rigid)
    expected = sorted(float(row["volume"]) for row in rows)
    assert len(expected) > 2
    assert found == pytest.approx(expected, rel=1e-6) and sum(found) == pytest.approx(0.024, rel=1e-6)


def rows_of(folder: Path) -> list[dict[str, str]]:
    with (folder / "pieces.csv").open() as file:
        return [*csv.DictReader(file)]


def last_rows(folder: Path) -> list[dict[str, str]]:
    rows = rows_of(folder)
    return [row for row in rows if row["time"] == rows[-1]["time"]]


def test_glb_of_rigid_pieces_moves_as_pieces_csv_says(rigid: Path, tmp_path: Path) -> None:
    """A node for each shape of a piece; origins are centres of mass, rotations those since the first frame of a shape.

    glTF has y upwards: (x, y, z) of the run is (x, z, -y) there.
    """
    from scipy.spatial.transform import Rotation

    (path,) = export_surfaces(rigid, "glb", tmp_path)
    document, values = read_glb(path)
    names = [node["name"] for node in document["nodes"]]
    pieces = {row["piece"] for row in rows_of(rigid)}
    assert {name[6:12] for name in names if name != "floor"} == {f"{int(piece):06d}" for piece in pieces}
    (animation,) = document["animations"]
    channels = {(c["target"]["node"], c["target"]["path"]): c["sampler"] for c in animation["channels"]}
    times = sorted({float(row["time"]) for row in rows_of(rigid)})
    steps = np.median(np.diff(times)) * 24
    compared = 0
    for (number, what), sampler in channels.items():
        if what == "scale":
            continue
        keys = values(animation["samplers"][sampler]["input"])[:, 0] * steps
        output = values(animation["samplers"][sampler]["output"])
        piece = int(names[number][6:12])
        by_time = {float(row["time"]): row for row in rows_of(rigid) if int(row["piece"]) == piece}
        own = [by_time[min(by_time, key=lambda t: abs(t - key))] for key in keys]
        if what == "translation":
            centre = np.array([[float(row[f"centre_{axis}"]) for axis in "xyz"] for row in own])
            np.testing.assert_allclose(output, centre[:, [0, 2, 1]] * [1, 1, -1], atol=2e-7)
        else:
            turn = Rotation.from_quat([[float(row[f"quaternion_{part}"]) for part in "xyzw"] for row in own])
            wanted = (turn * turn[0].inv()).as_rotvec()[:, [0, 2, 1]] * [1, 1, -1]
            np.testing.assert_allclose(Rotation.from_quat(output).as_rotvec(), wanted, atol=2e-6)
        compared += len(keys)
    assert compared > 2 * len(pieces)


def test_glb_shows_each_shape_in_its_frames(rigid: Path, tmp_path: Path) -> None:
    """Shapes that are shown at a key enclose together the volume of the bar, whole and broken."""
    (path,) = export_surfaces(rigid, "glb", tmp_path)
    document, values = read_glb(path)
    (animation,) = document["animations"]
    scales = {c["target"]["node"]: animation["samplers"][c["sampler"]] for c in animation["channels"]
              if c["target"]["path"] == "scale"}  # fmt: skip
    last = max(values(sampler["input"]).max() for sampler in scales.values())
    for t in (0.0, last):
        total = 0.0
        for number, node in enumerate(document["nodes"]):
            if node["name"] == "floor":
                continue
            if number in scales:
                keys, shown = (values(scales[number][name])[:, 0] for name in ("input", "output"))
                assert scales[number]["interpolation"] == "STEP"
                if not shown[max(np.searchsorted(keys, t, side="right") - 1, 0)]:
                    continue
            for part in document["meshes"][node["mesh"]]["primitives"]:
                corners = values(part["attributes"]["POSITION"])[values(part["indices"]).reshape(-1, 3)]
                total += np.linalg.det(corners.astype(float)).sum() / 6
        assert total == pytest.approx(0.024, rel=1e-5)


def read_glb(path: Path) -> tuple[dict[str, Any], Callable[[int], Any]]:
    """Document of a file, and a function that returns the array of an accessor."""
    data = path.read_bytes()
    length = struct.unpack("<I", data[12:16])[0]
    document = json.loads(data[20 : 20 + length])

    def values(number: int) -> Any:
        accessor = document["accessors"][number]
        view, kind = document["bufferViews"][accessor["bufferView"]], {5126: "<f4", 5125: "<u4"}
        columns = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}[accessor["type"]]
        start, count = 28 + length + view["byteOffset"], accessor["count"] * columns
        return np.frombuffer(data, kind[accessor["componentType"]], count, start).reshape(-1, columns)

    return document, values


@pytest.mark.parametrize("kind", ["glb", "obj", "usd"])
def test_normals_of_the_skin_are_sharp_at_edges_and_rims(kind: str, run: Path, tmp_path: Path) -> None:
    """All faces of the bar are along axes, and so are all normals of its skin, at edges and at cracks as well."""
    made = export_surfaces(run, kind, tmp_path)[-1]
    if kind == "glb":
        document, values = read_glb(made)
        parts = [part for mesh in document["meshes"] for part in mesh["primitives"]]
        assert [document["materials"][number]["name"] for number in (0, 1)] == ["skin", "inside"]
        assert {part["material"] for part in parts} == {0, 1}
        normals = np.concatenate([values(part["attributes"]["NORMAL"]) for part in parts if part["material"] == 0])
    elif kind == "obj":
        normals = skin_normals_of_obj(made)
    else:
        pytest.importorskip("pxr")
        from pxr import Usd, UsdGeom

        stage = Usd.Stage.Open(str(made))
        skin = UsdGeom.PrimvarsAPI(stage.GetPrimAtPath("/run/body/skin"))
        normals = np.array(skin.GetPrimvar("normals").ComputeFlattened(1.0))
    assert len(normals) > 100 and np.abs(normals).max(axis=1) == pytest.approx(1.0, abs=1e-4)


@pytest.mark.parametrize(
    ("angle", "materials", "smooth"), [(20, (0, 0), True), (20, (0, 1), False), (50, (0, 0), False)]
)
def test_normals_are_smooth_within_a_material(angle: float, materials: tuple[int, int], smooth: bool) -> None:
    """Two triangles that meet at an angle: the mean of their normals at the common edge, or the normal of each."""
    a = np.deg2rad(angle)
    points = np.array([[0, 0, 0], [0, 1, 0], [1, 0.5, 0], [-np.cos(a), 0.5, -np.sin(a)]], float)
    triangles = np.array([[1, 0, 2], [0, 1, 3]])
    faces = np.array([[0.0, 0, 1], [-np.sin(a), 0, np.cos(a)]])
    found = corner_normals(points, triangles, np.array(materials))
    middle = np.array([-np.sin(a / 2), 0, np.cos(a / 2)])
    wanted = np.repeat(faces[:, None], 3, axis=1)
    if smooth:
        wanted[:, :2] = middle
    np.testing.assert_allclose(found, wanted, atol=1e-6)


def skin_normals_of_obj(path: Path) -> Any:
    lines = [line.split() for line in path.read_text().splitlines()]
    assert lines[2][0] == "mtllib" and (path.parent / lines[2][1]).is_file()
    normals = np.array([line[1:] for line in lines if line[0] == "vn"], float)
    material, used = "", []
    for word, *rest in lines:
        material = rest[0] if word == "usemtl" else material
        used += [int(corner.split("/")[2]) - 1 for corner in rest] if word == "f" and material == "skin" else []
    return normals[used]


def test_usd_has_every_frame_metres_and_velocities(run: Path, tmp_path: Path) -> None:
    pxr = pytest.importorskip("pxr.Usd")
    from pxr import UsdGeom, UsdShade

    stage = pxr.Stage.Open(str(export_surfaces(run, "usd", tmp_path)[0]))
    assert stage.GetDefaultPrim().GetPath() == "/run" and stage.GetEndTimeCode() == 1.0
    assert UsdGeom.GetStageMetersPerUnit(stage) == 1.0 and UsdGeom.GetStageUpAxis(stage) == "Z"
    assert stage.GetDefaultPrim().GetAttribute("userProperties:time").Get(1.0) == 1.0
    for name, count in (("skin", 3), ("inside", 3)):
        mesh = UsdGeom.Mesh(stage.GetPrimAtPath(f"/run/body/{name}"))
        assert mesh.GetPointsAttr().GetTimeSamples() == [0.0, 1.0]
        assert len(mesh.GetVelocitiesAttr().Get(1.0)) == len(mesh.GetPointsAttr().Get(1.0))
        piece = np.array(UsdGeom.PrimvarsAPI(mesh).GetPrimvar("piece").Get(1.0))
        assert len(set(piece.tolist())) == count == len(PIECES)
        bound, _ = UsdShade.MaterialBindingAPI(mesh.GetPrim()).ComputeBoundMaterial()
        assert bound.GetPath() == f"/run/materials/{name}"


@pytest.mark.parametrize("name", ["run", "rigid"])
def test_usd_passes_its_own_validators(name: str, tmp_path: Path, request: pytest.FixtureRequest) -> None:
    pytest.importorskip("pxr")
    from pxr import Usd, UsdValidation

    (path,) = export_surfaces(request.getfixturevalue(name), "usd", tmp_path)
    validators = UsdValidation.ValidationRegistry().GetOrLoadAllValidators()
    found = UsdValidation.ValidationContext(validators).Validate(Usd.Stage.Open(str(path)))
    assert len(validators) > 10 and [error.GetMessage() for error in found] == []


def test_colours_are_in_linear_light_where_the_format_says_so(run: Path, tmp_path: Path) -> None:
    """#b9712c by colour-science tables: sRGB 185, 113, 44 are 0.48515, 0.16513, 0.02519 in linear light."""
    wanted = pytest.approx([0.48515, 0.16513, 0.02519], abs=2e-5)
    document, _ = read_glb(export_surfaces(run, "glb", tmp_path, frame=0)[0])
    assert document["materials"][0]["pbrMetallicRoughness"]["baseColorFactor"][:3] == wanted
    export_surfaces(run, "obj", tmp_path, frame=0)
    (line,) = [line for line in next(tmp_path.glob("*.mtl")).read_text().splitlines() if line.startswith("Kd")][:1]
    assert [float(part) for part in line.split()[1:]] == wanted
    pytest.importorskip("pxr")
    from pxr import Usd

    stage = Usd.Stage.Open(str(export_surfaces(run, "usd", tmp_path)[0]))
    colour = stage.GetPrimAtPath("/run/materials/skin/surface").GetAttribute("inputs:diffuseColor").Get()
    assert list(colour) == wanted


def test_colours_are_those_of_the_look(run: Path, tmp_path: Path) -> None:
    """Of faces, in PLY, as trimesh reads them: two, and as many of the inside as cracks have triangles."""
    trimesh = pytest.importorskip("trimesh")
    mesh = trimesh.load(export_surfaces(run, "ply", tmp_path, frame=-1)[0], process=False)
    colours, count = np.unique(mesh.visual.face_colors[:, :3], axis=0, return_counts=True)
    assert colours.tolist() == [[0xB9, 0x71, 0x2C], [0xF0, 0xDE, 0xB6]]
    grid = pyvista.read(run / "surface/surface_000001.vtu")
    assert count[1] == np.count_nonzero(np.asarray(grid.cell_data["origin"]) == 0)


def test_obj_names_its_pieces(run: Path, tmp_path: Path) -> None:
    text = export_surfaces(run, "obj", tmp_path, frame=1)[0].read_text()
    assert [line for line in text.splitlines() if line.startswith("o ")] == [f"o piece_{n:06d}" for n in PIECES]


def test_what_cannot_be_exported(run: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="--format stl: must be one of ply, obj, glb, usd"):
        export_surfaces(run, "stl")
    with pytest.raises(InputError, match=r"--frame 7: .* has 2 frames"):
        export_surfaces(run, "obj", frame=7)
    flat = lattice(2, 2)
    none = np.zeros_like(flat.points)
    SurfaceFiles(tmp_path, 2).write_frame(BodySurface(flat, 1.0).make_frame(0.0, none, none))
    with pytest.raises(InputError, match="2D has no closed surface"):
        export_surfaces(tmp_path, "obj")


def test_quaternions_turn_as_rotation_vectors_do() -> None:
    """Against SciPy, up to the whole turn; the identity; one sign."""
    from scipy.spatial.transform import Rotation

    turn = np.concatenate([np.zeros((1, 3)), np.random.default_rng(1).normal(size=(20, 3)) * 2])
    found = rotation_quaternions(turn)
    assert (found[:, 0] >= 0).all() and found[0].tolist() == [1.0, 0.0, 0.0, 0.0]
    wanted = Rotation.from_rotvec(turn).as_matrix()
    np.testing.assert_allclose(Rotation.from_quat(np.roll(found, -1, axis=1)).as_matrix(), wanted, atol=1e-12)
