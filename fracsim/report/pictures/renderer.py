"""Lamps, camera and a body: a frame as an array of pixels.

Where a crack comes to the skin, and how far it opens there: what opens by less than a pixel is drawn as a line.
"""

from __future__ import annotations

from typing import Any, Self

import numpy as np
import numpy.typing as npt

from .annotations import ColourLegend, annotate, format_time
from .camera import ViewBounds, aim_camera, pixel_width, prepare_grid
from .colour_maps import colour_range, field_title, map_colours, rgb, select_array
from .floor import add_floor, add_shadow
from .frame_geometry import FrameParts, frame_parts, is_crack, with_normals
from .frames import FrameSource, load_grid, plane_normals
from .material_looks import MATERIAL_LOOKS, material_look
from .obstacle_meshes import add_obstacles
from .picture_options import PictureOptions

Ints = npt.NDArray[np.int64]
Values = npt.NDArray[np.float64]
GRID = 1e-7  # of the body's size: copies of a point were nearer than that
Pixels = npt.NDArray[np.uint8]
# from where, seen from the camera (right, up, towards it), and how bright: the main one, one that fills, one behind
LAMPS = (((-1.0, 1.1, 1.2), 0.68), ((1.2, -0.3, 1.2), 0.42), ((0.3, 1.5, -1.2), 0.3))
AMBIENT = 0.26  # light in the shade
OCCLUSION = 0.05  # of the body's size: how far corners are dark
LEVEL = 0.5  # least share of its normal that is upwards, of a floor
FINER = 2  # pixels of VTK's supersampling to one of the picture, along each side
HAIR = 1.5  # pixels: what opens by less is drawn as a line


def crack_opening(at: Values, rest: Values) -> Values:
    """(n,) how far the points that were at one place, `rest` (n, 3), are apart at `at` (n, 3), m: the diagonal of the
    box around them."""
    size = float(np.ptp(rest, axis=0).max()) or 1.0
    _, group = np.unique(np.rint(rest / (GRID * size)), axis=0, return_inverse=True)
    group = group.reshape(-1)
    count = int(group.max(initial=-1)) + 1
    least, most = np.full((count, 3), np.inf), np.full((count, 3), -np.inf)
    np.minimum.at(least, group, at)
    np.maximum.at(most, group, at)
    return np.asarray(np.linalg.norm(most - least, axis=1)[group])


def crack_edges(grid: Any) -> Ints:
    """(k, 2) points of the lines along which skin and cracks of a split surface in 3D meet."""
    crack = is_crack(grid)
    corners = np.asarray(grid.cell_connectivity).reshape(-1, 3)
    skin, inside = (_sides(corners[which]) for which in (~crack, crack))
    return skin[np.isin(_key(skin), _key(inside))]


def narrow_crack_lines(grid: Any, width: float) -> Any:
    """The rims of a frame (see body.moved) that open by less than `width`, m, as lines; None: there are none."""
    import pyvista

    if "origin" not in grid.cell_data or not is_crack(grid).any():
        return None
    lines = crack_edges(grid)
    used, lines = np.unique(lines, return_inverse=True)
    lines = lines.reshape(-1, 2)
    points = np.asarray(grid.points, float)[used]
    narrow = crack_opening(points, np.asarray(grid.point_data["rest"])[used]) < width
    lines = lines[narrow[lines].all(axis=1)]
    return pyvista.PolyData(points, lines=np.insert(lines, 0, 2, axis=1).ravel()) if len(lines) else None


def _sides(triangles: Ints) -> Ints:
    """(3 k, 2) the lower point first."""
    return np.sort(np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]]), axis=1)


def _key(sides: Ints) -> Ints:
    return np.asarray(sides[:, 0].astype(np.int64) << 32 | sides[:, 1].astype(np.int64))


