"""A surface to be drawn beside that of the body."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt


@dataclass(frozen=True)
class SurfaceData:
    """Where it is at a time: points (n, d), m; triangles (k, 3); in 2D segments (m, 2) around them."""

    points: npt.NDArray[np.float64]
    triangles: npt.NDArray[np.integer]
    segments: npt.NDArray[np.integer]
