"""Newton's method down the incremental potential: the objective of a SNES, and tangents that are made positive.

Exact tangents of a body that tears, buckles or is squeezed are not positive: CG stops, and what other methods find may
go up. With positive moduli (mechanics.positive) directions go down from anywhere. Near the solution tangents are exact
again, for there Newton's method gains its digits; where they are not positive even there, they stay as they were made.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from petsc4py import PETSc

from ..mechanics.balance import Balance
from .descent import Descent
from .leaps import hold_back
from .weakly import weakly


class Way(NamedTuple):
    """How an attempt goes down.

    Attributes:
        exact_below: share of the greatest residual below which tangents are exact.
        small: negative eigenvalues that are let be otherwise, in mean moduli of a cell.
        anew: whether preconditioners are made for each tangent.    goes_on: from where the last attempt has come to.
    """

    exact_below: float
    small: float
    anew: bool = False
    goes_on: bool = False


# with positive moduli; the second and the third go on from where exact tangents have misled the one before
POSITIVE = Way(1e-2, 1e-2), Way(1e-2, 0.0, goes_on=True), Way(0.0, 0.0, goes_on=True), Way(0.0, 0.0, anew=True)
EXACT = Way(math.inf, 0.0, goes_on=True)  # exact tangents throughout
PATIENCE = 10  # iterations with exact tangents that find no smaller residual, after which there is no use in more


class Downhill:
    """What a SNES goes by.

    Attributes:
        snes: it.    descent: its objective.
    """

    def __init__(self, balance: Balance, snes: PETSc.SNES) -> None:
        """Makes the incremental potential of `balance`, which has one, the objective of `snes`."""
        self.snes, self._balance = snes, balance
        self.descent = descent = Descent(balance, snes)
        objective, residual = weakly(descent.__call__), weakly(descent.residual)
        snes.setObjective(lambda _, x: objective(x))
        snes.setFunction(lambda _, x, b: residual(x, b), balance.vector)
        self.made_positive(None)

    def made_positive(self, how: Way | None) -> None:
        """An attempt begins: tangents are those of a way, or exact."""
        self._how, self._highest = how, 0.0
        self._least, self._least_at = math.inf, 0

    @property
    def small(self) -> float | None:
        """Of the tangent at the present iterate (Stiffness.assemble); None: it is exact."""
        if self._how is None:
            return None
        norm = self.snes.getFunctionNorm()
        self._highest = max(self._highest, norm)
        return None if norm < self._how.exact_below * self._highest else self._how.small

    def hold_back(self, y: PETSc.Vec) -> None:
        """Of a correction what would throw few nodes far, where moduli are made positive (leaps). Without inertia
        nothing tells where a part goes that hangs by a thread (collective)."""
        if self._balance.scheme.inertia and self.small is not None:
            hold_back(self._balance.domain, y, self.snes.getFunction()[0])

    def stalls(self, norm: float, its: int) -> bool:
        """Whether it goes about in circles: exact tangents that are not positive, though CG does not notice, lead past
        the solution for as long as they may. |r| is `norm`, N, after `its` iterations."""
        if norm < self._least or not its:
            self._least, self._least_at = norm, its
        return self._how is not None and self.small is None and its - self._least_at >= PATIENCE

    def destroy(self) -> None:
        """Give the memory of PETSc's objects back."""
        self.descent.destroy()
