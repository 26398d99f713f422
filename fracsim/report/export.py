"""Export of the split surface of a run for Blender, Houdini and others (`fracsim export`), from the files of the run.

Boundary and crack faces have the colours of the study's look. PLY, OBJ and GLB have one file per frame and are written
by trimesh; USD has one file with all frames in time and is written by usd-core.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from ..errors import InputError
from ..meshes.plain_files import atomic_replacement_of_all
from .pictures.colour_maps import rgb
from .pictures.frames import (
    FILM_TIMING,
    VTK_TRIANGLE,
    FrameSource,
    film_interval,
    find_frames,
    is_crack,
    load_grid,
    read_study,
    without_single_nodes,
)
from .pictures.picture_options import MaterialLook, material_look

Ints = npt.NDArray[np.int64]
Values = npt.NDArray[np.float64]
EXPORT_FORMATS = ("ply", "obj", "glb", "usd")
# playback rate, on which time codes do not depend
_USD_FRAMES_PER_SECOND = 24.0


@dataclass(frozen=True)
class FragmentMesh:
    """Closed surface of a fragment.

    Attributes:
        name: name such as piece_000012.
        points: positions (n, 3), m.
        triangles: triangles (k, 3), oriented outwards.
        crack: mask (k,) of the crack faces.
    """

    name: str
    points: Values
    triangles: Ints
    crack: npt.NDArray[np.bool_]


def export_surfaces(
    folder: Path, kind: str, target: Path | None = None, *, frame: int | None = None, dust: bool = True, look: str = ""
) -> list[Path]:
    """Write all frames, or one, to files and return their paths.

    Args:
        folder: output folder of the run.
        kind: one of `EXPORT_FORMATS`.
        target: folder of the files; None: export in the output folder.
        frame: number of the frame, -1 for the last; None: all.
        dust: with single-node fragments.
        look: see `material_look`; "": that of the study.

    Raises:
        InputError: the run has no split surface, or no such frame; or a package is missing.
    """
    if kind not in EXPORT_FORMATS:
        raise InputError(f"--format {kind}: must be one of {', '.join(EXPORT_FORMATS)}")
    frames = find_frames(folder)
    if frames[0].index >= 0:
        raise InputError(f"{folder} has no surface.pvd: set output.surface = true in the study, and run it again")
    if frame is not None and not -len(frames) <= frame < len(frames):
        raise InputError(f"--frame {frame}: {folder} has {len(frames)} frames, counted from 0 (-1 is the last)")
    numbers = list(range(len(frames))) if frame is None else [frame % len(frames)]
    if target is None and (folder / "export").is_symlink():
        raise InputError(f"{folder / 'export'} is a link: name the folder for the files with -o")
    target = target or folder / "export"
    material = material_look(look or read_study(folder).get("output", {}).get("look", "plain"))
    meshes = ((number, read_fragments(frames[number], dust)) for number in numbers)
    times = [source.t for source in frames]
    name = folder.resolve().name
    target.mkdir(parents=True, exist_ok=True)
    if kind == "usd":
        with atomic_replacement_of_all(target / f"{name}.usdc") as temporary:
            _write_usd(temporary, meshes, material, times)
        return [target / f"{name}.usdc"]
    write = {"ply": _write_ply, "obj": _write_obj, "glb": _write_glb}[kind]
    paths = []
    for number, fragments in meshes:
        paths.append(target / f"{name}_{number:06d}.{kind}")
        with atomic_replacement_of_all(paths[-1]) as temporary:
            write(temporary, fragments, material, times[number])
    return paths


def read_fragments(frame: FrameSource, dust: bool = True) -> list[FragmentMesh]:
    """Fragments of a frame, in the order of their names.

    Args:
        frame: the frame.
        dust: with single-node fragments.

    Raises:
        InputError: the body is in 2D and has no closed surface.
    """
    grid = load_grid(frame) if dust else without_single_nodes(load_grid(frame))
    if not np.all(grid.celltypes == VTK_TRIANGLE):
        raise InputError(f"{frame.folder}: a body in 2D has no closed surface to export")
    triangles, crack = np.asarray(grid.cell_connectivity).reshape(-1, 3), is_crack(grid)
    points, fragment = np.asarray(grid.points, float), np.asarray(grid.cell_data["piece"])
    order = np.argsort(fragment, kind="stable")
    names, first = np.unique(fragment[order], return_index=True)
    parts = zip(names, np.split(order, first[1:]), strict=True)
    return [_fragment_mesh(f"piece_{name:06d}", points, triangles[part], crack[part]) for name, part in parts]


def _fragment_mesh(name: str, points: Values, triangles: Ints, crack: npt.NDArray[np.bool_]) -> FragmentMesh:
    """Fragment with its own points only; `triangles` (k, 3) refer to `points` (n, 3) of the body."""
    used, renumbered = np.unique(triangles, return_inverse=True)
    return FragmentMesh(name, points[used], renumbered.reshape(-1, 3), crack)


# --- formats ---


def _import(name: str, package: str) -> Any:
    """Module of an optional package. Raises InputError if the package is not installed."""
    from importlib import import_module

    try:
        return import_module(name)
    except ImportError:
        raise InputError(f"--format: this one needs {package} (pip install {package})") from None


def _face_colours(fragment: FragmentMesh, material: MaterialLook) -> npt.NDArray[np.uint8]:
    """Colours (k, 4) red, green, blue, opacity of the triangles."""
    colours = (material.boundary_colour, material.crack_colour)
    table = np.array([[*rgb(colour), 255] for colour in colours], np.uint8)
    return np.asarray(table[fragment.crack.astype(int)])


def _trimesh_of(fragment: FragmentMesh, material: MaterialLook, points: Values | None = None) -> Any:
    """Mesh of trimesh with colours of the faces; `points` (n, 3) replace those of the fragment."""
    trimesh = _import("trimesh", "trimesh")
    points = fragment.points if points is None else points
    return trimesh.Trimesh(points, fragment.triangles, face_colors=_face_colours(fragment, material), process=False)


def _join(fragments: list[FragmentMesh]) -> FragmentMesh:
    """One surface of all fragments."""
    start = np.cumsum([0, *(len(fragment.points) for fragment in fragments)])
    triangles = [fragment.triangles + first for fragment, first in zip(fragments, start[:-1], strict=True)]
    points = np.concatenate([fragment.points for fragment in fragments])
    crack = np.concatenate([fragment.crack for fragment in fragments])
    return FragmentMesh("body", points, np.concatenate(triangles), crack)


def _write_ply(path: Path, fragments: list[FragmentMesh], material: MaterialLook, t: float) -> None:
    """Write one surface in double precision, with the time t in s as a comment."""
    ply = _trimesh_of(_join(fragments), material).export(file_type="ply", vertex_normal=False)
    head, data = ply.split(b"\nelement", 1)
    path.write_bytes(head + f"\ncomment t = {t:.9g} s\nelement".encode() + data)


def _write_obj(path: Path, fragments: list[FragmentMesh], material: MaterialLook, t: float) -> None:
    """Write one object per fragment. OBJ has no colours of faces, so boundary and crack faces are groups."""
    lines, first = ["# m", f"# t = {t:.9g} s"], 1
    for fragment in fragments:
        lines.append(f"o {fragment.name}")
        lines += ["v {:.9g} {:.9g} {:.9g}".format(*point) for point in fragment.points]
        for group, mask in (("skin", ~fragment.crack), ("inside", fragment.crack)):
            lines += [f"g {fragment.name}_{group}"] if mask.any() else []
            lines += ["f {} {} {}".format(*corners) for corners in fragment.triangles[mask] + first]
        first += len(fragment.points)
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


def _write_glb(path: Path, fragments: list[FragmentMesh], material: MaterialLook, t: float) -> None:
    """Write one node per fragment, with y upwards and the time t in s in the extras of the scene.

    The origin of a node is the centre of its fragment, so that single precision keeps the shape of small fragments.
    """
    trimesh = _import("trimesh", "trimesh")
    scene = trimesh.Scene(metadata={"time": t})
    upright = trimesh.transformations.rotation_matrix(-np.pi / 2, [1, 0, 0])
    for fragment in fragments:
        centre = (fragment.points.min(axis=0) + fragment.points.max(axis=0)) / 2
        transform = upright @ trimesh.transformations.translation_matrix(centre)
        mesh = _trimesh_of(fragment, material, fragment.points - centre)
        scene.add_geometry(mesh, node_name=fragment.name, geom_name=fragment.name, transform=transform)
    path.write_bytes(scene.export(file_type="glb"))


def _write_usd(
    path: Path, frames: Iterator[tuple[int, list[FragmentMesh]]], material: MaterialLook, times: list[float]
) -> None:
    """Write one mesh whose points and triangles change in time, in m with z upwards, and the fragment of each triangle.

    A time code is the interval between two frames, so that programs that show one time code per picture show every
    frame. timeCodesPerSecond is the number of time codes in a second of simulated time.

    Args:
        path: the file.
        frames: numbers and fragments of the frames to write.
        material: colours.
        times: times of all frames of the run, s.
    """
    Usd, UsdGeom, Sdf, Vt = (_import(f"pxr.{name}", "usd-core") for name in ("Usd", "UsdGeom", "Sdf", "Vt"))
    stage = Usd.Stage.CreateNew(str(path))
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.z)
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    interval = film_interval(times)
    stage.SetTimeCodesPerSecond(1 / interval)
    stage.SetFramesPerSecond(_USD_FRAMES_PER_SECOND)
    mesh = UsdGeom.Mesh.Define(stage, "/body")
    stage.SetDefaultPrim(mesh.GetPrim())
    mesh.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
    api = UsdGeom.PrimvarsAPI(mesh)
    colour = api.CreatePrimvar("displayColor", Sdf.ValueTypeNames.Color3fArray, UsdGeom.Tokens.uniform)
    fragment_of_triangle = api.CreatePrimvar("piece", Sdf.ValueTypeNames.IntArray, UsdGeom.Tokens.uniform)
    attributes: list[tuple[Any, Callable[[FragmentMesh], Any]]] = [
        (mesh.CreatePointsAttr(), lambda body: Vt.Vec3fArray.FromNumpy(body.points.astype(np.float32))),
        (mesh.CreateFaceVertexCountsAttr(), lambda body: Vt.IntArray([3] * len(body.triangles))),
        (
            mesh.CreateFaceVertexIndicesAttr(),
            lambda body: Vt.IntArray.FromNumpy(body.triangles.astype(np.int32).ravel()),
        ),
        (
            colour,
            lambda body: Vt.Vec3fArray.FromNumpy(_face_colours(body, material)[:, :3].astype(np.float32) / 255),
        ),
    ]
    codes = []
    for number, fragments in frames:
        code = times[number] / interval
        codes.append(round(code) if abs(code - round(code)) < FILM_TIMING.time_tolerance else code)
        body = _join(fragments)
        for attribute, values in attributes:
            attribute.Set(values(body), codes[-1])
        names = [int(fragment.name.split("_")[1]) for fragment in fragments]
        name_of_triangle = np.repeat(names, [len(fragment.triangles) for fragment in fragments])
        fragment_of_triangle.Set(Vt.IntArray.FromNumpy(name_of_triangle.astype(np.int32)), codes[-1])
    stage.SetStartTimeCode(codes[0])
    stage.SetEndTimeCode(codes[-1])
    stage.GetRootLayer().Save()
