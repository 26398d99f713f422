"""Newton's method down the incremental potential: the objective of a SNES, and tangents that are made positive.

Exact tangents of a body that tears, buckles or is squeezed are not positive: CG stops, and what other methods find may
go up. With positive moduli (mechanics.psd_projection) directions go down from anywhere. Near the solution tangents are
exact again, for there Newton's method gains its digits; where they are not positive even there, they stay as they were
made.

What the line search of Newton's method goes down where contact limits its steps, or moduli are made positive.

The incremental potential: on the norm of r, which a barrier makes steep, it cuts good steps to nothing. But where no
contact acts at either end of a step the norm tells as well, and its residual is asked for next anyway; the energy of
the body is then not summed at all.

Corrections that would throw few nodes far are held back there, so that all others go their whole way.

With moduli made positive a cell that is all but flat, or hangs by a node, has next to no stiffness in some direction:
Newton's correction throws its nodes tens to hundreds of edges far, and the line search cuts everybody's to a twentieth
for their sake, iteration after iteration. So a node goes no further than an edge, unless many would: what a whole part
does is its motion. What is held back is found again from where it has come to.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from petsc4py import PETSc

from ..mechanics.balance import Balance
from ..mesh.domain import Domain
from ..mesh.parallel import sum_over_ranks
from .weak_callbacks import weak_callback

# Potentials that differ by less than this share of their terms are the same.
ROUND_OFF = 1e4 * float(np.finfo(float).eps)
NEARLY = 1e3  # times that: whole steps that rise by no more are near the solution
DOWN = -1e100  # J: taken as it is
FEW = 0.03  # of all nodes, which are held back at most
PATIENCE = 10  # iterations with exact tangents that find no smaller residual, after which there is no use in more


class MeritFunction:
    """The objective of a SNES, J: how far it is above where the step set out."""

    def __init__(self, balance: Balance, snes: PETSc.SNES) -> None:
        self._balance, self._snes = balance, snes
        self._from, self._residual = balance.work_vector.duplicate(), balance.work_vector.duplicate()
        self.begin_solve()

    def begin_solve(self) -> None:
        """A solve begins: nothing is known of it."""
        self._whole: float | None = None  # J, what the whole step of an iteration rises by
        self._known, self._known_at, self._residual_at = (0.0, 0.0), -1, -1  # after how many moves of the body
        self._height, self._norm, self._sets_out, self._by_norm = 0.0, 0.0, True, False
        self._rested = False

    def begin_line_search(self) -> None:
        """The direction of an iteration is found: PETSc asks for its start next."""
        self._sets_out = True

    def note_elimination(self) -> None:
        """Some nodes went down by themselves, where the residual of others may rise: from here on the norm is no merit,
        or what they gained would be given back, again and again."""
        self._rested = True

    def evaluate_residual(self, x: PETSc.Vec, b: PETSc.Vec) -> None:
        """r at x into b (collective)."""
        self._balance.set_iterate(x)
        if self._residual_at == self._balance.displacement_version:
            self._residual.copy(b)
        else:
            self._balance.assemble_free_residual(x, b)

    def __call__(self, x: PETSc.Vec) -> float:
        """J, at x (collective).

        Near the solution potentials differ by round-off alone: such a step counts as one downwards, so that it is taken
        whole. One that was cut until it made no difference is none: its direction goes up.
        """
        self._balance.set_iterate(x)
        if self._sets_out:
            self._set_out_from(x)
            return 0.0
        if self._by_norm:
            if not self._balance.contact.is_active() and self._norm_at(x) < self._norm:
                return DOWN
            self._ask_for_the_start(x)
        potential, size = self._potential()
        rise, slack = potential - self._height, ROUND_OFF * size
        if self._whole is None:
            self._whole = rise
        return -slack if abs(rise) <= slack and self._whole <= NEARLY * slack else rise

    def _set_out_from(self, x: PETSc.Vec) -> None:
        self._sets_out, self._whole = False, None
        self._by_norm = not self._rested and not self._balance.contact.is_active()
        if self._by_norm:
            x.copy(self._from)
            self._norm = self._snes.getFunctionNorm()
        else:
            self._height = self._potential()[0]

    def _potential(self) -> tuple[float, float]:
        """Potential and its size where the body is, J; mostly asked for where the line search has just been."""
        if self._known_at != self._balance.displacement_version:
            self._known, self._known_at = (
                self._balance.energies.incremental_potential(),
                self._balance.displacement_version,
            )
        return self._known

    def _norm_at(self, x: PETSc.Vec) -> float:
        """|r| at x, N."""
        self._balance.assemble_free_residual(x, self._residual)
        self._residual_at = self._balance.displacement_version
        return float(self._residual.norm())

    def _ask_for_the_start(self, x: PETSc.Vec) -> None:
        """Go by the potential after all."""
        self._balance.set_iterate(self._from)
        self._height, self._by_norm = self._potential()[0], False
        self._balance.set_iterate(x)

    def destroy(self) -> None:
        """Give the memory of PETSc's objects back."""
        self._from.destroy()
        self._residual.destroy()


