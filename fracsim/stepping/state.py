"""What a run carries from one step to the next."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

Values = npt.NDArray[np.float64]


@dataclass
class State:
    """Owned dofs at time t.

    Attributes:
        t: s.        step: steps taken.        dt: size of the next step, s.
        u, v, a: (owned dofs,) displacement, velocity, acceleration in m, m/s, m/s^2.
        dissipated: energy lost to fracture and damping, J.    work: external work, J (both summed over ranks).
        easy: steps in a row that went without halving.
        elastic: elastic energy at t on this rank, J.
        forces: loads and reactions where the last step balanced them, N.    drag: damping forces there, N.
    """

    u: Values
    v: Values
    a: Values
    t: float = 0.0
    step: int = 0
    dt: float = 0.0
    dissipated: float = 0.0
    work: float = 0.0
    easy: int = 0
    elastic: float = 0.0
    forces: Values = field(default_factory=lambda: np.empty(0))
    drag: Values | None = None
