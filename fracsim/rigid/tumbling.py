"""How a rigid body turns where nothing acts: its angular momentum stays, to round-off.

    R' = exp(dt w_m) R,   w_m = (R_m I R_m^T)^-1 l,   R_m = exp(dt w_m / 2) R

the implicit midpoint rule, of second order and without a drift of the energy, found by fixed points: it converges where
a body turns by less than about a radian a step. What turns by more than PART does so in equal parts: at a radian a step
the energy of a flat shard goes up and down by some per cent otherwise.

Equations: docs/theory.md#motion-and-contact-of-rigid-bodies.
"""

from __future__ import annotations

from ctypes import c_double, c_int64
from pathlib import Path

import numpy as np
import numpy.typing as npt

from ..errors import NotConverged
from ..mesh.compiled import at, library

Values = npt.NDArray[np.float64]

SOURCE = Path(__file__).with_suffix(".c")
ROUNDS = 30
PART = 0.2  # rad
LIMIT = 1e4  # rad
SAME = 1e-14  # change of the turn in a step, rad, that is none


def tumbled(turn: Values, inverse: Values, momentum: Values, dt: Values) -> Values:
    """(n, 3, 3) rotations after times dt (n,) s, from those before and angular momenta (n, 3), N m s.

    `inverse`: (n, 3, 3) of the inertia in the axes of the bodies, 1 / (kg m^2). NotConverged where one turns by more
    than LIMIT.
    """
    given = [np.ascontiguousarray(each) for each in (turn, inverse, momentum, dt)]
    after: Values = np.empty(turn.shape)
    how = c_int64(ROUNDS), c_double(SAME), c_double(PART), c_double(LIMIT)
    if library(SOURCE).tumbled(c_int64(len(turn)), *map(at, given), *how, at(after)):
        raise NotConverged(
            f"A body turns by more than {LIMIT:g} rad in a step: speeds and spins are too high for time.step"
        )
    return after


def rotated(turn: Values, tensor: Values, vector: Values) -> Values:
    """(n, 3) R T R^T v of tensors in the axes of bodies (n, 3, 3), inertia or its inverse, and vectors in space (n, 3):
    spins, or angular momenta."""
    given, result = [np.ascontiguousarray(each) for each in (turn, tensor, vector)], np.empty(vector.shape)
    library(SOURCE).rotations(c_int64(len(turn)), *map(at, given), at(result))
    return result


def driven(
    turn: Values, inertia: Values, inverse: Values, mass: Values, motion: tuple[Values, Values], force: Values,
    gravity: Values, dt: float, most: float,
) -> tuple[Values, Values]:  # fmt: skip
    """(n, 3) velocities and (n, 3) spins after dt, s, from those before, `motion`, of bodies with masses (n,) that turn
    where they are by `gravity` (3,) and forces and moments (n, 6), these in their own axes; no moment sets one spinning
    by more than `most`, rad/s."""
    arrays = (turn, inertia, inverse, mass, *motion, force, gravity)
    given, after = [np.ascontiguousarray(each, float) for each in arrays], np.empty((len(mass), 6))
    library(SOURCE).driven(c_int64(len(mass)), *map(at, given), c_double(dt), c_double(most), at(after))
    return np.ascontiguousarray(after[:, :3]), np.ascontiguousarray(after[:, 3:])


def orientation(turn: Values) -> Values:
    """(n, 4) of rotations (n, 3, 3) quaternions, the scalar first."""
    turn, quat = np.ascontiguousarray(turn), np.empty((len(turn), 4))
    library(SOURCE).orientations(c_int64(len(turn)), at(turn), at(quat))
    return quat
