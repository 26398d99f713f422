"""Where the camera stands, and what of a body is worth seeing: debris that flew off is not."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from .frame_geometry import displace, without_single_nodes
from .frames import FrameSource, load_grid, plane_normals, read_study
from .obstacle_meshes import corners_near
from .picture_options import PictureOptions

Values = npt.NDArray[np.float64]
WORTH = 0.005  # of the points: the least piece that the camera looks for
ANGLE = np.radians(30.0)  # from the lowest to the highest that the camera sees
# shares of half a picture that may be filled to the right, left, top and bottom; the rest is for what is written
FILLED, LETTERED = (0.96, 0.96, 0.94, 0.94), (0.96, 0.96, 0.82, 0.78)


@dataclass(frozen=True)
class ViewBounds:
    """What is to be seen of some frames.

    Attributes:
        bounds: (6,) of its box, m.
        extents: (4,) how far it reaches to the right, left, top and bottom of the camera's axis, m, see `_sides`.
    """

    bounds: Values
    extents: Values

    @property
    def is_flat(self) -> bool:
        """A body in 2D."""
        return bool(self.bounds[4] == self.bounds[5])


def view_bounds(shot: FrameSource, look: PictureOptions) -> ViewBounds:
    """Of the large pieces of a frame, and of obstacles near them; in 3D not of planes, which have no end."""
    points = large_fragment_points(prepare_grid(shot, look))
    near = corners_near(points, shot.obstacle_files)
    flat = bool(np.ptp(points[:, 2]) == 0)
    planes = plane_normals(read_study(shot.folder)) if near and not flat else {}
    bodies = [
        near[file] for file, name in zip(shot.obstacle_files, shot.obstacle_names, strict=True) if name not in planes
    ]
    everything = np.concatenate([points, *near.values()])
    bounds = np.stack([everything.min(axis=0), everything.max(axis=0)], axis=1).reshape(-1)
    return ViewBounds(bounds, _sides(np.concatenate([points, *bodies]), look, flat))


def merge_bounds(scopes: Sequence[ViewBounds]) -> ViewBounds:
    """All of them."""
    every = np.stack([scope.bounds for scope in scopes])
    bounds = np.where(np.arange(6) % 2 == 0, every.min(axis=0), every.max(axis=0))
    return ViewBounds(bounds, np.max([scope.extents for scope in scopes], axis=0))


def large_fragment_points(grid: Any) -> Values:
    """(n, 3) points of the large pieces: those with half a hundredth or more of all points."""
    points = np.asarray(grid.points, float)
    if "piece" in grid.point_data:
        _, of_point, count = np.unique(grid.point_data["piece"], return_inverse=True, return_counts=True)
        points = points[count[of_point] >= min(WORTH * len(points), count.max())]
    return points


def prepare_grid(shot: FrameSource, look: PictureOptions) -> Any:
    """The grid of a frame as a look has it."""
    grid = load_grid(shot)
    return displace(grid if look.dust else without_single_nodes(grid), look.explode, look.magnify)


def aim_camera(plotter: Any, scope: ViewBounds, look: PictureOptions) -> None:
    """From where all of a scope is seen, as large as it may be.

    A point x, y to the right and upwards, z towards the camera is in a picture of spreads t (half its sides at a
    distance of 1) where |x - x_c| <= t_x (D - z), of the camera at x_c, y_c, D: linear in what is sought, so that
    max(x + t_x z) and max(-x + t_x z) over all points say the least D, and then the middle of the places x_c.
    Parallel rays: D is half of what is seen upwards, without z.
    """
    axes, spreads = _axes(look, scope.is_flat), _spreads(look, scope.is_flat)
    far = float((scope.extents.reshape(2, 2).sum(axis=1) / spreads.reshape(2, 2).sum(axis=1)).max())
    room = spreads * far - scope.extents
    across = (room[1::2] - room[::2]) / 2
    depth = float(axes[2] @ scope.bounds.reshape(3, 2).mean(axis=1))
    focus = across @ axes[:2] + depth * axes[2]
    camera = plotter.camera
    camera.focal_point, camera.up = focus, axes[1]
    camera.position = focus + (far if scope.is_flat else far - depth) * axes[2]
    camera.view_angle = np.degrees(ANGLE)
    camera.parallel_projection = scope.is_flat
    camera.parallel_scale = far
    camera.zoom(look.zoom)
    plotter.reset_camera_clipping_range()


def _sides(points: Values, look: PictureOptions, flat: bool) -> Values:
    """(4,) max of x + t z, -x + t z, y + t z, -y + t z, each with its own spread t, m."""
    x, y, z = _axes(look, flat) @ points.T
    lean = np.zeros(4) if flat else _spreads(look, flat)
    return np.array([(each + t * z).max() for each, t in zip((x, -x, y, -y), lean, strict=True)])


def _axes(look: PictureOptions, flat: bool) -> Values:
    """(3, 3) to the right, upwards and towards the camera."""
    back = np.array([0.0, 0, 1]) if flat else np.asarray(look.view_direction(), float)
    back /= np.linalg.norm(back)
    right = np.cross([0.0, 1, 0] if flat or abs(back[2]) == 1 else [0.0, 0, 1], back)
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(back, right), back])


def _spreads(look: PictureOptions, flat: bool) -> Values:
    """(4,) to the right, left, top and bottom: half of a picture's side that may be filled, at a distance of 1."""
    shares = np.array(FILLED if look.bare else LETTERED)
    shares[:2] *= look.size[0] / look.size[1]
    return shares * (1.0 if flat else np.tan(ANGLE / 2))


def pixel_width(plotter: Any, height: int) -> float:
    """m that a pixel is wide in the middle of the body, in a picture of `height` pixels."""
    camera = plotter.camera
    if camera.parallel_projection:
        return float(2 * camera.parallel_scale / height)
    return float(2 * camera.distance * np.tan(np.radians(camera.view_angle) / 2) / height)
