"""What adds to the balance of forces, and what a term is told.

    r(u) = assembled sum of virtual works  +  M (sum of accelerations)  +  sum of nodal forces  =  0

A term gives one or more of the three kinds: a form (stress, viscosity, pressure), of which all terms together are one
compiled kernel; an acceleration, multiplied by the mass matrix once for all terms; or forces on nodes (dead loads,
contact). Residual, tangent, reactions, the residual's scale and the energy book run over one list of terms.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

import numpy as np
import numpy.typing as npt
import ufl
from petsc4py import PETSc
from ufl.core.expr import Expr

from .contact_time_weights import NONE, Blow
from .low_rank_springs import Stiff
from .surface_data import Drawn

if TYPE_CHECKING:
    from ..mesh.split_surface.surface_map import Places
    from .tie_matrix import Tied

Values = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]
Flags = npt.NDArray[np.bool_]
type Form = ufl.Form | int  # 0: none
# nodes (n, 2) of all broken edges and where they are cut (n, 1) from the lower one, nan: in the middle; on rank 0
type Cuts = Callable[[], tuple[npt.NDArray[np.int64], Values] | None]  # (collective)


@dataclass(frozen=True)
class Level:
    """Where in time forces balance, and the affine rates of the scheme there (forms.schemes).

    Attributes:
        t: s.        dt: size of the step, s; 0 where a state is only looked at.
        u, v: (owned dofs,) state at the start of the step in m, m/s.
        c_a, c_v: of a = c_a (u - u_a) and v = c_v (u - u_v), 1/s^2 and 1/s.    u_a, u_v: (owned dofs,) m.
        share: of dt that has passed at t.    blow: how contact enters the step.
    """

    t: float
    dt: float
    u: Values
    v: Values
    c_a: float
    c_v: float
    u_a: Values
    u_v: Values
    share: float = 1.0
    blow: Blow = NONE

    @property
    def weight(self) -> float:
        """Of forces of contact at the end of the step in r."""
        return self.blow.factor * self.share

    def at_end(self, u: Values) -> Values:
        """(owned dofs,) displacement at the end of the step that belongs to u at the level, m."""
        return u if self.share == 1 else np.asarray(self.u + (u - self.u) / self.share)


class Term:
    """A term of the balance that adds nothing: the base of all others, which say what they add.

    Signs are those of r: internal and inertial forces positive, forces on the body from outside negative.
    """

    name: ClassVar[str] = ""
    symmetric: bool = True  # whether its share of the tangent is
    linear: bool = False  # whether that share depends on damage and on the rates of the scheme alone, not on u and t
    keeps_apart: ClassVar[bool] = False  # whether it has a say in where the points of the split surface are: `apart`
    visible: ClassVar[bool] = False  # whether it is `drawn`

    def begin(self, level: Level) -> None:
        """A step (or a look at a state) begins. Collective."""

    def displaced(self) -> None:
        """u has moved. Collective."""

    def work(self, w: Expr, dx: ufl.Measure) -> Form:
        """Virtual work in N m over the cells of `dx`, a form linear in the test function w. Asked once, at set-up."""
        return 0

    def tangent(self, v: Expr, w: Expr, dx: ufl.Measure) -> Form:
        """Derivative of `work` in the direction v, as far as Newton's method shall know it."""
        return 0

    def acceleration(self) -> Values | None:
        """(owned dofs,) what M is multiplied with at the current u, m/s^2."""
        return None

    @property
    def mass_factor(self) -> float:
        """Derivative of `acceleration` with respect to u, 1/s^2: a factor of M in the tangent."""
        return 0.0

    def add_force(self, rows: Values) -> None:
        """Add nodal forces at the current u to r, (owned dofs,) in N."""

    def struck(self) -> Values | None:
        """(owned dofs,) forces of contact at the end of the step that belongs to the current u, N (collective).

        r has them with the weight of a blow, and the acceleration that a scheme carries on is without them
        (contact_time_weights).
        """
        return None

    def add_stiffness(self, K: PETSc.Mat) -> None:
        """Add the derivative of `add_force` to the assembled tangent, within the pattern of its cells."""

    def coupling(self) -> PETSc.Mat | Stiff | None:
        """The rest of that derivative, a matrix of any pattern over the dofs; None: there is none (collective).

        The tangent takes its entries; the preconditioner is made anew where they are at other places than before. What
        is Stiff stays beside it.
        """
        return None

    def tied(self, free: Flags) -> Tied | None:
        """The same as `coupling` for tangents in blocks, which stay without its entries; None: there is none. `free`:
        (owned dofs,) that nothing prescribes. Terms that have no such way keep the tangent in single entries."""
        return None

    beside: ClassVar[bool] = False  # whether the tangent may lack a share of its own: `low_rank`, or a Stiff

    def low_rank(self) -> list[tuple[Values, Values]]:
        """What the tangent loses with unknowns that the term has eliminated: U C U^T of U (owned dofs, k) and C (k, k),
        summed over ranks (collective)."""
        return []

    def stored(self) -> float:
        """Energy that it stores at the current u, this rank's share, J."""
        return 0.0

    def applied(self) -> Values | None:
        """(owned dofs,) force on the body from outside at the current u, N: what does external work."""
        return None

    def drag(self) -> Values | None:
        """(owned dofs,) force at the current u whose work is lost, N."""
        return None

    def scale(self) -> Values | None:
        """(owned dofs,) forces that r is the balance of, for its convergence test, N."""
        return None

    def frequency(self) -> float:
        """By how much it adds to the square of the highest frequency of the body at most, on all ranks, 1/s^2: what
        explicit steps are cut to."""
        return 0.0

    def set_out(self) -> None:
        """Newton's method sets out on the step, once more where it has failed before."""

    def longest_step(self, change: Values) -> float:
        """Largest share (0, 1] of a change of u (owned dofs,) that Newton's method may take, on this rank."""
        return 1.0

    @property
    def limits_steps(self) -> bool:
        """Whether it has a say in how long a step of Newton's method is."""
        return type(self).longest_step is not Term.longest_step

    def reachable(self, u: Values) -> Values:
        """(owned dofs,) a first guess of u, m, changed to one that Newton's method may start from (collective)."""
        return u

    def clear(self, u: Values) -> bool:
        """Whether Newton's method may start from u (owned dofs,), m (collective)."""
        return True

    def hold_back(self) -> None:
        """Act for now only as far as the body at the step's start allows (collective)."""

    def left(self) -> float:
        """The share of its way that is left where it is held back, on all ranks alike; 0: it is not."""
        return 0.0

    def go_on(self) -> None:
        """Where it is held back, act as far as the body where it is now allows (collective)."""

    def potential(self) -> float | None:
        """Energy whose derivative is its share of r at the current u, this rank's share, J (collective); None: there is
        none. Where all terms have one their sum is what Newton's line search goes down."""
        return None

    def readings(self) -> dict[str, Callable[[], Values]]:
        """Columns of history.csv, each with a function that gives this rank's share, (1,)."""
        return {}

    def least(self) -> dict[str, Callable[[], float]]:
        """Columns of history.csv, each with a function of which the least over ranks counts (collective)."""
        return {}

    def works(self) -> dict[str, Callable[[], float]]:
        """Columns of history.csv that are summed over steps, each with a function that gives this rank's share of the
        last step, J."""
        return {}

    def driven(self) -> tuple[float, float]:
        """Work from outside in the step that has ended which `applied` does not show, and what of it is lost, this
        rank's share, J; asked once a step (collective)."""
        return 0.0, 0.0

    def stiffen(self) -> float:
        """Act stiffer from here on, where the end of the step shows that contact is too soft for what presses on it;
        what energy it stores for that at the same u, this rank's share, J (collective)."""
        return 0.0

    def apart(self, at: Places, elements: Ints, u: Values, t: float) -> Places:
        """Where the split surface is at the time t of the state, s, with nodal displacements u (N, d), m, so that what
        it keeps apart is apart; `at`: where it is without, `elements` (m, d) the points of its segments or triangles.
        Asked of rank 0, for what is drawn (not collective)."""
        return at

    def drawn(self, t: float) -> dict[str, Drawn]:
        """Surfaces beside the body's at the time t of the state, s, by name; the same on all ranks (not collective)."""
        return {}

    def kinetic(self) -> float:
        """Energy of motion of what it moves beside the body, this rank's share, J."""
        return 0.0

    def arrive(self) -> None:
        """A solution of the step is found: be what it ends with, until a past is recalled (collective)."""

    def cut_by(self, cuts: Cuts) -> None:
        """Broken edges are cut where `cuts` says, which is asked after they broke; else in the middle."""

    def edges_broke(self, pattern: npt.NDArray[np.uint8]) -> None:
        """Edges have broken: patterns (cells,) of those of each cell (collective)."""

    def memory(self) -> object:
        """What it is between two steps beside u, never to be written to again; None: it has no past."""
        return None

    def recall(self, memory: object) -> None:
        """Be again what `memory` gave, with the damage of then (collective)."""

    def saved(self) -> dict[str, Values]:
        """The same for a checkpoint: arrays that do not know of ranks, whole on rank 0 (collective)."""
        return {}

    def restore(self, saved: dict[str, Values]) -> None:
        """Be again what `saved` gave on rank 0, with u and the damage of then; the same arrays on all ranks."""

    def forget(self) -> None:
        """Forget where it has looked, and what a search starts from: what a checkpoint does not hold (collective)."""

    def destroy(self) -> None:
        """Give the memory of PETSc's objects back."""

    def damage_changed(self) -> None:
        """Edges broke, or cells lost stiffness. Not collective."""


def sum_of_forms(forms: list[Form]) -> Form:
    """The sum of those that are not 0, in their order."""
    present = [form for form in forms if form != 0]
    return sum(present[1:], present[0])
