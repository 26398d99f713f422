"""Camera of a picture: the part of the body to show, and the position from which all of it is seen.

Fragments that flew off are too small to be considered.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from .frames import FrameSource, displace, load_grid, plane_normals, read_study, without_single_nodes
from .picture_options import PictureOptions

Values = npt.NDArray[np.float64]


@dataclass(frozen=True)
class CameraSettings:
    """Settings of the camera.

    Attributes:
        view_angle: vertical angle of view, degrees.
        min_fragment_share: least share of all points of a fragment that the camera shows.
        filled: shares of half a picture that may be filled to the right, left, top and bottom, without text.
        filled_with_text: the same with text at the top and bottom.
        obstacle_margin: share of the body's diagonal within which obstacles are shown on each side.
    """

    view_angle: float = 30.0
    min_fragment_share: float = 0.005
    filled: tuple[float, ...] = (0.96, 0.96, 0.94, 0.94)
    filled_with_text: tuple[float, ...] = (0.96, 0.96, 0.82, 0.78)
    obstacle_margin: float = 0.25


CAMERA = CameraSettings()


@dataclass(frozen=True)
class ViewBounds:
    """Part of space that pictures show.

    Attributes:
        bounds: bounding box (6,) x, x, y, y, z, z, m.
        extents: extents (4,) to the right, left, top and bottom of the camera's axis, m, see `_extents`.
    """

    bounds: Values
    extents: Values

    @property
    def is_flat(self) -> bool:
        """True for a body in 2D."""
        return bool(self.bounds[4] == self.bounds[5])


def view_bounds(frame: FrameSource, options: PictureOptions) -> ViewBounds:
    """Bounds of the large fragments of a frame and of obstacles near them; in 3D without planes, which are infinite."""
    points = large_fragment_points(prepare_grid(frame, options))
    near = corners_near(points, frame.obstacle_files)
    flat = bool(np.ptp(points[:, 2]) == 0)
    planes = plane_normals(read_study(frame.folder)) if near and not flat else {}
    named = zip(frame.obstacle_files, frame.obstacle_names, strict=True)
    obstacles = [near[file] for file, name in named if name not in planes]
    everything = np.concatenate([points, *near.values()])
    bounds = np.stack([everything.min(axis=0), everything.max(axis=0)], axis=1).reshape(-1)
    return ViewBounds(bounds, _extents(np.concatenate([points, *obstacles]), options, flat))


def corners_near(points: Values, files: Iterable[Path]) -> dict[Path, Values]:
    """Points (n, 3) of each obstacle, m, clipped to the bounding box of the body enlarged by a margin.

    Args:
        points: points (n, 3) of the body, m.
        files: VTU files of the obstacles.
    """
    import pyvista

    lower, upper = points.min(axis=0), points.max(axis=0)
    # no margin across a flat body
    margin = CAMERA.obstacle_margin * float(np.linalg.norm(upper - lower)) * (upper > lower)
    return {
        file: np.clip(np.asarray(pyvista.read(file).points, float), lower - margin, upper + margin) for file in files
    }


def body_motion(frame: FrameSource, options: PictureOptions) -> Values:
    """Median displacement (3,) of the points of the large fragments of a frame, m.

    Pieces that fly off do not shift it, nor do the points that new cracks add, unlike the median of the points.
    """
    grid = prepare_grid(frame, options)
    is_large = flag_large_fragments(grid)
    motion = np.asarray(grid.points, float) - np.asarray(grid.point_data.get("rest", 0.0))
    return np.asarray(np.median(motion[is_large], axis=0))


def moved(view: ViewBounds, shift: Values, options: PictureOptions) -> ViewBounds:
    """Bounds moved by `shift` (3,), m."""
    return ViewBounds(view.bounds + np.repeat(shift, 2), view.extents + _extents(shift[None], options, view.is_flat))


def centred(view: ViewBounds, target: Values, options: PictureOptions) -> ViewBounds:
    """Bounds enlarged so that the point `target` (3,), m, is at the centre of the picture."""
    of_target = _extents(target[None], options, view.is_flat)
    # to the right and left alike, and so to the top and bottom
    reach = (view.extents - of_target).reshape(2, 2).max(axis=1).repeat(2)
    return ViewBounds(view.bounds, of_target + reach)


def merge_bounds(views: Sequence[ViewBounds]) -> ViewBounds:
    """Bounds that contain those of several frames."""
    bounds = np.stack([view.bounds for view in views])
    box = np.where(np.arange(6) % 2 == 0, bounds.min(axis=0), bounds.max(axis=0))
    return ViewBounds(box, np.max([view.extents for view in views], axis=0))


def large_fragment_points(grid: Any) -> Values:
    """Points (n, 3) of the fragments that are large enough to be shown, m."""
    return np.asarray(grid.points, float)[flag_large_fragments(grid)]


def flag_large_fragments(grid: Any) -> npt.NDArray[np.bool_]:
    """Flag the points (points,) of the fragments that are large enough to be shown."""
    if "piece" not in grid.point_data:
        return np.ones(grid.n_points, bool)
    _, of_point, count = np.unique(grid.point_data["piece"], return_inverse=True, return_counts=True)
    return np.asarray(count[of_point] >= min(CAMERA.min_fragment_share * grid.n_points, count.max()))


def prepare_grid(frame: FrameSource, options: PictureOptions) -> Any:
    """Grid of a frame as the options ask for it."""
    grid = load_grid(frame)
    return displace(grid if options.dust else without_single_nodes(grid), options.explode, options.magnify)


def aim_camera(plotter: Any, view: ViewBounds, options: PictureOptions) -> None:
    """Place the camera where it sees all of the bounds, as large as possible.

    Let x and y be coordinates to the right and upwards, z towards the camera, and t half the filled side of a picture
    at unit distance. A point is inside the picture if |x - x_c| <= t_x (D - z), with the camera at x_c, y_c, D. This is
    linear in the unknowns, so that max(x + t_x z) and max(-x + t_x z) over all points give the least D, and then x_c as
    the middle of the admissible interval. With parallel projection D is half the visible height, without z.

    Args:
        plotter: plotter of pyvista.
        view: bounds to show.
        options: direction, zoom and size of the picture.
    """
    axes, half_sides = camera_axes(options, view.is_flat), _half_sides(options, view.is_flat)
    distance = float((view.extents.reshape(2, 2).sum(axis=1) / half_sides.reshape(2, 2).sum(axis=1)).max())
    slack = half_sides * distance - view.extents
    centre = (slack[1::2] - slack[::2]) / 2
    depth = float(axes[2] @ view.bounds.reshape(3, 2).mean(axis=1))
    focus = centre @ axes[:2] + depth * axes[2]
    camera = plotter.camera
    camera.focal_point, camera.up = focus, axes[1]
    camera.position = focus + (distance if view.is_flat else distance - depth) * axes[2]
    camera.view_angle = CAMERA.view_angle
    camera.parallel_projection = view.is_flat
    camera.parallel_scale = distance
    camera.zoom(options.zoom)
    plotter.reset_camera_clipping_range()


def _extents(points: Values, options: PictureOptions, flat: bool) -> Values:
    """Maxima (4,) of x + t z, -x + t z, y + t z, -y + t z over points (n, 3), m; see `aim_camera`."""
    x, y, z = camera_axes(options, flat) @ points.T
    half_sides = np.zeros(4) if flat else _half_sides(options, flat)
    return np.array([(side + t * z).max() for side, t in zip((x, -x, y, -y), half_sides, strict=True)])


def camera_axes(options: PictureOptions, flat: bool) -> Values:
    """Unit vectors (3, 3) to the right, upwards and towards the camera."""
    back = np.array([0.0, 0, 1]) if flat else np.asarray(options.view_direction(), float)
    back /= np.linalg.norm(back)
    right = np.cross([0.0, 1, 0] if flat or abs(back[2]) == 1 else [0.0, 0, 1], back)
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(back, right), back])


def _half_sides(options: PictureOptions, flat: bool) -> Values:
    """Filled half sides (4,) of a picture to the right, left, top and bottom, at unit distance."""
    shares = np.array(CAMERA.filled if options.bare else CAMERA.filled_with_text)
    shares[:2] *= options.size[0] / options.size[1]
    return shares * (1.0 if flat else np.tan(np.radians(CAMERA.view_angle) / 2))


def pixel_width(plotter: Any, height: int) -> float:
    """Width of a pixel at the centre of the body in a picture of `height` pixels, m."""
    camera = plotter.camera
    if camera.parallel_projection:
        return float(2 * camera.parallel_scale / height)
    return float(2 * camera.distance * np.tan(np.radians(camera.view_angle) / 2) / height)
