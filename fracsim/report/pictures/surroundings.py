"""Surroundings of a body in 3D: obstacles, opaque unless they hide the body, and a floor."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from .colour_maps import rgb
from .shadows import DepthWindow

Values = npt.NDArray[np.float64]

OBSTACLE_COLOUR, PLANE_COLOUR, _OBSTACLE_EDGE_COLOUR = "#c2b393", "#e6dfd0", "#6e6350"


@dataclass(frozen=True)
class SurroundingsStyle:
    """Appearance of obstacles and floor. Lengths are shares of the diagonal of the bounds.

    Attributes:
        max_hidden_share: an obstacle that hides more of the body, as a share of the body's pixels, is translucent.
        opacity: opacity of a translucent obstacle.
        ambient: ambient light on obstacles.
        gloss: specular light on obstacles.
        min_floor_level: least vertical component of the unit normal of a plane that serves as floor.
        floor_radius: radius of the floor.
        shadow_brightness: brightness of a shadow, as a share of that of the floor.
        near_brightness: brightness of the floor below the body, as a share of that of the backdrop.
        near_radius: distance over which the floor becomes as bright as the backdrop.
    """

    max_hidden_share: float = 0.5
    opacity: float = 0.4
    ambient: float = 0.26
    gloss: float = 0.2
    min_floor_level: float = 0.5
    floor_radius: float = 40.0
    shadow_brightness: float = 0.8
    near_brightness: float = 0.9
    near_radius: float = 1.2


SURROUNDINGS_STYLE = SurroundingsStyle()


@dataclass(frozen=True)
class Floor:
    """Floor of a picture.

    Attributes:
        surface: disc as large as the eye can see.
        normal: unit normal (3,).
        plane: name of the obstacle that the floor replaces; "" if there is none.
    """

    surface: Any
    normal: Values
    plane: str


def find_floor(obstacles: Mapping[str, Any], normals: Mapping[str, Values], bounds: Values) -> Floor:
    """Floor at the most horizontal obstacle plane, or below everything if no plane is horizontal enough.

    Args:
        obstacles: surfaces of the obstacles, by name.
        normals: normals (3,) of those that are planes, by name.
        bounds: bounding box (6,) x, x, y, y, z, z, m.
    """
    import pyvista

    levels = {name: float(n[2] / np.linalg.norm(n)) for name, n in normals.items() if name in obstacles}
    plane = max(levels, key=lambda name: levels[name], default="")
    box = bounds.reshape(3, 2)
    centre, size = box.mean(axis=1), float(np.linalg.norm(np.diff(box)))
    if plane and levels[plane] > SURROUNDINGS_STYLE.min_floor_level:
        normal = normals[plane] / np.linalg.norm(normals[plane])
        level = float((np.asarray(obstacles[plane].points, float) @ normal).max())
        point = centre + (level - centre @ normal) * normal
    else:
        plane, normal, point = "", np.array([0.0, 0.0, 1.0]), np.array([*centre[:2], box[2, 0]])
    surface = pyvista.Disc(center=point, inner=0.0, outer=1.0, normal=normal, r_res=48, c_res=48)
    offset = np.asarray(surface.points, float) - point
    distance = np.linalg.norm(offset, axis=1)
    # rings are close to one another near the body, where the brightness changes
    surface.points = point + offset * (SURROUNDINGS_STYLE.floor_radius * size * distance**3)[:, None]
    share = distance**4 * SURROUNDINGS_STYLE.floor_radius / SURROUNDINGS_STYLE.near_radius
    surface.point_data["brightness"] = 1 - (1 - SURROUNDINGS_STYLE.near_brightness) * np.exp(-(share**2))
    return Floor(surface, normal, plane)


def obstacle_surface(file: Path) -> Any:
    """Triangles of the obstacle in a VTU file."""
    import pyvista

    grid = pyvista.read(file)
    return grid.extract_cells(np.flatnonzero(grid.celltypes == pyvista.CellType.TRIANGLE)).extract_surface()


def hiding_obstacles(
    window: DepthWindow, camera: Any, body: Sequence[Any], obstacles: Mapping[str, Any]
) -> frozenset[str]:
    """Names of the obstacles that hide more than a share of the body from the camera.

    Args:
        window: window for depth images.
        camera: camera of the picture, with clipping planes around all that is drawn.
        body: surfaces of the body.
        obstacles: surfaces of the obstacles, by name.
    """
    if not obstacles:
        return frozenset()
    window.set_surfaces(body)
    body_depth = window.depth_from(camera).depth
    is_body = body_depth < 1.0
    hiding = set()
    for name, surface in obstacles.items():
        window.set_surfaces([], [surface])
        hidden = is_body & (window.depth_from(camera).depth < body_depth)
        if hidden.sum() > SURROUNDINGS_STYLE.max_hidden_share * is_body.sum():
            hiding.add(name)
    return frozenset(hiding)


def add_obstacle(plotter: Any, surface: Any, *, is_plane: bool) -> Any:
    """Add an opaque obstacle in 3D, without the faces that are turned away from the camera; returns its actor."""
    return plotter.add_mesh(
        surface,
        color=PLANE_COLOUR if is_plane else OBSTACLE_COLOUR,
        ambient=SURROUNDINGS_STYLE.ambient,
        diffuse=1.0,
        specular=0.0 if is_plane else SURROUNDINGS_STYLE.gloss,
        specular_power=20,
        smooth_shading=True,
        split_sharp_edges=True,
        culling="back",
    )


def make_translucent(actor: Any) -> None:
    """Let the body be seen through an obstacle."""
    actor.prop.opacity = SURROUNDINGS_STYLE.opacity


def add_floor(plotter: Any, floor: Floor, colour: str) -> None:
    """Add a floor, a little darker than the backdrop below the body and of its colour "#rrggbb" far away.

    The light does not change its colour.
    """
    floor.surface.point_data["rgb"] = _floor_colours(floor, colour, 1.0)
    plotter.add_mesh(floor.surface, scalars="rgb", rgb=True, lighting=False, ambient=0.0, diffuse=1.0)


def darken_floor(floor: Floor, colour: str) -> None:
    """Give a floor that has been added, of this colour "#rrggbb", the brightness of its shadows."""
    floor.surface.point_data["rgb"][:] = _floor_colours(floor, colour, SURROUNDINGS_STYLE.shadow_brightness)
    floor.surface.Modified()


def _floor_colours(floor: Floor, colour: str, brightness: float) -> npt.NDArray[np.uint8]:
    """Colours (points, 3) of a floor at a brightness of 0 to 1."""
    shares = brightness * np.asarray(floor.surface.point_data["brightness"])[:, None]
    return np.asarray(np.rint(shares * rgb(colour)), np.uint8)


def add_flat_obstacle(plotter: Any, file: Path) -> None:
    """Add an obstacle in 2D: its area and its outline."""
    import pyvista

    grid = pyvista.read(file)
    styles: dict[Any, dict[str, Any]] = {
        pyvista.CellType.TRIANGLE: {"color": OBSTACLE_COLOUR},
        pyvista.CellType.LINE: {"color": _OBSTACLE_EDGE_COLOUR, "line_width": 2},
    }
    for cell_type, style in styles.items():
        cells = np.flatnonzero(grid.celltypes == cell_type)
        if len(cells):
            plotter.add_mesh(grid.extract_cells(cells), lighting=False, **style)