class Renderer:
    """A place to draw frames in, all from one place. A context manager: it ends with the driver's window."""

    def __init__(
        self, look: PictureOptions, scope: ViewBounds, limits: tuple[float, float] | None, study: dict[str, Any]
    ) -> None:
        """`scope`: what is to be seen.    `limits`: of the colours, see `field_range`."""
        import pyvista

        self.options, self.limits, self._study, self._flat = look, limits, study, scope.is_flat
        self.material = material_look(look.material or study.get("output", {}).get("look", "plain"))
        self._scope, self._bounds = scope, scope.bounds
        self._size = float(np.linalg.norm(np.diff(scope.bounds.reshape(3, 2))))
        self._plotter = pyvista.Plotter(off_screen=True, window_size=look.size, lighting="none")
        self._plotter.set_background(MATERIAL_LOOKS["plain"].backdrop if self._flat else self.material.backdrop)
        self._light_up()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._plotter.close()

    def render_frame(self, shot: FrameSource, title: str | None = None) -> Pixels:
        """(height, width, 3) of a frame; `title`: in place of the look's."""
        plotter, look = self._plotter, self.options
        plotter.suppress_rendering = True  # or all that is added would be drawn at once
        plotter.clear_actors()
        aim_camera(plotter, self._scope, look)  # before what is drawn: the width of hairlines is in pixels
        grid = prepare_grid(shot, look)
        self._add(frame_parts(grid))
        if not self._flat:
            self._add_hairlines(grid)
        floors = self._add_floor(shot, frame_parts(grid)) if look.floor and not self._flat else []
        beside = [
            file for file, name in zip(shot.obstacle_files, shot.obstacle_names, strict=True) if name not in floors
        ]
        add_obstacles(plotter, beside, flat=self._flat)
        plotter.reset_camera_clipping_range()
        plotter.suppress_rendering = False
        plotter.render()
        return self._lettered(np.asarray(plotter.screenshot(return_img=True))[..., :3], shot, title)

    # --- the body ---

    def _add(self, body: FrameParts) -> None:
        colour = self.options.colour
        for part, plain in ((body.boundary, self.material.boundary_colour), (body.crack, self.material.crack_colour)):
            if part is not None:
                self._add_part(part, plain)
        if body.outline is not None:
            if colour == "age" and self.limits is not None:
                self._add_coloured(
                    body.outline,
                    "age",
                    MATERIAL_LOOKS["plain"].boundary_colour,
                    line_width=3 * (FINER if self.options.fine else 1),
                )
            else:
                self._plotter.add_mesh(
                    body.outline, color="black", line_width=1.5 * (FINER if self.options.fine else 1), lighting=False
                )

    def _add_part(self, part: Any, plain: str) -> None:
        part = part if self._flat else with_normals(part)
        if self.options.colour == "crack":
            self._plotter.add_mesh(part, color=plain, **self._how())
        else:
            self._add_coloured(part, select_array(part, self.options.colour), MATERIAL_LOOKS["plain"].boundary_colour)

    def _add_coloured(self, part: Any, field: str, missing: str, **how: Any) -> None:
        if self.limits is None and field != "piece":  # nothing to show: no crack, or on the lines of a 2D body alone
            self._plotter.add_mesh(part, color=missing, **self._how())
            return
        values = np.asarray(part[field], float)
        values = values if values.ndim == 1 else np.linalg.norm(values, axis=1)
        of = map_colours(values, None if field == "piece" else self.limits, missing)
        name = "colours of the picture"
        (part.cell_data if field in part.cell_data else part.point_data)[name] = of
        self._plotter.add_mesh(part, scalars=name, rgb=True, **self._how(), **how)

    def _how(self) -> dict[str, Any]:
        """Of light; a flat body has the very colours of its legend."""
        if self._flat:
            return {"lighting": False, "ambient": 0.0, "diffuse": 1.0}
        gloss = self.material.gloss if self.options.colour == "crack" else 0.0
        mirrored = {"specular": gloss, "specular_power": 8 + 60 * gloss}
        return {"smooth_shading": True, "ambient": AMBIENT, "diffuse": 1.0, **mirrored}

    def _add_hairlines(self, grid: Any) -> None:
        lines = narrow_crack_lines(grid, HAIR * pixel_width(self._plotter, self.options.size[1]))
        if lines is not None:
            dark = "#3a2a1c" if self.options.colour == "crack" else "black"
            wide = HAIR * (FINER if self.options.fine else 1)
            self._plotter.add_mesh(lines, color=dark, line_width=wide, lighting=False)

    # --- around it ---

    def _add_floor(self, shot: FrameSource, body: FrameParts) -> list[str]:
        """One where the most level obstacle plane is, else below all; returns the obstacles that it stands for."""
        import pyvista

        planes = plane_normals(self._study)
        there = [
            (file, name) for file, name in zip(shot.obstacle_files, shot.obstacle_names, strict=True) if name in planes
        ]
        floors = sorted(there, key=lambda each: -_level(planes[each[1]]))[:1]
        floors = [each for each in floors if _level(planes[each[1]]) > LEVEL]
        normal, point = np.array([0.0, 0, 1]), np.array([*self._bounds.reshape(3, 2).mean(axis=1)[:2], self._bounds[4]])
        if floors:
            normal = planes[floors[0][1]] / np.linalg.norm(planes[floors[0][1]])
            drawn = np.asarray(pyvista.read(floors[0][0]).points, float)
            point = drawn[np.argmax(drawn @ normal)]
            middle = self._bounds.reshape(3, 2).mean(axis=1)
            point = middle - ((middle - point) @ normal) * normal
        add_floor(self._plotter, point, normal, self._size, self.material.backdrop)
        light = self._main_lamp()
        light = light if light @ normal > 0.3 else normal
        for part in body.surfaces:
            add_shadow(self._plotter, part, point, normal, light, self._size, rgb(self.material.backdrop))
        return [name for _, name in floors]

    def _main_lamp(self) -> Values:
        """(3,) direction to it in space."""
        camera = self._plotter.camera
        back = np.array(camera.position) - np.array(camera.focal_point)
        back /= np.linalg.norm(back)
        right = np.cross(camera.up, back)
        right /= np.linalg.norm(right)
        (x, y, z), _ = LAMPS[0]
        light = x * right + y * np.cross(back, right) + z * back
        return np.asarray(light / np.linalg.norm(light))

    def _light_up(self) -> None:
        import pyvista

        plotter = self._plotter
        if self._flat:
            plotter.enable_anti_aliasing("ssaa")
            return
        for position, intensity in LAMPS:
            plotter.add_light(pyvista.Light(position=position, intensity=intensity, light_type="camera light"))
        plotter.enable_anti_aliasing("ssaa" if self.options.fine else "fxaa")
        plotter.enable_ssao(radius=OCCLUSION * self._size, bias=0.002 * self._size, kernel_size=64, blur=True)

    # --- what is to be read ---

    def _lettered(self, pixels: Pixels, shot: FrameSource, title: str | None) -> Pixels:
        look = self.options
        if look.bare:
            return pixels
        chosen = title if title is not None else look.title if look.title is not None else self._study.get("title", "")
        legend, keys = None, []
        if look.colour == "crack" and self.material == MATERIAL_LOOKS["plain"] and not self._flat:
            keys = [(self.material.boundary_colour, "boundary"), (self.material.crack_colour, "crack")]
        elif look.colour != "crack" and self.limits is not None:
            legend = ColourLegend(field_title(look.colour), self.limits)
        wide = pixel_width(self._plotter, look.size[1])
        time = format_time(shot.t) + (f", displacements x {look.magnify:g}" if look.magnify != 1 else "")
        return annotate(pixels, title=chosen, time=time, pixel=wide, legend=legend, keys=keys)


def _level(normal: Values) -> float:
    """1 of what faces upwards, 0 of a wall."""
    return float(normal[2] / np.linalg.norm(normal))


def field_range(shot: FrameSource, colour: str) -> tuple[float, float] | None:
    """The range that the colours of a frame should have; None where there is nothing to show, or no range (pieces)."""
    if colour in ("crack", "piece"):
        return None
    grid = load_grid(shot)
    body = frame_parts(grid)
    parts = [*body.surfaces, *([body.outline] if body.outline is not None and colour == "age" else [])]
    found = [np.asarray(part[select_array(part, colour)], float) for part in parts]
    norms = [each if each.ndim == 1 else np.linalg.norm(each, axis=1) for each in found]
    return colour_range(np.concatenate(norms), signed=":" in colour)
