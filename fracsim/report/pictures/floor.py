"""A floor that goes on as far as one sees, of the colour of the backdrop, and the shadow of what is above it."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

Values = npt.NDArray[np.float64]
REACH = 40.0  # of the body's size
SHADE = 0.86  # of the floor's brightness
LIFT = 5e-4  # of the body's size: the shadow is above the floor


def add_floor(plotter: Any, point: Values, normal: Values, size: float, colour: str) -> None:
    """A disc through `point` (3,), m, of a body of `size`, m."""
    import pyvista

    disc = pyvista.Disc(center=point, inner=0.0, outer=REACH * size, normal=normal, c_res=48)
    plotter.add_mesh(disc, color=colour, lighting=False, ambient=0.0, diffuse=1.0)


def add_shadow(plotter: Any, surface: Any, point: Values, normal: Values, light: Values, size: float, rgb: Any) -> None:
    """What light from the direction `light` (3,) leaves dark of a floor of the colour `rgb`."""
    height = (np.asarray(surface.points) - point) @ normal
    shadow = surface.copy(deep=False)
    shadow.clear_data()
    shadow.points = surface.points - ((height - LIFT * size) / (light @ normal))[:, None] * light
    if (height < 0).any():  # what is below the floor throws none
        faces = shadow.regular_faces
        kept = faces[(height[faces] > -LIFT * size).all(axis=1)]
        if not len(kept):
            return
        shadow = type(shadow).from_regular_faces(shadow.points, kept)
    dark = "#{:02x}{:02x}{:02x}".format(*(int(SHADE * each) for each in rgb))
    plotter.add_mesh(shadow, color=dark, lighting=False, ambient=0.0, diffuse=1.0)
