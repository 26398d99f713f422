"""What the line search of Newton's method goes down where contact limits its steps, or moduli are made positive.

The incremental potential: on the norm of r, which a barrier makes steep, it cuts good steps to nothing. But where no
contact acts at either end of a step the norm tells as well, and its residual is asked for next anyway; the energy of
the body is then not summed at all.
"""

from __future__ import annotations

import numpy as np
from petsc4py import PETSc

from ..mechanics.balance import Balance

# Potentials that differ by less than this share of their terms are the same.
ROUND_OFF = 1e4 * float(np.finfo(float).eps)
NEARLY = 1e3  # times that: whole steps that rise by no more are near the solution
DOWN = -1e100  # J: taken as it is


class Descent:
    """The objective of a SNES, J: how far it is above where the step set out."""

    def __init__(self, balance: Balance, snes: PETSc.SNES) -> None:
        self._balance, self._snes = balance, snes
        self._from, self._residual = balance.vector.duplicate(), balance.vector.duplicate()
        self.begin()

    def begin(self) -> None:
        """A solve begins: nothing is known of it."""
        self._whole: float | None = None  # J, what the whole step of an iteration rises by
        self._known, self._known_at, self._residual_at = (0.0, 0.0), -1, -1  # after how many moves of the body
        self._height, self._norm, self._sets_out, self._by_norm = 0.0, 0.0, True, False
        self._rested = False

    def set_out(self) -> None:
        """The direction of an iteration is found: PETSc asks for its start next."""
        self._sets_out = True

    def rested(self) -> None:
        """Some nodes went down by themselves, where the residual of others may rise: from here on the norm is no merit,
        or what they gained would be given back, again and again."""
        self._rested = True

    def residual(self, x: PETSc.Vec, b: PETSc.Vec) -> None:
        """r at x into b (collective)."""
        self._balance.displace_to(x)
        if self._residual_at == self._balance.moves:
            self._residual.copy(b)
        else:
            self._balance.free_residual(x, b)

    def __call__(self, x: PETSc.Vec) -> float:
        """J, at x (collective).

        Near the solution potentials differ by round-off alone: such a step counts as one downwards, so that it is taken
        whole. One that was cut until it made no difference is none: its direction goes up.
        """
        self._balance.displace_to(x)
        if self._sets_out:
            self._set_out_from(x)
            return 0.0
        if self._by_norm:
            if not self._balance.acts() and self._norm_at(x) < self._norm:
                return DOWN
            self._ask_for_the_start(x)
        potential, size = self._potential()
        rise, slack = potential - self._height, ROUND_OFF * size
        if self._whole is None:
            self._whole = rise
        return -slack if abs(rise) <= slack and self._whole <= NEARLY * slack else rise

    def _set_out_from(self, x: PETSc.Vec) -> None:
        self._sets_out, self._whole = False, None
        self._by_norm = not self._rested and not self._balance.acts()
        if self._by_norm:
            x.copy(self._from)
            self._norm = self._snes.getFunctionNorm()
        else:
            self._height = self._potential()[0]

    def _potential(self) -> tuple[float, float]:
        """Potential and its size where the body is, J; mostly asked for where the line search has just been."""
        if self._known_at != self._balance.moves:
            self._known, self._known_at = self._balance.potential(), self._balance.moves
        return self._known

    def _norm_at(self, x: PETSc.Vec) -> float:
        """|r| at x, N."""
        self._balance.free_residual(x, self._residual)
        self._residual_at = self._balance.moves
        return float(self._residual.norm())

    def _ask_for_the_start(self, x: PETSc.Vec) -> None:
        """Go by the potential after all."""
        self._balance.displace_to(self._from)
        self._height, self._by_norm = self._potential()[0], False
        self._balance.displace_to(x)

    def destroy(self) -> None:
        """Give the memory of PETSc's objects back."""
        self._from.destroy()
        self._residual.destroy()
