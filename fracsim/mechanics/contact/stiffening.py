"""How much stiffer a barrier has to be where what presses on it has all but closed a gap.

A barrier holds any pressure, a small stiffness at a small gap: kappa b'(g) = p. But at a gap of TIGHT its stiffness
b'' = p / g is so much more than that of the body around it that Newton's method creeps: with a ten-thousandth of the
stiffness that contact has by itself steps were halved without end. From there on kappa is what bears the pressure at
EASY. (To double it each time, as Li et al. 2020 do, takes ten steps for the same.) It never goes back: a barrier that
is stiffer than need be costs little.
"""

from __future__ import annotations

import numpy as np

from .barrier import Barrier

TIGHT, EASY = 3e-3, 0.1  # of the barrier's width. By itself contact came down to 0.016 in a torn loaf that recoils


def stiffening(share: float) -> float:
    """Factor of kappa with which the pressure at a gap of `share` of the width stands at EASY; 1 where it is not
    TIGHT."""
    if not 0 < share < TIGHT:
        return 1.0
    tight, easy = Barrier(1.0, 1.0).slope(np.array([share, EASY]))
    return float(tight / easy)
