"""Renderer: lights, camera, body and surroundings of a frame, drawn to an array of pixels.

A crack that opens by less than a pixel is drawn as a line where it meets the boundary.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

import numpy as np
import numpy.typing as npt

from ..plots import readable_unit
from .annotations import ColourLegend, annotate, format_time
from .camera import ViewBounds, aim_camera, camera_axes, pixel_width, prepare_grid
from .colour_maps import colour_range, field_title, field_unit, map_colours, select_array
from .frames import (
    FrameParts,
    FrameSource,
    frame_parts,
    is_crack,
    load_grid,
    plane_normals,
    read_study,
    with_normals,
)
from .picture_options import MATERIAL_LOOKS, PictureOptions, material_look
from .shadows import SHADOW_STYLE, DepthWindow, lamp_camera, lamp_directions, shadow_shares
from .surroundings import (
    Floor,
    add_flat_obstacle,
    add_floor,
    add_obstacle,
    darken_floor,
    find_floor,
    hiding_obstacles,
    make_translucent,
    obstacle_surface,
)

Ints = npt.NDArray[np.int64]
Values = npt.NDArray[np.float64]
Pixels = npt.NDArray[np.uint8]


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
        shadow_light: share of the main light that shadows have, as reflected by the surroundings.
        min_light_level: least component of the direction of the main light along the normal of a floor.
    """

    lamps: tuple[tuple[tuple[float, float, float], float], ...] = (
        ((-1.0, 1.1, 1.2), 0.68), ((1.2, -0.3, 1.2), 0.42), ((0.3, 1.5, -1.2), 0.3),
    )  # fmt: skip
    ambient: float = 0.26
    occlusion_radius: float = 0.05
    supersampling: int = 2
    min_opening: float = 1.5
    point_tolerance: float = 1e-7
    shadow_light: float = 0.4
    min_light_level: float = 0.3


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
        self, options: PictureOptions, view: ViewBounds, limits: tuple[float, float] | None, folder: Path
    ) -> None:
        """Open a window off-screen.

        Args:
            options: options of the picture.
            view: bounds of the first frame to show.
            limits: range of the colours, see `field_range`.
            folder: output folder of the first frame, whose study has a title, a look and planes.
        """
        import pyvista

        self.options, self.limits, self._flat, self._bounds = options, limits, view.is_flat, view.bounds
        self._size = float(np.linalg.norm(np.diff(view.bounds.reshape(3, 2))))
        # window pixels per pixel of the picture
        self._line_scale = SCENE_STYLE.supersampling if options.fine else 1
        self._plotter = pyvista.Plotter(off_screen=True, window_size=options.size, lighting="none")
        self._use_study(folder)
        self._main_light = self._add_lights()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._plotter.close()

    def render_frame(self, frame: FrameSource, view: ViewBounds, title: str | None = None) -> Pixels:
        """Picture (height, width, 3) of a frame that shows the bounds; `title` replaces that of the options."""
        plotter, options = self._plotter, self.options
        self._bounds = view.bounds
        if frame.folder != self._folder:
            self._use_study(frame.folder)
        # otherwise everything is drawn again with each addition
        plotter.suppress_rendering = True
        plotter.clear_actors()
        # first: the width of narrow cracks is in pixels
        aim_camera(plotter, view, options)
        grid = prepare_grid(frame, options)
        parts = frame_parts(grid)
        self._add_body(parts)
        if self._flat:
            for file in frame.obstacle_files:
                add_flat_obstacle(plotter, file)
            pixels = self._draw_pixels()
        else:
            self._add_narrow_cracks(grid)
            pixels = self._draw_with_surroundings(frame, parts.surfaces)
        return self._annotate(pixels, frame, title)

    def _use_study(self, folder: Path) -> None:
        """Take title, look and planes of the study in an output folder."""
        self._folder, self._study = folder, read_study(folder)
        self.material = material_look(self.options.material or self._study.get("output", {}).get("look", "plain"))
        self._plotter.set_background(MATERIAL_LOOKS["plain"].backdrop if self._flat else self.material.backdrop)

    def _draw_pixels(self) -> Pixels:
        """Picture (height, width, 3) of what has been added, without text."""
        plotter = self._plotter
        plotter.reset_camera_clipping_range()
        plotter.suppress_rendering = False
        plotter.render()
        return np.asarray(plotter.screenshot(return_img=True))[..., :3]

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

    def _draw_with_surroundings(self, frame: FrameSource, body: list[Any]) -> Pixels:
        """Picture (height, width, 3) with floor, obstacles and shadows; `body` are the surfaces of the body."""
        plotter, planes = self._plotter, plane_normals(self._study)
        named = zip(frame.obstacle_files, frame.obstacle_names, strict=True)
        obstacles = {name: obstacle_surface(file) for file, name in named}
        floor = find_floor(obstacles, planes, self._bounds) if self.options.floor else None
        if floor is None and not obstacles:
            return self._draw_pixels()
        if floor is not None:
            obstacles.pop(floor.plane, None)
            add_floor(plotter, floor, self.material.backdrop)
        actors = {name: add_obstacle(plotter, obstacles[name], is_plane=name in planes) for name in obstacles}
        lit = self._draw_pixels()
        with DepthWindow(*self.options.size) as window:
            for name in hiding_obstacles(window, plotter.camera, body, obstacles):
                make_translucent(actors[name])
                del obstacles[name]
            lit = self._draw_pixels() if len(obstacles) < len(actors) else lit
            self._main_light.intensity *= SCENE_STYLE.shadow_light
            if floor is not None:
                darken_floor(floor, self.material.backdrop)
            shaded = self._draw_pixels()
            self._main_light.intensity /= SCENE_STYLE.shadow_light
            window.set_surfaces(body if floor is None else [*body, floor.surface], [*obstacles.values()])
            view_depth = window.depth_from(plotter.camera)
            is_floor = np.zeros(view_depth.depth.shape, bool)
            if floor is not None:
                window.set_surfaces([floor.surface])
                is_floor = window.depth_from(plotter.camera).depth <= view_depth.depth
        # a plane has no edge, but its slab has: it casts no shadow
        casters = [surface for name, surface in obstacles.items() if name not in planes]
        centre, radius = self._bounds.reshape(3, 2).mean(axis=1), self._size / 2
        with DepthWindow(SHADOW_STYLE.map_side, SHADOW_STYLE.map_side) as maps:
            maps.set_surfaces(body, casters)
            cameras = [lamp_camera(ray, centre, radius) for ray in lamp_directions(self._light_direction(floor))]
            # rows of depth images begin at the lower edge
            share = shadow_shares(view_depth, maps, cameras, np.any(lit != shaded, axis=2)[::-1])
            if floor is not None:
                sky = [
                    lamp_camera(ray, centre, radius) for ray in lamp_directions(floor.normal, SHADOW_STYLE.sky_radius)
                ]
                hidden = shadow_shares(view_depth, maps, sky, is_floor)
                share = 1.0 - (1.0 - share) * (1.0 - SHADOW_STYLE.sky_share * hidden)
        share = share[::-1, :, None]
        return np.asarray(np.rint((1.0 - share) * lit + share * shaded), np.uint8)

    def _light_direction(self, floor: Floor | None) -> Values:
        """Unit vector (3,) towards the main light, or towards the sky if a floor would have endless shadows."""
        light = np.array(SCENE_STYLE.lamps[0][0]) @ camera_axes(self.options, self._flat)
        light /= np.linalg.norm(light)
        return light if floor is None or light @ floor.normal > SCENE_STYLE.min_light_level else floor.normal

    def _add_lights(self) -> Any:
        """Add lights and filters; returns the main light, None in 2D."""
        import pyvista

        plotter = self._plotter
        if self._flat:
            plotter.enable_anti_aliasing("ssaa")
            return None
        lights = [
            pyvista.Light(position=position, intensity=intensity, light_type="camera light")
            for position, intensity in SCENE_STYLE.lamps
        ]
        for light in lights:
            plotter.add_light(light)
        plotter.enable_anti_aliasing("ssaa" if self.options.fine else "fxaa")
        radius, bias = SCENE_STYLE.occlusion_radius * self._size, 0.002 * self._size
        plotter.enable_ssao(radius=radius, bias=bias, kernel_size=64, blur=True)
        return lights[0]

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
            unit, size = readable_unit(field_unit(options.colour), max(map(abs, self.limits)))
            low, high = self.limits
            legend = ColourLegend(field_title(options.colour, unit), (low / size, high / size))
        width = pixel_width(self._plotter, options.size[1])
        time = format_time(frame.t)
        if options.magnify != 1:
            time += f", displacements x {options.magnify:g}"
        # components of the unit vectors x, y, z to the right and upwards
        axes = camera_axes(options, self._flat)[:2].T[: 2 if self._flat else 3] if options.axes else None
        return annotate(pixels, title=title, time=time, pixel=width, legend=legend, keys=keys, axes=axes)


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
