"""Exported surfaces, opened again by readers that share no code with what wrote them: closed, with their volumes."""

from __future__ import annotations

import csv
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
import pyvista
from mpi4py import MPI

from fracsim.deformable_run import run_study
from fracsim.errors import InputError
from fracsim.output.surface.body_surface import BodySurface
from fracsim.output.surface.vtk_files import SurfaceFiles, rotation_quaternions
from fracsim.report.export import export_surfaces
from fracsim.study import Study
from support.solids import lattice, patterns, separated

Values = npt.NDArray[np.float64]
PIECES = (0, 1, 2)


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A bar of 6 x 1 x 1 m, whole at first, then in three pieces that lie far away from the origin."""
    folder = tmp_path_factory.mktemp("bar")
    mesh = lattice(6, 1, 1)
    surface, files = BodySurface(mesh, 1.0), SurfaceFiles(folder, 3)
    x, none = mesh.points, np.zeros_like(mesh.points)
    files.write_frame(surface.make_frame(0.0, none, none))
    part = np.searchsorted([2.5, 3.5], x[:, 0])
    surface.update(patterns(surface.skeleton, separated(surface.skeleton, part)))
    apart = np.array([[0.0, 0, 0], [0.5, 0.25, 0], [40.0, 0, 8.0]])[part]
    files.write_frame(surface.make_frame(1.0, apart, none))
    (folder / "study.toml").write_text('[output]\nlook = "bread"\n')
    return folder


def volume(mesh: Any) -> float:
    """Of a closed surface; refuses one that is open."""
    mesh = mesh.extract_surface().triangulate()
    assert mesh.n_open_edges == 0 and mesh.is_manifold
    x = np.asarray(mesh.points, float)
    x = (x - x.mean(axis=0))[mesh.regular_faces]
    return float(np.linalg.det(x).sum() / 6)


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
    return [each.extract_surface().clean(tolerance=1e-7) for each in found if each is not None and each.n_cells]


def of_usd(path: Path) -> list[Any]:
    """The last frame, by the arrays that USD hands over."""
    from pxr import Usd, UsdGeom

    stage = Usd.Stage.Open(str(path))  # which goes with its name
    mesh = UsdGeom.Mesh(stage.GetDefaultPrim())
    points = np.array(mesh.GetPointsAttr().Get(1.0), float)
    faces = np.array(mesh.GetFaceVertexIndicesAttr().Get(1.0)).reshape(-1, 3)
    return list(pyvista.PolyData.from_regular_faces(points, faces).split_bodies())


READERS: dict[str, Callable[[Path], list[Any]]] = {"ply": of_ply, "obj": of_ply, "glb": of_glb, "usd": of_usd}


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
    trimesh = pytest.importorskip("trimesh")
    return list(trimesh.load(path).geometry.values())


def volume_in_single(mesh: Any) -> float:
    """Of a surface in single precision, in which corners of slivers fall together: each side is one of an even number
    of triangles that are left."""
    points, number = np.unique(np.asarray(mesh.vertices), axis=0, return_inverse=True)
    corners = number.reshape(-1)[mesh.faces]
    flat = (corners == np.roll(corners, 1, axis=1)).any(axis=1)
    sides = np.sort(np.concatenate([np.roll(corners[~flat], n, axis=1)[:, :2] for n in range(3)]), axis=1)
    assert not np.any(np.unique(sides, axis=0, return_counts=True)[1] % 2) and np.count_nonzero(flat) < 0.1 * len(flat)
    return float(np.linalg.det(points[corners]).sum() / 6)


@pytest.fixture(scope="module")
def rigid(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A bar that falls askew on a floor, breaks there and goes on as rigid pieces."""
    pytest.importorskip("mujoco", reason="an environment made without a network")
    folder = tmp_path_factory.mktemp("rigid") / "out"
    tables = {
        "title": "dropped", "mesh": {"builder": "box", "size": [0.6, 0.2, 0.2], "h": 0.1},
        "material": {"energy": "linear", "young": 1e10, "poisson": 0.2, "density": 2000.0},
        "fracture": {"strength": 3e5, "kernel": "neighbours"}, "brittle": {"surfaces": 4}, "contact": {"friction": 0.4},
        "load": {"gravity": [0.0, 0.0, -9.81]},
        "body": [{"position": [0.0, 0.0, 0.05], "rotation": [0.0, -0.1, 0.0], "velocity": [0.0, 0.0, -4.0]}],
        "obstacle": [{"name": "floor", "shape": "plane", "at": [0.0] * 3, "normal": [0.0, 0.0, 1.0], "friction": 0.5}],
        "time": {"scheme": "rigid", "step": 2e-3, "end": 0.06}, "output": {"every": 30, "picture": False},
    }  # fmt: skip
    run_study(MPI.COMM_SELF, Study.model_validate(tables), folder)
    return folder


@pytest.mark.parametrize("kind", READERS)
def test_rigid_pieces_are_closed_with_their_volumes(kind: str, rigid: Path, tmp_path: Path) -> None:
    """As many as pieces.csv has, each as large, to 1e-6; all together 0.024 m^3. The floor is none of them."""
    pytest.importorskip("pxr" if kind == "usd" else "trimesh")
    made, volume_of = export_surfaces(rigid, kind, tmp_path)[-1], volume_in_single if kind == "glb" else volume
    found = sorted(volume_of(each) for each in (by_trimesh if kind == "glb" else READERS[kind])(made))
    with (rigid / "pieces.csv").open() as file:
        rows = [*csv.DictReader(file)]
    expected = sorted(float(row["volume"]) for row in rows if row["time"] == rows[-1]["time"])
    assert len(expected) > 2
    assert found == pytest.approx(expected, rel=1e-6) and sum(found) == pytest.approx(0.024, rel=1e-6)


def test_usd_has_every_frame_and_metres(run: Path, tmp_path: Path) -> None:
    pxr = pytest.importorskip("pxr.Usd")
    from pxr import UsdGeom

    stage = pxr.Stage.Open(str(export_surfaces(run, "usd", tmp_path)[0]))
    mesh = UsdGeom.Mesh(stage.GetDefaultPrim())
    assert mesh.GetPointsAttr().GetTimeSamples() == [0.0, 1.0] and stage.GetEndTimeCode() == 1.0
    assert UsdGeom.GetStageMetersPerUnit(stage) == 1.0 and UsdGeom.GetStageUpAxis(stage) == "Z"
    piece = np.array(UsdGeom.PrimvarsAPI(mesh).GetPrimvar("piece").Get(1.0))
    assert set(piece.tolist()) == set(PIECES)


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