def clip_correction(domain: Domain, y: PETSc.Vec, r: PETSc.Vec) -> None:
    """Shorten a correction x <- x - y, m, of the FEW nodes that go further than an edge, where it still leads down a
    potential whose derivative at x is `r`, N (collective)."""
    moves = y.array_r.reshape(-1, domain.dim)
    lengths, far = np.sqrt((moves * moves).sum(axis=1)), domain.mean_edge_length
    most = FEW * domain.space.dofmap.index_map.size_global
    while (beyond := sum_over_ranks(domain.comm, np.count_nonzero(lengths > far))[0]) > most:
        far *= 2
    if not beyond:
        return
    whole = y.copy()
    y.array_w[:] = (moves * np.minimum(1.0, far / np.maximum(lengths, far))[:, None]).reshape(-1)
    if y.dot(r) <= 0:
        whole.copy(y)
    whole.destroy()


class TangentModification(NamedTuple):
    """How an attempt goes down.

    Attributes:
        exact_below: share of the greatest residual below which tangents are exact.
        small: negative eigenvalues that are let be otherwise, in mean moduli of a cell.
        anew: whether preconditioners are made for each tangent.    goes_on: from where the last attempt has come to.
    """

    exact_below: float
    eigenvalue_floor: float
    rebuild_preconditioner: bool = False
    from_last_iterate: bool = False


# with positive moduli; the second and the third go on from where exact tangents have misled the one before
POSITIVE_TANGENTS = (
    TangentModification(1e-2, 1e-2),
    TangentModification(1e-2, 0.0, from_last_iterate=True),
    TangentModification(0.0, 0.0, from_last_iterate=True),
    TangentModification(0.0, 0.0, rebuild_preconditioner=True),
)


EXACT_TANGENTS = TangentModification(math.inf, 0.0, from_last_iterate=True)  # exact tangents throughout


class ModifiedNewton:
    """What a SNES goes by.

    Attributes:
        snes: it.    descent: its objective.
    """

    def __init__(self, balance: Balance, snes: PETSc.SNES) -> None:
        """Makes the incremental potential of `balance`, which has one, the objective of `snes`."""
        self.snes, self._balance = snes, balance
        self.merit = descent = MeritFunction(balance, snes)
        objective, residual = weak_callback(descent.__call__), weak_callback(descent.evaluate_residual)
        snes.setObjective(lambda _, x: objective(x))
        snes.setFunction(lambda _, x, b: residual(x, b), balance.work_vector)
        self.use_modification(None)

    def use_modification(self, how: TangentModification | None) -> None:
        """An attempt begins: tangents are those of a way, or exact."""
        self._how, self._highest = how, 0.0
        self._least, self._least_at = math.inf, 0

    @property
    def eigenvalue_floor(self) -> float | None:
        """Of the tangent at the present iterate (Stiffness.assemble); None: it is exact."""
        if self._how is None:
            return None
        norm = self.snes.getFunctionNorm()
        self._highest = max(self._highest, norm)
        return None if norm < self._how.exact_below * self._highest else self._how.eigenvalue_floor

    def clip_correction(self, y: PETSc.Vec) -> None:
        """Of a correction what would throw few nodes far, where moduli are made positive (line_search). Without inertia
        nothing tells where a part goes that hangs by a thread (collective)."""
        if self._balance.scheme.inertia and self.eigenvalue_floor is not None:
            clip_correction(self._balance.domain, y, self.snes.getFunction()[0])

    def has_stalled(self, norm: float, its: int) -> bool:
        """Whether it goes about in circles: exact tangents that are not positive, though CG does not notice, lead past
        the solution for as long as they may. |r| is `norm`, N, after `its` iterations."""
        if norm < self._least or not its:
            self._least, self._least_at = norm, its
        return self._how is not None and self.eigenvalue_floor is None and its - self._least_at >= PATIENCE

    def destroy(self) -> None:
        """Give the memory of PETSc's objects back."""
        self.merit.destroy()
