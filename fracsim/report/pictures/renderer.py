"""Renderer: lights, camera, body, obstacles and floor of a frame, drawn to an array of pixels.

A crack that opens by less than a pixel is drawn as a line where it meets the boundary.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

import numpy as np
import numpy.typing as npt

from .annotations import ColourLegend, annotate, format_time
from .camera import ViewBounds, aim_camera, pixel_width, prepare_grid
from .colour_maps import colour_range, field_title, map_colours, rgb, select_array
from .frames import (
    VTK_LINE,
    VTK_TRIANGLE,
    FrameParts,
    FrameSource,
    frame_parts,
    is_crack,
    load_grid,
    plane_normals,
    with_normals,
)
from .picture_options import MATERIAL_LOOKS, PictureOptions, material_look

Ints = npt.NDArray[np.int64]
Values = npt.NDArray[np.float64]
Pixels = npt.NDArray[np.uint8]

OBSTACLE_COLOUR, _OBSTACLE_EDGE_COLOUR = "#c2b393", "#6e6350"


@dataclass(frozen=True)
class SceneStyle:
    """Lights and appearance of a scene. Lengths are shares of the diagonal of the bounds unless said otherwise.

    Attributes:
        lamps: position in the camera's axes (right, up, towards it) and intensity of the main, fill and back light.
        ambient: ambient light.
        occlusion_radius: radius of ambient occlusion, which darkens corners.
        supersampling: samples per pixel along each side.
        min_opening: a crack that opens by less is drawn as a line of this width, pixels.
        point_tolerance: copies of a point are closer to each other, as a share of the largest side of the body.
        obstacle_opacity: opacity of obstacles in 3D.
        min_floor_level: least vertical component of the unit normal of a plane that serves as floor.
        floor_radius: radius of the floor.
        shadow_brightness: brightness of a shadow, as a share of that of the floor.
        shadow_height: height of the shadow above the floor, so that it is visible.
    """

    lamps: tuple[tuple[tuple[float, float, float], float], ...] = (
        ((-1.0, 1.1, 1.2), 0.68), ((1.2, -0.3, 1.2), 0.42), ((0.3, 1.5, -1.2), 0.3),
    )  # fmt: skip
    ambient: float = 0.26
    occlusion_radius: float = 0.05
    supersampling: int = 2
    min_opening: float = 1.5
    point_tolerance: float = 1e-7
    obstacle_opacity: float = 0.5
    min_floor_level: float = 0.5
    floor_radius: float = 40.0
    shadow_brightness: float = 0.86
    shadow_height: float = 5e-4


SCENE_STYLE = SceneStyle()


# --- narrow cracks ----------------------------------------------------------------------------------------------------


def crack_opening(points: Values, rest: Values) -> Values:
    """Opening (n,) at each point, m: diagonal of the box around all copies of the point.

    Args:
        points: present positions (n, 3), m.
        rest: reference positions (n, 3), m, equal for the copies of a point.
    """
    size = float(np.ptp(rest, axis=0).max()) or 1.0
    grid = np.rint(rest / (SCENE_STYLE.point_tolerance * size))
    _, group = np.unique(grid, axis=0, return_inverse=True)
    group = group.reshape(-1)
    count = int(group.max(initial=-1)) + 1
    lower, upper = np.full((count, 3), np.inf), np.full((count, 3), -np.inf)
    np.minimum.at(lower, group, points)
    np.maximum.at(upper, group, points)
    return np.asarray(np.linalg.norm(upper - lower, axis=1)[group])


def crack_edges(grid: Any) -> Ints:
    """Point numbers (k, 2) of the edges at which boundary and crack faces of a split surface in 3D meet."""
    crack = is_crack(grid)
    corners = np.asarray(grid.cell_connectivity).reshape(-1, 3)
    boundary_edges, crack_face_edges = (_triangle_edges(corners[mask]) for mask in (~crack, crack))
    return boundary_edges[np.isin(_edge_keys(boundary_edges), _edge_keys(crack_face_edges))]


def narrow_crack_lines(grid: Any, width: float) -> Any:
    """Lines along crack edges that open by less than `width` in m; None if there are none."""
    import pyvista

    if "origin" not in grid.cell_data or not is_crack(grid).any():
        return None
    lines = crack_edges(grid)
    used, lines = np.unique(lines, return_inverse=True)
    lines = lines.reshape(-1, 2)
    points = np.asarray(grid.points, float)[used]
    is_narrow = crack_opening(points, np.asarray(grid.point_data["rest"])[used]) < width
    lines = lines[is_narrow[lines].all(axis=1)]
    return pyvista.PolyData(points, lines=np.insert(lines, 0, 2, axis=1).ravel()) if len(lines) else None


def _triangle_edges(triangles: Ints) -> Ints:
    """Edges (3 k, 2) of triangles (k, 3), the lower point first."""
    return np.sort(np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]]), axis=1)


def _edge_keys(edges: Ints) -> Ints:
    """One integer (n,) for each edge (n, 2)."""
    return np.asarray(edges[:, 0].astype(np.int64) << 32 | edges[:, 1].astype(np.int64))


# --- scene ------------------------------------------------------------------------------------------------------------


class Renderer:
    """Renderer of frames from one camera position. As a context manager it closes the window of the driver.

    Attributes:
        options: options of the picture.
        limits: range of the colours; None if there is nothing to show.
        material: look of the material.
    """

    def __init__(
        self, options: PictureOptions, view: ViewBounds, limits: tuple[float, float] | None, study: dict[str, Any]
    ) -> None:
        """Open a window off-screen.

        Args:
            options: options of the picture.
            view: bounds to show.
            limits: range of the colours, see `field_range`.
            study: tables of the study, for its title, look and planes.
        """
        import pyvista

        self.options, self.limits, self._study, self._flat = options, limits, study, view.is_flat
        self.material = material_look(options.material or study.get("output", {}).get("look", "plain"))
        self._view, self._bounds = view, view.bounds
        self._size = float(np.linalg.norm(np.diff(view.bounds.reshape(3, 2))))
        # window pixels per pixel of the picture
        self._line_scale = SCENE_STYLE.supersampling if options.fine else 1
        self._plotter = pyvista.Plotter(off_screen=True, window_size=options.size, lighting="none")
        self._plotter.set_background(MATERIAL_LOOKS["plain"].backdrop if self._flat else self.material.backdrop)
        self._add_lights()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._plotter.close()

    def render_frame(self, frame: FrameSource, title: str | None = None) -> Pixels:
        """Picture (height, width, 3) of a frame; `title` replaces that of the options."""
        plotter, options = self._plotter, self.options
        # otherwise everything is drawn again with each addition
        plotter.suppress_rendering = True
        plotter.clear_actors()
        # first: the width of narrow cracks is in pixels
        aim_camera(plotter, self._view, options)
        grid = prepare_grid(frame, options)
        self._add_body(frame_parts(grid))
        if not self._flat:
            self._add_narrow_cracks(grid)
        floors = self._add_floor(frame, frame_parts(grid)) if options.floor and not self._flat else []
        named = zip(frame.obstacle_files, frame.obstacle_names, strict=True)
        add_obstacles(plotter, [file for file, name in named if name not in floors], flat=self._flat)
        plotter.reset_camera_clipping_range()
        plotter.suppress_rendering = False
        plotter.render()
        return self._annotate(np.asarray(plotter.screenshot(return_img=True))[..., :3], frame, title)

    # --- the body ---

    def _add_body(self, parts: FrameParts) -> None:
        colours = ((parts.boundary, self.material.boundary_colour), (parts.crack, self.material.crack_colour))
        for part, colour in colours:
            if part is not None:
                self._add_part(part, colour)
        if parts.outline is None:
            return
        if self.options.colour == "age" and self.limits is not None:
            missing = MATERIAL_LOOKS["plain"].boundary_colour
            self._add_coloured(parts.outline, "age", missing, line_width=3 * self._line_scale)
        else:
            self._plotter.add_mesh(parts.outline, color="black", line_width=1.5 * self._line_scale, lighting=False)

    def _add_part(self, part: Any, colour: str) -> None:
        """Add boundary or crack faces, in one colour or coloured by a field."""
        part = part if self._flat else with_normals(part)
        if self.options.colour == "crack":
            self._plotter.add_mesh(part, color=colour, **self._shading())
        else:
            missing = MATERIAL_LOOKS["plain"].boundary_colour
            self._add_coloured(part, select_array(part, self.options.colour), missing)

    def _add_coloured(self, part: Any, field: str, missing: str, **style: Any) -> None:
        """Add a part coloured by a field; `missing` is the colour of values that are not finite."""
        if self.limits is None and field != "piece":
            # there are no values to show, as if no edge is broken
            self._plotter.add_mesh(part, color=missing, **self._shading())
            return
        values = np.asarray(part[field], float)
        values = values if values.ndim == 1 else np.linalg.norm(values, axis=1)
        colours = map_colours(values, None if field == "piece" else self.limits, missing)
        name = "colours of the picture"
        (part.cell_data if field in part.cell_data else part.point_data)[name] = colours
        self._plotter.add_mesh(part, scalars=name, rgb=True, **self._shading(), **style)

    def _shading(self) -> dict[str, Any]:
        """Keyword arguments of the lighting; a flat body has exactly the colours of its legend."""
        if self._flat:
            return {"lighting": False, "ambient": 0.0, "diffuse": 1.0}
        gloss = self.material.gloss if self.options.colour == "crack" else 0.0
        specular = {"specular": gloss, "specular_power": 8 + 60 * gloss}
        return {"smooth_shading": True, "ambient": SCENE_STYLE.ambient, "diffuse": 1.0, **specular}

    def _add_narrow_cracks(self, grid: Any) -> None:
        width = SCENE_STYLE.min_opening
        lines = narrow_crack_lines(grid, width * pixel_width(self._plotter, self.options.size[1]))
        if lines is not None:
            colour = "#3a2a1c" if self.options.colour == "crack" else "black"
            self._plotter.add_mesh(lines, color=colour, line_width=width * self._line_scale, lighting=False)

    # --- surroundings ---

    def _add_floor(self, frame: FrameSource, parts: FrameParts) -> list[str]:
        """Add a floor with shadows; returns the names of the obstacles that the floor replaces.

        The floor lies at the most horizontal obstacle plane, or below everything if no plane is horizontal enough.
        """
        import pyvista

        planes = plane_normals(self._study)
        named = zip(frame.obstacle_files, frame.obstacle_names, strict=True)
        drawn_planes = [(file, name) for file, name in named if name in planes]
        floors = sorted(drawn_planes, key=lambda plane: -_vertical_component(planes[plane[1]]))[:1]
        floors = [plane for plane in floors if _vertical_component(planes[plane[1]]) > SCENE_STYLE.min_floor_level]
        centre = self._bounds.reshape(3, 2).mean(axis=1)
        normal, point = np.array([0.0, 0, 1]), np.array([*centre[:2], self._bounds[4]])
        if floors:
            normal = planes[floors[0][1]] / np.linalg.norm(planes[floors[0][1]])
            corners = np.asarray(pyvista.read(floors[0][0]).points, float)
            point = corners[np.argmax(corners @ normal)]
            point = centre - ((centre - point) @ normal) * normal
        _add_floor_disc(self._plotter, point, normal, self._size, self.material.backdrop)
        light = self._main_light_direction()
        # a light near the horizon would cast endless shadows
        light = light if light @ normal > 0.3 else normal
        for part in parts.surfaces:
            _add_shadow(self._plotter, part, point, normal, light, self._size, rgb(self.material.backdrop))
        return [name for _, name in floors]

    def _main_light_direction(self) -> Values:
        """Unit vector (3,) towards the main light."""
        camera = self._plotter.camera
        back = np.array(camera.position) - np.array(camera.focal_point)
        back /= np.linalg.norm(back)
        right = np.cross(camera.up, back)
        right /= np.linalg.norm(right)
        (x, y, z), _ = SCENE_STYLE.lamps[0]
        light = x * right + y * np.cross(back, right) + z * back
        return np.asarray(light / np.linalg.norm(light))

    def _add_lights(self) -> None:
        import pyvista

        plotter = self._plotter
        if self._flat:
            plotter.enable_anti_aliasing("ssaa")
            return
        for position, intensity in SCENE_STYLE.lamps:
            plotter.add_light(pyvista.Light(position=position, intensity=intensity, light_type="camera light"))
        plotter.enable_anti_aliasing("ssaa" if self.options.fine else "fxaa")
        radius, bias = SCENE_STYLE.occlusion_radius * self._size, 0.002 * self._size
        plotter.enable_ssao(radius=radius, bias=bias, kernel_size=64, blur=True)

    # --- text ---

    def _annotate(self, pixels: Pixels, frame: FrameSource, title: str | None) -> Pixels:
        """Picture with title, time, scale bar and legend, unless the options say `bare`."""
        options = self.options
        if options.bare:
            return pixels
        if title is None:
            title = options.title if options.title is not None else self._study.get("title", "")
        legend, keys = None, []
        if options.colour == "crack" and self.material == MATERIAL_LOOKS["plain"] and not self._flat:
            keys = [(self.material.boundary_colour, "boundary"), (self.material.crack_colour, "crack")]
        elif options.colour != "crack" and self.limits is not None:
            legend = ColourLegend(field_title(options.colour), self.limits)
        width = pixel_width(self._plotter, options.size[1])
        time = format_time(frame.t)
        if options.magnify != 1:
            time += f", displacements x {options.magnify:g}"
        return annotate(pixels, title=title, time=time, pixel=width, legend=legend, keys=keys)


def _vertical_component(normal: Values) -> float:
    """Vertical component of the unit vector along `normal` (3,): 1 for a floor, 0 for a wall."""
    return float(normal[2] / np.linalg.norm(normal))


def field_range(frame: FrameSource, colour: str) -> tuple[float, float] | None:
    """Range of the colours of a frame; None if there is nothing to show, or for colours without a range.

    Args:
        frame: the frame.
        colour: name of a field, or "crack".
    """
    if colour in ("crack", "piece"):
        return None
    grid = load_grid(frame)
    parts = frame_parts(grid)
    shown = [*parts.surfaces, *([parts.outline] if parts.outline is not None and colour == "age" else [])]
    arrays = [np.asarray(part[select_array(part, colour)], float) for part in shown]
    norms = [values if values.ndim == 1 else np.linalg.norm(values, axis=1) for values in arrays]
    return colour_range(np.concatenate(norms), signed=":" in colour)


def add_obstacles(plotter: Any, files: Iterable[Path], *, flat: bool) -> None:
    """Add the obstacles of a frame.

    Args:
        plotter: plotter of pyvista.
        files: VTU files of the obstacles.
        flat: the body is in 2D.
    """
    import pyvista

    for file in files:
        grid = pyvista.read(file)
        for cell_type in (VTK_TRIANGLE, VTK_LINE):
            cells = np.flatnonzero(grid.celltypes == cell_type)
            if not len(cells):
                continue
            style: dict[str, Any] = {"color": OBSTACLE_COLOUR}
            if cell_type == VTK_LINE:
                style = {"color": _OBSTACLE_EDGE_COLOUR, "line_width": 2}
            if not flat:
                style |= {"opacity": SCENE_STYLE.obstacle_opacity, "smooth_shading": True}
                style |= {"split_sharp_edges": True, "culling": "back"}
            plotter.add_mesh(grid.extract_cells(cells), lighting=not flat, **style)


def _add_floor_disc(plotter: Any, point: Values, normal: Values, size: float, colour: str) -> None:
    """Add a floor as large as the eye can see, of the colour of the backdrop.

    Args:
        plotter: plotter of pyvista.
        point: centre (3,), m.
        normal: unit normal (3,).
        size: diagonal of the bounds, m.
        colour: colour "#rrggbb".
    """
    import pyvista

    disc = pyvista.Disc(center=point, inner=0.0, outer=SCENE_STYLE.floor_radius * size, normal=normal, c_res=48)
    plotter.add_mesh(disc, color=colour, lighting=False, ambient=0.0, diffuse=1.0)


def _add_shadow(
    plotter: Any, surface: Any, point: Values, normal: Values, light: Values, size: float, floor_colour: Any
) -> None:
    """Add the shadow of a surface on the floor.

    Args:
        plotter: plotter of pyvista.
        surface: surface that casts the shadow.
        point: point (3,) of the floor, m.
        normal: unit normal (3,) of the floor.
        light: unit vector (3,) towards the light.
        size: diagonal of the bounds, m.
        floor_colour: red, green and blue of the floor.
    """
    height = (np.asarray(surface.points) - point) @ normal
    lift = SCENE_STYLE.shadow_height * size
    shadow = surface.copy(deep=False)
    shadow.clear_data()
    shadow.points = surface.points - ((height - lift) / (light @ normal))[:, None] * light
    if (height < 0).any():
        # parts below the floor cast no shadow on it
        faces = shadow.regular_faces
        above = faces[(height[faces] > -lift).all(axis=1)]
        if not len(above):
            return
        shadow = type(shadow).from_regular_faces(shadow.points, above)
    dark = "#{:02x}{:02x}{:02x}".format(*(int(SCENE_STYLE.shadow_brightness * part) for part in floor_colour))
    plotter.add_mesh(shadow, color=dark, lighting=False, ambient=0.0, diffuse=1.0)
