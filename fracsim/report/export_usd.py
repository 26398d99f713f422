"""All frames of a run as one USD file, with z upwards, in m and in simulated time."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from .export_surfaces import (
    INSIDE,
    MATERIALS,
    SKIN,
    Ints,
    RigidTrack,
    Surface,
    Values,
    linear_colours,
    material_roughness,
)
from .pictures.picture_options import MaterialLook

# time in which a surface appears or disappears before its frame, as a share of the time since the frame before
_JUMP = 1e-3


class UsdFile:
    """Writer of a USD file.

    A time code is the interval between two frames, so that programs that show one time code per picture show every
    frame. timeCodesPerSecond is the number of time codes in a second of simulated time, so that velocities are in m/s.
    """

    def __init__(self, path: Path, codes: list[float], interval: float, playback: float, look: MaterialLook) -> None:
        """Create the file with its materials.

        Args:
            path: the file.
            codes: time codes of the frames.
            interval: simulated time of a time code, s.
            playback: frames per second with which programs play; time codes do not depend on it.
            look: colours.
        """
        from pxr import Sdf, Usd, UsdGeom, UsdShade

        self._codes, self._colours = codes, np.array(linear_colours(look))
        self._stage = stage = Usd.Stage.CreateNew(str(path))
        UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.z)
        UsdGeom.SetStageMetersPerUnit(stage, 1.0)
        stage.SetTimeCodesPerSecond(1 / interval)
        stage.SetFramesPerSecond(playback)
        stage.SetStartTimeCode(codes[0])
        stage.SetEndTimeCode(codes[-1])
        root = UsdGeom.Xform.Define(stage, "/run").GetPrim()
        stage.SetDefaultPrim(root)
        time = root.CreateAttribute("userProperties:time", Sdf.ValueTypeNames.Double)
        for code in codes:
            time.Set(code * interval, code)
        self._materials = []
        for name, colour, roughness in zip(MATERIALS, linear_colours(look), material_roughness(look), strict=True):
            material = UsdShade.Material.Define(stage, f"/run/materials/{name}")
            shader = UsdShade.Shader.Define(stage, f"/run/materials/{name}/surface")
            shader.CreateIdAttr("UsdPreviewSurface")
            shader.CreateInput("diffuseColor", Sdf.ValueTypeNames.Color3f).Set(colour)
            shader.CreateInput("roughness", Sdf.ValueTypeNames.Float).Set(roughness)
            material.CreateSurfaceOutput().ConnectToSource(shader.ConnectableAPI(), "surface")
            self._materials.append(material)
        self._body: dict[int, _Mesh] = {}

    def save(self) -> None:
        """Write the file."""
        self._stage.GetRootLayer().Save()

    def add_body_frame(self, frame: int, body: Surface, piece: Ints) -> None:
        """Add a frame of a deforming body, whose points and triangles change; `piece` (k,) of each triangle.

        Skin and inside are a mesh each: Blender does not read materials by face that change in time.
        """
        for number in (SKIN, INSIDE):
            if number not in self._body:
                self._body[number] = mesh = _Mesh(self._stage, f"/run/body/{MATERIALS[number]}")
                mesh.bind(self._materials[number], self._colours[number])
            chosen = np.flatnonzero(body.material == number)
            part, code = body.part("body", chosen), self._codes[frame]
            self._body[number].set_surface(part, code)
            self._body[number].set_motion(part.velocity, piece[chosen], code)

    def add_track(self, track: RigidTrack) -> None:
        """Add a surface that stays rigid: a transform with time samples, and a mesh that does not change."""
        from pxr import Gf, UsdGeom

        codes, first, stop = self._codes, track.first, track.frames.stop
        name = track.surface.name.replace("-", "_")
        # an obstacle may be named body or materials
        path = f"/run/{name}" if track.surface.material[0] in (SKIN, INSIDE) else f"/run/obstacles/{name}"
        xform = UsdGeom.Xform.Define(self._stage, path)
        # the same name again: Blender takes that of the mesh
        mesh = _Mesh(self._stage, f"{path}/{name}")
        mesh.set_surface(track.surface)
        mesh.bind_by_face(track.surface.material, self._materials, self._colours)
        translate, orient = xform.AddTranslateOp(UsdGeom.XformOp.PrecisionDouble), xform.AddOrientOp()
        poses = zip(track.frames, track.translation, track.rotation, strict=True)
        for frame, translation, rotation in poses if track.moves else [next(poses)]:
            code = [codes[frame]] if track.moves else []
            translate.Set(Gf.Vec3d(*map(float, translation)), *code)
            orient.Set(Gf.Quatf(*map(float, rotation)), *code)
        if len(track.frames) == len(codes):
            return
        # Blender does not read visibility in time: the scale is 0 in frames without the surface
        scale, visible = xform.AddScaleOp(), xform.CreateVisibilityAttr()
        changes = [(0, first == 0), (first, True), *([(stop, False)] if stop < len(codes) else [])]
        for frame, shown in dict(changes).items():
            if frame:
                scale.Set(Gf.Vec3f(float(not shown)), codes[frame] - _JUMP * (codes[frame] - codes[frame - 1]))
            scale.Set(Gf.Vec3f(float(shown)), codes[frame])
            visible.Set(UsdGeom.Tokens.inherited if shown else UsdGeom.Tokens.invisible, codes[frame])


class _Mesh:
    """Mesh with its normals at the corners of its triangles."""

    def __init__(self, stage: Any, path: str) -> None:
        from pxr import UsdGeom

        self._mesh = UsdGeom.Mesh.Define(stage, path)
        self._mesh.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
        self._normals = self._primvar("normals", "Normal3fArray", "faceVarying")

    def set_surface(self, surface: Surface, *code: float) -> None:
        """Set points, triangles and normals, at a time code or for all times."""
        mesh, points = self._mesh, _vectors(surface.points)
        mesh.CreatePointsAttr().Set(points, *code)
        mesh.CreateExtentAttr().Set(mesh.ComputeExtent(points), *code)
        mesh.CreateFaceVertexCountsAttr().Set(_integers(np.full(len(surface.triangles), 3)), *code)
        mesh.CreateFaceVertexIndicesAttr().Set(_integers(surface.triangles), *code)
        normals, number = np.unique(np.round(surface.normals.reshape(-1, 3), 4), axis=0, return_inverse=True)
        self._normals.Set(_vectors(normals), *code)
        self._normals.SetIndices(_integers(number), *code)

    def set_motion(self, velocity: Values, piece: Ints, code: float) -> None:
        """Set the velocities of the points and the fragment of each triangle at a time code."""
        self._mesh.CreateVelocitiesAttr().Set(_vectors(velocity), code)
        self._primvar("piece", "IntArray", "uniform").Set(_integers(piece), code)

    def bind(self, material: Any, colour: Values) -> None:
        """Give the mesh a material."""
        from pxr import UsdShade

        UsdShade.MaterialBindingAPI.Apply(self._mesh.GetPrim()).Bind(material)
        self._primvar("displayColor", "Color3fArray", "constant").Set(_vectors(colour))

    def bind_by_face(self, number: Ints, materials: list[Any], colours: Values) -> None:
        """Give each triangle the material of its number (k,)."""
        from pxr import UsdGeom, UsdShade

        self._primvar("displayColor", "Color3fArray", "uniform").Set(_vectors(colours[number]))
        binding = UsdShade.MaterialBindingAPI.Apply(self._mesh.GetPrim())
        for index in np.unique(number):
            faces = _integers(np.flatnonzero(number == index))
            subset = binding.CreateMaterialBindSubset(MATERIALS[index], faces, UsdGeom.Tokens.face)
            UsdShade.MaterialBindingAPI.Apply(subset.GetPrim()).Bind(materials[index])

    def _primvar(self, name: str, kind: str, interpolation: str) -> Any:
        from pxr import Sdf, UsdGeom

        return UsdGeom.PrimvarsAPI(self._mesh).CreatePrimvar(name, getattr(Sdf.ValueTypeNames, kind), interpolation)


def _vectors(values: Values) -> Any:
    """Array of USD of vectors (n, 3) in single precision."""
    from pxr import Vt

    return Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(values.reshape(-1, 3), np.float32))


def _integers(values: Ints) -> Any:
    """Array of USD of integers, in their order."""
    from pxr import Vt

    return Vt.IntArray.FromNumpy(np.ascontiguousarray(values.reshape(-1), np.int32))
