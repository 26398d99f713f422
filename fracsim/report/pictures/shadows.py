"""Shadows of the main light: depth maps from points of the lamp, compared with what the pixels show.

VTK's own shadow pass is not used: its maps cover all that is drawn, here also the floor, and all lights cast shadows.
Source: Williams, Casting curved shadows on curved surfaces, 1978; the lamp is a disc as in Heckbert and Herf, 1997.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
import numpy.typing as npt

Values = npt.NDArray[np.float64]


@dataclass(frozen=True)
class ShadowStyle:
    """Lamp and depth maps of shadows.

    Attributes:
        lamp_samples: points of the lamp, each with a depth map.
        lamp_radius: radius of the lamp at unit distance: shadows are sharp near what casts them and soft far from it.
        sky_radius: radius at unit distance of the part of the sky that a floor sees.
        sky_share: share of the shadow that a floor has where all of that sky is hidden.
        map_side: side of a depth map, pixels.
        offset: points nearer than this behind a surface are lit, as a share of the radius of the sphere of casters.
    """

    lamp_samples: int = 24
    lamp_radius: float = 0.035
    sky_radius: float = 1.2
    sky_share: float = 0.6
    map_side: int = 768
    offset: float = 0.012


SHADOW_STYLE = ShadowStyle()


@dataclass(frozen=True)
class DepthImage:
    """Depth of what a camera sees.

    Attributes:
        depth: (height, width) from the lower edge upwards, -1 at the near and 1 at the far clipping plane.
        projection: (4, 4) homogeneous coordinates in space, m, to coordinates in [-1, 1] to the right, upwards and away
            from the camera.
    """

    depth: Values
    projection: Values

    def points_at(self, rows: npt.NDArray[np.integer], columns: npt.NDArray[np.integer]) -> Values:
        """Points (3, n) in space, m, that n pixels show."""
        height, width = self.depth.shape
        x, y = (2.0 * columns + 1.0) / width - 1.0, (2.0 * rows + 1.0) / height - 1.0
        points = np.linalg.inv(self.projection) @ np.stack([x, y, self.depth[rows, columns], np.ones(len(rows))])
        return np.asarray(points[:3] / points[3])


class DepthWindow:
    """Window that draws depth alone. As a context manager it closes the window of the driver."""

    def __init__(self, width: int, height: int) -> None:
        """Open a window off-screen of this size in pixels."""
        import pyvista

        self._plotter = pyvista.Plotter(off_screen=True, window_size=(width, height), lighting="none")
        self._plotter.render_window.SetMultiSamples(0)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._plotter.close()

    def set_surfaces(self, surfaces: Sequence[Any], one_sided: Sequence[Any] = ()) -> None:
        """Replace what is drawn by surfaces, seen from both sides, and by others that are seen from outside alone."""
        plotter = self._plotter
        plotter.suppress_rendering = True
        plotter.clear_actors()
        for surface in surfaces:
            plotter.add_mesh(surface, color="white", lighting=False)
        for surface in one_sided:
            plotter.add_mesh(surface, color="white", lighting=False, culling="back")
        plotter.suppress_rendering = False

    def depth_from(self, camera: Any) -> DepthImage:
        """Depth image from a camera of pyvista, with its clipping planes."""
        from vtkmodules.util.numpy_support import vtk_to_numpy
        from vtkmodules.vtkRenderingCore import vtkWindowToImageFilter

        plotter = self._plotter
        plotter.renderer.SetActiveCamera(camera)
        # pyvista's own call draws nothing before the first picture
        plotter.render_window.Render()
        reader = vtkWindowToImageFilter()
        reader.SetInput(plotter.render_window)
        reader.SetInputBufferTypeToZBuffer()
        reader.ReadFrontBufferOff()
        reader.ShouldRerenderOff()
        reader.Update()
        width, height = plotter.window_size
        depth = 2.0 * vtk_to_numpy(reader.GetOutput().GetPointData().GetScalars()).reshape(height, width) - 1.0
        return DepthImage(depth, projection_matrix(camera, width / height))


def projection_matrix(camera: Any, aspect: float) -> Values:
    """Projection (4, 4) of a camera, see `DepthImage`; `aspect` is width over height of its window."""
    matrix = camera.GetCompositeProjectionTransformMatrix(aspect, -1.0, 1.0)
    return np.array([[matrix.GetElement(row, column) for column in range(4)] for row in range(4)])


def lamp_directions(direction: Values, lamp_radius: float = SHADOW_STYLE.lamp_radius) -> Values:
    """Unit vectors (n, 3) towards points of a lamp, spread evenly over its disc.

    Args:
        direction: unit vector (3,) towards the centre of the lamp.
        lamp_radius: radius of the disc at unit distance.
    """
    count = SHADOW_STYLE.lamp_samples
    across = np.linalg.svd(direction[None])[2][1:]
    number = np.arange(count)
    angle = number * np.pi * (3.0 - np.sqrt(5.0))
    radius = lamp_radius * np.sqrt((number + 0.5) / count)
    spread = radius[:, None] * (np.cos(angle)[:, None] * across[0] + np.sin(angle)[:, None] * across[1])
    directions = direction + spread
    return np.asarray(directions / np.linalg.norm(directions, axis=1, keepdims=True))


def lamp_camera(direction: Values, centre: Values, radius: float) -> Any:
    """Camera with parallel projection that looks along a ray of light at a sphere.

    Args:
        direction: unit vector (3,) towards the light.
        centre: centre (3,) of the sphere, m.
        radius: radius of the sphere, m.
    """
    import pyvista

    camera = pyvista.Camera()
    camera.focal_point = centre
    camera.position = centre + 2.0 * radius * direction
    camera.up = np.eye(3)[np.argmin(np.abs(direction))]
    camera.parallel_projection = True
    camera.parallel_scale = radius
    camera.clipping_range = (radius, 3.0 * radius)
    return camera


def shadow_shares(
    seen: DepthImage, maps: DepthWindow, cameras: Sequence[Any], reached: npt.NDArray[np.bool_]
) -> Values:
    """Share (height, width) of the lamp that is hidden from the point that each pixel shows, 0 (lit) to 1.

    Points outside of the depth maps are lit, as nothing casts a shadow on them.

    Args:
        seen: depth image of the camera of the picture.
        maps: window of the depth maps, with what casts shadows.
        cameras: cameras of the depth maps, see `lamp_camera`.
        reached: pixels (height, width) to consider; others are 0.
    """
    share = np.zeros(seen.depth.shape)
    shown = np.nonzero(reached & (seen.depth < 1.0))
    points = seen.points_at(*shown)
    hits = np.zeros(len(shown[0]))
    for camera in cameras:
        lamp = maps.depth_from(camera)
        height, width = lamp.depth.shape
        right, up, depth = lamp.projection[:3, :3] @ points + lamp.projection[:3, 3:]
        column, row = ((right + 1.0) * (width / 2.0)).astype(np.int32), ((up + 1.0) * (height / 2.0)).astype(np.int32)
        is_inside = (np.abs(right) < 1.0) & (np.abs(up) < 1.0)
        caster = lamp.depth[np.where(is_inside, row, 0), np.where(is_inside, column, 0)]
        # the offset is in radii, as is the depth of the map
        hits += is_inside & (caster < 1.0) & (caster + SHADOW_STYLE.offset < depth)
    share[shown] = hits / len(cameras)
    return share
