"""Newton's method down the incremental potential: the objective of a SNES, and tangents that are made positive.

Exact tangents of a body that tears, buckles or is squeezed are not positive: CG stops, and what other methods find may
go up. With positive moduli (mechanics.positive) directions go down from anywhere. Near the solution tangents are exact
again, for there Newton's method gains its digits; where they are not positive even there, they stay as they were made.
"""

from __future__ import annotations

import math

from petsc4py import PETSc

from ..mechanics.balance import Balance
from .descent import Descent

type Way = tuple[tuple[float, float], bool]

# attempts with positive moduli: below which share of their residual tangents are exact, and negative eigenvalues that
# are let be, in mean moduli of a cell; whether preconditioners are made anew for each tangent. The second goes on from
# where exact tangents misled the first
POSITIVE = ((1e-2, 1e-2), False), ((0.0, 0.0), False), ((0.0, 0.0), True)
EXACT = (math.inf, 0.0), False  # an attempt with exact tangents throughout
PATIENCE = 10  # iterations with exact tangents that find no smaller residual, after which there is no use in more


class Downhill:
    """What a SNES goes by.

    Attributes:
        snes: it.    descent: its objective.
    """

    def __init__(self, balance: Balance, snes: PETSc.SNES) -> None:
        """Makes the incremental potential of `balance`, which has one, the objective of `snes`."""
        self.snes = snes
        self.descent = descent = Descent(balance, snes)
        snes.setObjective(lambda _, x: descent(x))
        snes.setFunction(lambda _, x, b: descent.residual(x, b), balance.vector)
        self.made_positive(None)

    def made_positive(self, how: tuple[float, float] | None) -> None:
        """An attempt begins: tangents are those of one of POSITIVE, or exact."""
        self._how, self._highest = how, 0.0
        self._least, self._least_at = math.inf, 0

    @property
    def small(self) -> float | None:
        """Of the tangent at the present iterate (Stiffness.assemble); None: it is exact."""
        if self._how is None:
            return None
        exact_below, small = self._how
        norm = self.snes.getFunctionNorm()
        self._highest = max(self._highest, norm)
        return None if norm < exact_below * self._highest else small

    def stalls(self, norm: float, its: int) -> bool:
        """Whether it goes about in circles: exact tangents that are not positive, though CG does not notice, lead past
        the solution for as long as they may. |r| is `norm`, N, after `its` iterations."""
        if norm < self._least or not its:
            self._least, self._least_at = norm, its
        return self._how is not None and self.small is None and its - self._least_at >= PATIENCE

    def destroy(self) -> None:
        """Give the memory of PETSc's objects back."""
        self.descent.destroy()
