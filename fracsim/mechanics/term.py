"""Terms of the balance of forces, and the time level at which forces balance.

    r(u) = assembled sum of virtual works  +  M (sum of accelerations)  +  sum of nodal forces  =  0

A term gives one or more of three kinds of contributions: a form (stress, viscosity, pressure), of which all terms
together are one compiled kernel; an acceleration, multiplied by the mass matrix once for all terms; or nodal forces
(dead loads, contact). Residual, tangent, reactions, scale of the residual and energy balance run over one list of
terms.
What only contact has to tell is in the protocols of `term_protocols`.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

import numpy as np
import numpy.typing as npt
import ufl
from petsc4py import PETSc
from ufl.core.expr import Expr

from .contact_time_weights import UNWEIGHTED, ContactTimeWeights

if TYPE_CHECKING:
    from .extra_couplings import FewNodesCoupling

Values = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]
Flags = npt.NDArray[np.bool_]
type Form = ufl.Form | int  # 0: no form


SAME_TIME = 1e-6  # difference of the starts of two steps, in their length, up to which the step is the same


@dataclass(frozen=True)
class TimeLevel:
    """Time at which forces balance, and the rates of the scheme there, which are affine in u (forms.schemes).

    Attributes:
        t: time of the level, s.
        dt: size of the step, s; 0 if a state is only evaluated.
        u_n: (owned dofs,) displacement at the start of the step, m.
        v_n: (owned dofs,) velocity at the start of the step, m/s.
        c_a: factor of the acceleration a = c_a (u - u_a), 1/s^2.
        c_v: factor of the velocity v = c_v (u - u_v), 1/s.
        u_a: (owned dofs,) reference displacement of the acceleration, m.
        u_v: (owned dofs,) reference displacement of the velocity, m.
        fraction: part of dt that has passed at t.
        contact_weights: weights of contact forces in the step.
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
    def start_time(self) -> float:
        """Time at the start of the step, s."""
        return self.t - self.fraction * self.dt

    def starts_at(self, t: float | None) -> bool:
        """Whether the step starts at t, s, as a step does that is repeated; never with None."""
        return t is not None and abs(self.start_time - t) <= SAME_TIME * self.dt

    @property
    def contact_weight(self) -> float:
        """Factor of contact forces at the end of the step in r."""
        return self.contact_weights.factor * self.fraction

    def displacement_at_end(self, u: Values) -> Values:
        """(owned dofs,) displacement at the end of the step, m, for a displacement u at the level."""
        return u if self.fraction == 1 else np.asarray(self.u_n + (u - self.u_n) / self.fraction)


class Term:
    """Base of the terms of the balance: contributes nothing.

    A subclass overrides the contributions that it has. Signs are those of r: internal and inertial forces are positive,
    external forces on the body are negative. Terms with a history, of contact or with output fulfil the protocols of
    `term_protocols` as well, or have parts that do.

    Attributes:
        name: of its columns and of its arrays in checkpoints.
        parts: objects that fulfil protocols of `term_protocols` for the term.
        symmetric: whether its part of the tangent is symmetric.
        linear: whether its part of the tangent depends on damage and on the rates of the scheme alone, not on u and t.
        leaves_tangent_incomplete: whether part of its tangent stays beside the matrix (FewNodesCoupling, ...).
    """

    name: ClassVar[str] = ""
    parts: Sequence[object] = ()
    symmetric: bool = True
    linear: bool = False
    leaves_tangent_incomplete: ClassVar[bool] = False

    def begin_step(self, level: TimeLevel) -> None:
        """Begin a step, or the evaluation of a state, at a time level (collective)."""

    def update_displacement(self) -> None:
        """React to a new displacement u (collective)."""

    def accept_step(self) -> None:
        """Accept the current u as the solution of the step; undone by a restored snapshot (collective)."""

    # --- contributions to residual and tangent ---

    def virtual_work(self, w: Expr, dx: ufl.Measure) -> Form:
        """Virtual work, N m, over the cells of `dx`: a form linear in the test function w. Asked once, at set-up."""
        return 0

    def tangent_form(self, v: Expr, w: Expr, dx: ufl.Measure) -> Form:
        """Derivative of `virtual_work` in the direction v, as Newton's method uses it. Asked once, at set-up."""
        return 0

    def acceleration(self) -> Values | None:
        """(owned dofs,) factor of M in the residual at the current u, m/s^2; None if there is none."""
        return None

    @property
    def mass_factor(self) -> float:
        """Derivative of `acceleration` by u, 1/s^2: factor of M in the tangent."""
        return 0.0

    def add_nodal_forces(self, forces: Values) -> None:
        """Add nodal forces at the current u to the residual (owned dofs,), N."""

    def add_stiffness(self, K: PETSc.Mat) -> None:
        """Add the derivative of `add_nodal_forces` to the assembled tangent, within the pattern of its cells."""

    def coupling_matrix(self) -> PETSc.Mat | FewNodesCoupling | None:
        """Remaining part of that derivative: a matrix of any pattern over the dofs, None if there is none (collective).

        It is added to the entries of the tangent, whose nonzero pattern may change, and stays beside a tangent in
        blocks. A FewNodesCoupling stays beside both; of one term alone.
        """
        return None

    # --- energies and forces ---

    def stored_energy(self) -> float:
        """Stored energy at the current u, part of this rank, J."""
        return 0.0

    def potential(self) -> float | None:
        """Potential whose derivative is the term's part of r, at the current u, part of this rank, J (collective).

        None if there is none. If all terms have one, the line search of Newton's method minimises their sum.
        """
        return None

    def applied_forces(self) -> Values | None:
        """(owned dofs,) external force on the body at the current u, N: its work is the external work."""
        return None

    def damping_forces(self) -> Values | None:
        """(owned dofs,) force at the current u whose work is dissipated, N."""
        return None

    def reference_forces(self) -> Values | None:
        """(owned dofs,) forces in equilibrium in r, N: their norm scales the residual in the convergence test."""
        return None

    def frequency_bound(self) -> float:
        """Bound of its part of the square of the highest frequency, on all ranks, 1/s^2: limits explicit steps."""
        return 0.0

    # --- events ---

    def edges_broke(self, pattern: npt.NDArray[np.uint8]) -> None:
        """React to broken edges: (cells,) patterns, bit k for local edge k of a cell (collective)."""

    def damage_changed(self) -> None:
        """React to broken edges or a lower stiffness of cells (not collective)."""

    def destroy(self) -> None:
        """Free PETSc's objects."""


def overriding(terms: Iterable[Term], *methods: str) -> list[Term]:
    """Terms whose classes override one of these methods of Term; the others contribute nothing to them."""
    return [term for term in terms if any(getattr(type(term), name) is not getattr(Term, name) for name in methods)]


def sum_of_forms(forms: list[Form]) -> Form:
    """Sum of the forms that are not 0, in their order."""
    present = [form for form in forms if form != 0]
    return sum(present[1:], present[0])
