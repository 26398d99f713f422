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

from .contact_time_weights import UNWEIGHTED, ContactTimeWeights
from .low_rank_springs import StiffCoupling
from .surface_data import SurfaceData

if TYPE_CHECKING:
    from ..mesh.split_surface.surface_map import SurfaceMap
    from .tie_matrix import TieMatrix

Values = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]
Flags = npt.NDArray[np.bool_]
type Form = ufl.Form | int  # 0: none
# nodes (n, 2) of all broken edges and where they are cut (n, 1) from the lower one, nan: in the middle; on rank 0
type Cuts = Callable[[], tuple[npt.NDArray[np.int64], Values] | None]  # (collective)


@dataclass(frozen=True)
class TimeLevel:
    """Where in time forces balance, and the affine rates of the scheme there (forms.schemes).

    Attributes:
        t: s.        dt: size of the step, s; 0 where a state is only looked at.
        u, v: (owned dofs,) state at the start of the step in m, m/s.
        c_a, c_v: of a = c_a (u - u_a) and v = c_v (u - u_v), 1/s^2 and 1/s.    u_a, u_v: (owned dofs,) m.
        share: of dt that has passed at t.    blow: how contact enters the step.
    """

    t: float
    dt: float
    u_n: Values
    v_n: Values
    c_a: float
    c_v: float
    u_a: Values
    u_v: Values
    fraction: float = 1.0
    contact_weights: ContactTimeWeights = UNWEIGHTED

    @property
    def contact_weight(self) -> float:
        """Of forces of contact at the end of the step in r."""
        return self.contact_weights.factor * self.fraction

    def displacement_at_end(self, u: Values) -> Values:
        """(owned dofs,) displacement at the end of the step that belongs to u at the level, m."""
        return u if self.fraction == 1 else np.asarray(self.u_n + (u - self.u_n) / self.fraction)


