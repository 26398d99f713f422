"""Where the camera stands, and what of a body is worth seeing: debris that flew off is not."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from .body import moved, without_dust
from .look import Look
from .obstacles import with_obstacles
from .shots import Shot, load

Values = npt.NDArray[np.float64]
WORTH = 0.005  # of the points: the least piece that the camera looks for
FILLED = 0.9  # of the picture, by the box of what is to be seen: the rest is for what is written


def worth_seeing(grid: Any) -> Values:
    """(6,) bounds of the large pieces: those with half a hundredth or more of the points."""
    points = np.asarray(grid.points, float)
    if "piece" in grid.point_data:
        _, of_point, count = np.unique(grid.point_data["piece"], return_inverse=True, return_counts=True)
        points = points[count[of_point] >= min(WORTH * len(points), count.max())]
    return np.stack([points.min(axis=0), points.max(axis=0)], axis=1).reshape(-1)


def bounds_of(shot: Shot, look: Look) -> Values:
    """(6,) what is worth seeing of a frame, m."""
    return with_obstacles(worth_seeing(drawn_of(shot, look)), shot.beside)


def drawn_of(shot: Shot, look: Look) -> Any:
    """The grid of a frame as a look has it."""
    grid = load(shot)
    return moved(grid if look.dust else without_dust(grid), look.explode, look.magnify)


def union(bounds: Sequence[Values]) -> Values:
    """(6,) of all of them."""
    every = np.stack(bounds)
    return np.where(np.arange(6) % 2 == 0, every.min(axis=0), every.max(axis=0))


def is_flat(bounds: Values) -> bool:
    """A body in 2D."""
    return bool(bounds[4] == bounds[5])


def aim(plotter: Any, bounds: Values, look: Look) -> None:
    """So that all of the bounds is seen."""
    flat = is_flat(bounds)
    if flat:
        plotter.view_xy()
        plotter.enable_parallel_projection()
    else:
        plotter.camera_position = [look.direction(), (0, 0, 0), (0, 0, 1)]
    plotter.reset_camera(bounds=bounds)
    plotter.camera.zoom(look.zoom * FILLED / _reach(plotter.camera, bounds, look.size[0] / look.size[1]))


def _reach(camera: Any, bounds: Values, aspect: float) -> float:
    """How far the corners of a box are from the middle of the picture, as a share of its half."""
    corners = np.stack(np.meshgrid(*bounds.reshape(3, 2), indexing="ij"), axis=-1).reshape(-1, 3)
    back = np.array(camera.position) - np.array(camera.focal_point)
    distance = float(np.linalg.norm(back))
    back /= distance
    right = np.cross(camera.up, back)
    right /= np.linalg.norm(right)
    arms = corners - np.array(camera.focal_point)
    across = np.stack([arms @ right / aspect, arms @ np.cross(back, right)])
    if camera.parallel_projection:
        return float(np.abs(across).max() / camera.parallel_scale)
    depth = (distance - arms @ back) * np.tan(np.radians(camera.view_angle) / 2)
    return float(np.abs(across / depth).max())


def pixel(plotter: Any, height: int) -> float:
    """m that a pixel is wide in the middle of the body, in a picture of `height` pixels."""
    camera = plotter.camera
    if camera.parallel_projection:
        return float(2 * camera.parallel_scale / height)
    return float(2 * camera.distance * np.tan(np.radians(camera.view_angle) / 2) / height)
