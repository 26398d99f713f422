"""Record of the crack tips of a step in balance, before they advance: the rows of tips.csv."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

Ints = npt.NDArray[np.int64]
Values = npt.NDArray[np.float64]


@dataclass(frozen=True)
class TipReading:
    """Crack tips of this rank.

    Attributes:
        cell: (n,) numbers of their cells in the input mesh.
        point: (n, d) positions at rest, m.
        release_rate: (n,) G, J/m^2, that is compared with G_c; NaN of a tip whose crack is shorter than its disc.
        intensities: (n, 2) K_I and K_II, Pa sqrt(m), NaN as above; (n, 0) in 3D.
    """

    cell: Ints
    point: Values
    release_rate: Values
    intensities: Values


class TipRecord:
    """Crack tips in the first fracture pass of a step; later passes see cracks that have advanced in the step.

    Attributes:
        reading: tips of this rank; None if no rank had a tip in a pass of the step.
    """

    def __init__(self) -> None:
        self.reading: TipReading | None = None
        self._step = (np.nan, np.nan)

    def begin_step(self, t: float, dt: float) -> None:
        """Forget the tips of the last step, unless the same step from t of dt, s, is solved again after a pass."""
        if self._step != (t, dt):
            self._step, self.reading = (t, dt), None

    def add(self, reading: TipReading) -> None:
        """Record the tips of the first pass of a step, and ignore those of later ones."""
        if self.reading is None:
            self.reading = reading
