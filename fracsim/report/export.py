"""`fracsim export`: the split surface of a run as files for Blender, Houdini and others, read from what a run wrote.

Skin and inside have the colours of the study's look. PLY, OBJ and GLB by trimesh, a file a frame; USD by usd-core, one
file with all frames in time.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from ..errors import InputError
from ..meshes.plain_files import replacing_all
from .pictures.colour_maps import rgb
from .pictures.frame_geometry import is_crack, without_single_nodes
from .pictures.frames import CLOSE, FrameSource, film_interval, find_frames, load_grid, read_study
from .pictures.material_looks import MaterialLook, material_look

Ints = npt.NDArray[np.int64]
Values = npt.NDArray[np.float64]
EXPORT_FORMATS = ("ply", "obj", "glb", "usd")
USD_RATE = 24.0  # pictures a second, which its time codes do not depend on


@dataclass(frozen=True)
class FragmentMesh:
    """A closed surface.

    Attributes:
        name: piece_000012.    points: (n, 3) m.    triangles: (k, 3), outwards.    crack: (k,) of the inside.
    """

    name: str
    points: Values
    triangles: Ints
    crack: npt.NDArray[np.bool_]


def export_surfaces(
    folder: Path, kind: str, target: Path | None = None, *, frame: int | None = None, dust: bool = True, look: str = ""
) -> list[Path]:
    """Write all frames, or one, into the folder `target` (OUT/export); returns the files. Without `dust`: no pieces of
    a single node."""
    if kind not in EXPORT_FORMATS:
        raise InputError(f"--format {kind}: must be one of {', '.join(EXPORT_FORMATS)}")
    shots = find_frames(folder)
    if shots[0].index >= 0:
        raise InputError(f"{folder} has no surface.pvd: set output.surface = true in the study, and run it again")
    if frame is not None and not -len(shots) <= frame < len(shots):
        raise InputError(f"--frame {frame}: {folder} has {len(shots)} frames, counted from 0 (-1 is the last)")
    chosen = list(range(len(shots))) if frame is None else [frame % len(shots)]
    if target is None and (folder / "export").is_symlink():
        raise InputError(f"{folder / 'export'} is a link: name the folder for the files with -o")
    target = target or folder / "export"
    skin = material_look(look or read_study(folder).get("output", {}).get("look", "plain"))
    frames = ((number, read_fragments(shots[number], dust)) for number in chosen)
    times = [shot.t for shot in shots]
    name = folder.resolve().name
    target.mkdir(parents=True, exist_ok=True)
    if kind == "usd":
        with replacing_all(target / f"{name}.usdc") as new:
            _usd(new, frames, skin, times)
        return [target / f"{name}.usdc"]
    write = {"ply": _ply, "obj": _obj, "glb": _glb}[kind]
    made = []
    for number, pieces in frames:
        made.append(target / f"{name}_{number:06d}.{kind}")
        with replacing_all(made[-1]) as new:
            write(new, pieces, skin, times[number])
    return made


def read_fragments(shot: FrameSource, dust: bool = True) -> list[FragmentMesh]:
    """The pieces of a frame, by their numbers. InputError of a body in 2D, which has no surface."""
    grid = load_grid(shot) if dust else without_single_nodes(load_grid(shot))
    if not np.all(grid.celltypes == 5):
        raise InputError(f"{shot.folder}: a body in 2D has no closed surface to export")
    triangles, crack = np.asarray(grid.cell_connectivity).reshape(-1, 3), is_crack(grid)
    points, of = np.asarray(grid.points, float), np.asarray(grid.cell_data["piece"])
    order = np.argsort(of, kind="stable")
    numbers, first = np.unique(of[order], return_index=True)
    parts = zip(numbers, np.split(order, first[1:]), strict=True)
    return [_piece(f"piece_{number:06d}", points, triangles[part], crack[part]) for number, part in parts]


def _piece(name: str, points: Values, triangles: Ints, crack: npt.NDArray[np.bool_]) -> FragmentMesh:
    used, numbered = np.unique(triangles, return_inverse=True)
    return FragmentMesh(name, points[used], numbered.reshape(-1, 3), crack)


# --- formats ---


def _needed(name: str, package: str) -> Any:
    from importlib import import_module

    try:
        return import_module(name)
    except ImportError:
        raise InputError(f"--format: this one needs {package} (pip install {package})") from None


def _colours(piece: FragmentMesh, skin: MaterialLook) -> npt.NDArray[np.uint8]:
    """(k, 4) of the triangles."""
    table = np.array([[*rgb(each), 255] for each in (skin.boundary_colour, skin.crack_colour)], np.uint8)
    return np.asarray(table[piece.crack.astype(int)])


def _mesh(piece: FragmentMesh, skin: MaterialLook, points: Values | None = None) -> Any:
    """As trimesh has it, with colours of faces."""
    trimesh = _needed("trimesh", "trimesh")
    at = piece.points if points is None else points
    return trimesh.Trimesh(at, piece.triangles, face_colors=_colours(piece, skin), process=False)


def _together(pieces: list[FragmentMesh]) -> FragmentMesh:
    """All as one surface."""
    start = np.cumsum([0, *(len(each.points) for each in pieces)])
    triangles = [each.triangles + first for each, first in zip(pieces, start[:-1], strict=True)]
    points, crack = np.concatenate([p.points for p in pieces]), np.concatenate([p.crack for p in pieces])
    return FragmentMesh("body", points, np.concatenate(triangles), crack)


def _ply(path: Path, pieces: list[FragmentMesh], skin: MaterialLook, t: float) -> None:
    """One surface; double precision. Its time, s, is a comment."""
    head, data = _mesh(_together(pieces), skin).export(file_type="ply", vertex_normal=False).split(b"\nelement", 1)
    path.write_bytes(head + f"\ncomment t = {t:.9g} s\nelement".encode() + data)


def _obj(path: Path, pieces: list[FragmentMesh], skin: MaterialLook, t: float) -> None:
    """An object a piece: OBJ has no colours of faces, so groups say what is skin and what inside."""
    lines, first = ["# m", f"# t = {t:.9g} s"], 1
    for piece in pieces:
        lines.append(f"o {piece.name}")
        lines += ["v {:.9g} {:.9g} {:.9g}".format(*point) for point in piece.points]
        for group, which in (("skin", ~piece.crack), ("inside", piece.crack)):
            lines += [f"g {piece.name}_{group}"] if which.any() else []
            lines += ["f {} {} {}".format(*corners) for corners in piece.triangles[which] + first]
        first += len(piece.points)
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


def _glb(path: Path, pieces: list[FragmentMesh], skin: MaterialLook, t: float) -> None:
    """A node a piece, at its middle: in single precision small pieces far away keep their shape. GLB has y upwards; the
    time, s, is in the extras of the scene."""
    trimesh = _needed("trimesh", "trimesh")
    scene = trimesh.Scene(metadata={"time": t})
    upright = trimesh.transformations.rotation_matrix(-np.pi / 2, [1, 0, 0])
    for piece in pieces:
        middle = (piece.points.min(axis=0) + piece.points.max(axis=0)) / 2
        place = upright @ trimesh.transformations.translation_matrix(middle)
        mesh = _mesh(piece, skin, piece.points - middle)
        scene.add_geometry(mesh, node_name=piece.name, geom_name=piece.name, transform=place)
    path.write_bytes(scene.export(file_type="glb"))


def _usd(path: Path, frames: Iterator[tuple[int, list[FragmentMesh]]], skin: MaterialLook, times: list[float]) -> None:
    """One mesh whose points and triangles are of their time, in m, z upwards; `piece` of each triangle beside them.

    `times`: s of all frames of the run. A time code is the time between two of them, so that programs that show a code
    a picture show every frame; timeCodesPerSecond says how many of these are a second.
    """
    Usd, UsdGeom, Sdf, Vt = (_needed(f"pxr.{name}", "usd-core") for name in ("Usd", "UsdGeom", "Sdf", "Vt"))
    stage = Usd.Stage.CreateNew(str(path))
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.z)
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    interval = film_interval(times)
    stage.SetTimeCodesPerSecond(1 / interval)
    stage.SetFramesPerSecond(USD_RATE)
    mesh = UsdGeom.Mesh.Define(stage, "/body")
    stage.SetDefaultPrim(mesh.GetPrim())
    mesh.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
    api = UsdGeom.PrimvarsAPI(mesh)
    colour = api.CreatePrimvar("displayColor", Sdf.ValueTypeNames.Color3fArray, UsdGeom.Tokens.uniform)
    piece_of = api.CreatePrimvar("piece", Sdf.ValueTypeNames.IntArray, UsdGeom.Tokens.uniform)
    attributes: list[tuple[Any, Callable[[FragmentMesh], Any]]] = [
        (mesh.CreatePointsAttr(), lambda one: Vt.Vec3fArray.FromNumpy(one.points.astype(np.float32))),
        (
            mesh.CreateFaceVertexCountsAttr(),
            lambda one: Vt.IntArray([3] * len(one.triangles)),
        ),
        (mesh.CreateFaceVertexIndicesAttr(), lambda one: Vt.IntArray.FromNumpy(one.triangles.astype(np.int32).ravel())),
        (colour, lambda one: Vt.Vec3fArray.FromNumpy(_colours(one, skin)[:, :3].astype(np.float32) / 255)),
    ]
    codes = []
    for number, pieces in frames:
        code = times[number] / interval
        codes.append(round(code) if abs(code - round(code)) < CLOSE else code)
        one = _together(pieces)
        for attribute, values in attributes:
            attribute.Set(values(one), codes[-1])
        of = np.repeat([int(each.name.split("_")[1]) for each in pieces], [len(each.triangles) for each in pieces])
        piece_of.Set(Vt.IntArray.FromNumpy(of.astype(np.int32)), codes[-1])
    stage.SetStartTimeCode(codes[0])
    stage.SetEndTimeCode(codes[-1])
    stage.GetRootLayer().Save()