class Term:
    """A term of the balance that adds nothing: the base of all others, which say what they add.

    Signs are those of r: internal and inertial forces positive, forces on the body from outside negative.
    """

    name: ClassVar[str] = ""
    symmetric: bool = True  # whether its share of the tangent is
    linear: bool = False  # whether that share depends on damage and on the rates of the scheme alone, not on u and t
    separates_surface: ClassVar[bool] = (
        False  # whether it has a say in where the points of the split surface are: `apart`
    )
    has_output_surfaces: ClassVar[bool] = False  # whether it is `drawn`

    def begin_step(self, level: TimeLevel) -> None:
        """A step (or a look at a state) begins. Collective."""

    def update_displacement(self) -> None:
        """u has moved. Collective."""

    def virtual_work(self, w: Expr, dx: ufl.Measure) -> Form:
        """Virtual work in N m over the cells of `dx`, a form linear in the test function w. Asked once, at set-up."""
        return 0

    def tangent_form(self, v: Expr, w: Expr, dx: ufl.Measure) -> Form:
        """Derivative of `work` in the direction v, as far as Newton's method shall know it."""
        return 0

    def acceleration(self) -> Values | None:
        """(owned dofs,) what M is multiplied with at the current u, m/s^2."""
        return None

    @property
    def mass_factor(self) -> float:
        """Derivative of `acceleration` with respect to u, 1/s^2: a factor of M in the tangent."""
        return 0.0

    def add_nodal_forces(self, forces: Values) -> None:
        """Add nodal forces at the current u to r, (owned dofs,) in N."""

    def contact_forces(self) -> Values | None:
        """(owned dofs,) forces of contact at the end of the step that belongs to the current u, N (collective).

        r has them with the weight of a blow, and the acceleration that a scheme carries on is without them
        (contact_time_weights).
        """
        return None

    def add_stiffness(self, K: PETSc.Mat) -> None:
        """Add the derivative of `add_force` to the assembled tangent, within the pattern of its cells."""

    def coupling_matrix(self) -> PETSc.Mat | StiffCoupling | None:
        """The rest of that derivative, a matrix of any pattern over the dofs; None: there is none (collective).

        The tangent takes its entries; the preconditioner is made anew where they are at other places than before. What
        is Stiff stays beside it.
        """
        return None

    def tie_matrix(self, free: Flags) -> TieMatrix | None:
        """The same as `coupling` for tangents in blocks, which stay without its entries; None: there is none. `free`:
        (owned dofs,) that nothing prescribes. Terms that have no such way keep the tangent in single entries."""
        return None

    leaves_tangent_incomplete: ClassVar[bool] = (
        False  # whether the tangent may lack a share of its own: `low_rank`, or a Stiff
    )

    def low_rank_updates(self) -> list[tuple[Values, Values]]:
        """What the tangent loses with unknowns that the term has eliminated: U C U^T of U (owned dofs, k) and C (k, k),
        summed over ranks (collective)."""
        return []

    def stored_energy(self) -> float:
        """Energy that it stores at the current u, this rank's share, J."""
        return 0.0

    def applied_forces(self) -> Values | None:
        """(owned dofs,) force on the body from outside at the current u, N: what does external work."""
        return None

    def damping_forces(self) -> Values | None:
        """(owned dofs,) force at the current u whose work is lost, N."""
        return None

    def reference_forces(self) -> Values | None:
        """(owned dofs,) forces that r is the balance of, for its convergence test, N."""
        return None

    def frequency_bound(self) -> float:
        """By how much it adds to the square of the highest frequency of the body at most, on all ranks, 1/s^2: what
        explicit steps are cut to."""
        return 0.0

    def begin_solve(self) -> None:
        """Newton's method sets out on the step, once more where it has failed before."""

    def max_step_fraction(self, change: Values) -> float:
        """Largest share (0, 1] of a change of u (owned dofs,) that Newton's method may take, on this rank."""
        return 1.0

    @property
    def limits_newton_steps(self) -> bool:
        """Whether it has a say in how long a step of Newton's method is."""
        return type(self).max_step_fraction is not Term.max_step_fraction

    def feasible_guess(self, u: Values) -> Values:
        """(owned dofs,) a first guess of u, m, changed to one that Newton's method may start from (collective)."""
        return u

    def is_feasible(self, u: Values) -> bool:
        """Whether Newton's method may start from u (owned dofs,), m (collective)."""
        return True

    def restrict_motion(self) -> None:
        """Act for now only as far as the body at the step's start allows (collective)."""

    def remaining_motion(self) -> float:
        """The share of its way that is left where it is held back, on all ranks alike; 0: it is not."""
        return 0.0

    def continue_motion(self) -> None:
        """Where it is held back, act as far as the body where it is now allows (collective)."""

    def potential(self) -> float | None:
        """Energy whose derivative is its share of r at the current u, this rank's share, J (collective); None: there is
        none. Where all terms have one their sum is what Newton's line search goes down."""
        return None

    def summed_columns(self) -> dict[str, Callable[[], Values]]:
        """Columns of history.csv, each with a function that gives this rank's share, (1,)."""
        return {}

    def minimum_columns(self) -> dict[str, Callable[[], float]]:
        """Columns of history.csv, each with a function of which the least over ranks counts (collective)."""
        return {}

    def work_columns(self) -> dict[str, Callable[[], float]]:
        """Columns of history.csv that are summed over steps, each with a function that gives this rank's share of the
        last step, J."""
        return {}

    def step_work(self) -> tuple[float, float]:
        """Work from outside in the step that has ended which `applied` does not show, and what of it is lost, this
        rank's share, J; asked once a step (collective)."""
        return 0.0, 0.0

    def stiffen_contact(self) -> float:
        """Act stiffer from here on, where the end of the step shows that contact is too soft for what presses on it;
        what energy it stores for that at the same u, this rank's share, J (collective)."""
        return 0.0

    def separate_surface(self, at: SurfaceMap, elements: Ints, u: Values, t: float) -> SurfaceMap:
        """Where the split surface is at the time t of the state, s, with nodal displacements u (N, d), m, so that what
        it keeps apart is apart; `at`: where it is without, `elements` (m, d) the points of its segments or triangles.
        Asked of rank 0, for what is drawn (not collective)."""
        return at

    def output_surfaces(self, t: float) -> dict[str, SurfaceData]:
        """Surfaces beside the body's at the time t of the state, s, by name; the same on all ranks (not collective)."""
        return {}

    def kinetic_energy(self) -> float:
        """Energy of motion of what it moves beside the body, this rank's share, J."""
        return 0.0

    def accept_step(self) -> None:
        """A solution of the step is found: be what it ends with, until a past is recalled (collective)."""

    def set_cuts(self, cuts: Cuts) -> None:
        """Broken edges are cut where `cuts` says, which is asked after they broke; else in the middle."""

    def edges_broke(self, pattern: npt.NDArray[np.uint8]) -> None:
        """Edges have broken: patterns (cells,) of those of each cell (collective)."""

    def snapshot(self) -> object:
        """What it is between two steps beside u, never to be written to again; None: it has no past."""
        return None

    def restore(self, memory: object) -> None:
        """Be again what `memory` gave, with the damage of then (collective)."""

    def to_checkpoint(self) -> dict[str, Values]:
        """The same for a checkpoint: arrays that do not know of ranks, whole on rank 0 (collective)."""
        return {}

    def from_checkpoint(self, saved: dict[str, Values]) -> None:
        """Be again what `saved` gave on rank 0, with u and the damage of then; the same arrays on all ranks."""

    def clear_search(self) -> None:
        """Forget where it has looked, and what a search starts from: what a checkpoint does not hold (collective)."""

    def destroy(self) -> None:
        """Give the memory of PETSc's objects back."""

    def damage_changed(self) -> None:
        """Edges broke, or cells lost stiffness. Not collective."""


def sum_of_forms(forms: list[Form]) -> Form:
    """The sum of those that are not 0, in their order."""
    present = [form for form in forms if form != 0]
    return sum(present[1:], present[0])
