"""Balance of forces of a body: residual, reactions, and the steps that all terms are told of.

    r(u) = sum of the terms' virtual works  +  M (sum of their accelerations)  +  sum of their nodal forces
    K(u) = d r / d u (mechanics.tangent)

Sums of energies and forces over the terms are in `EnergySums`, contact in `term_protocols.ContactTerms`.

Equations: docs/theory.md#time-integration.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property

import numpy as np
import numpy.typing as npt
import ufl
from dolfinx import fem
from mpi4py import MPI
from petsc4py import PETSc

from ..forms.schemes import Scheme
from ..mesh.dolfinx_compat import apply_lifting
from ..mesh.domain import Domain
from ..mesh.parallel import sum_over_ranks
from ..mesh.small_matrices import barycentric_gradients
from .contact_time_weights import ContactTimeWeights, acceleration_change
from .eliminated_unknowns import EliminatedUnknowns
from .inertia import MassMatrix
from .jit import CellForm, cell_measure
from .matrix_assembly import VectorAssembler
from .prescribed_motion import PrescribedMotion
from .stress import Stress
from .tangent import Tangent
from .term import Term, TimeLevel, Values, overriding, sum_of_forms
from .term_protocols import (
    ContactTerms,
    HistoryColumns,
    ObstacleWork,
    RigidMotionTerm,
    StepWork,
    TermHistories,
    fulfilling,
)

# methods of terms that are called in every step, of those terms alone that override them
_STEP_METHODS = (
    "begin_step", "update_displacement", "accept_step", "add_nodal_forces", "acceleration", "applied_forces",
    "damping_forces", "reference_forces", "stored_energy", "edges_broke", "damage_changed",
)  # fmt: skip


class Balance:
    """Equations of a body, and the displacement at which they are evaluated.

    Attributes:
        domain: the mesh.
        u: displacement, m: the unknown.
        owned_dof_count: number of dofs of u on this rank.
        terms: terms of the balance, in this order.
        terms_with: the terms that override a method of Term, by its name.
        stress: the one among them that damage acts on.
        motion: prescribed displacements.
        mass: mass matrix.
        scheme: time integration: level at which forces balance, and rates there.
        c_a, c_v: rates of the last step, 1/s^2 and 1/s.
        level: time level of the last step or evaluation.
        contact_weights: weights of contact forces in a step of that scheme.
        contact: contact among the terms.
        eliminated: unknowns of terms beside u; None: there are none.
        histories: history variables of the terms.
        energies: sums of energies and forces over the terms.
        tangent: derivative of r, of implicit schemes alone.
        displacement_version: number of changes of u.
        reactions: (owned dofs,) r before rows of prescribed dofs are replaced; the reactions on those rows, N.
        work_vector: vector over the dofs, for use within a solve.
        linear: whether K depends on damage and on the rates of the scheme alone.
        symmetric: whether K is symmetric.
    """

    tangent: Tangent

    def __init__(
        self,
        assembler: VectorAssembler,
        u: fem.Function,
        terms: Sequence[Term],
        motion: PrescribedMotion,
        mass: MassMatrix,
        scheme: Scheme,
        step: float,
    ) -> None:
        """Compile the sum of the terms' forms (collective).

        Args:
            assembler: of vectors over the dofs of u.
            u: displacement.
            terms: terms of the balance, one of which is a Stress.
            motion: prescribed displacements.
            mass: mass matrix.
            scheme: time integration.
            step: size of the step for the rates of the first state, s.
        """
        domain = self.domain = assembler.domain
        self.u, self.owned_dof_count, self.terms = u, assembler.owned_dof_count, tuple(terms)
        self.stress = next(term for term in terms if isinstance(term, Stress))
        self.motion, self.mass, self.scheme = motion, mass, scheme
        self.contact_weights = ContactTimeWeights.for_scheme(scheme)
        self.contact, self.histories = ContactTerms(domain.comm, terms), TermHistories(terms)
        eliminated = EliminatedUnknowns(domain.comm, terms)
        self.eliminated = eliminated if eliminated.exist else None
        self.terms_with = {name: overriding(terms, name) for name in _STEP_METHODS}
        self.linear = all(term.linear for term in terms)
        self.symmetric = all(term.symmetric for term in terms)
        self.c_a, self.c_v = scheme.rate_coefficients(step)
        self._assembler = assembler
        self.displacement_version = 0
        self.work_vector, self._force_vector = assembler.create_vector(), assembler.create_vector()
        self.reactions: Values = np.zeros(self.owned_dof_count)
        self._is_prescribed = bool(sum_over_ranks(domain.comm, len(motion.owned_dofs))[0])
        self._work = _virtual_work(domain, self.terms)
        self._work_at_supports = _virtual_work(domain, self.terms, _cells_at_supports(domain, motion))
        if scheme.implicit:
            self.tangent = self._new_tangent()
        self.energies = EnergySums(self)
        zero = np.zeros(self.owned_dof_count)
        self._set_level(TimeLevel(0.0, 0.0, zero, zero, self.c_a, self.c_v, zero, zero), motion.displacements_at(0.0))

    def _new_tangent(self) -> Tangent:
        return Tangent(self.terms, self.stress, self.motion, self.mass)

    # --- a step, or the evaluation of a state ---

    def begin_step(self, t: float, dt: float, u: Values, v: Values, a: Values) -> None:
        """Begin a step of dt to t at the owned state u, v, a (collective)."""
        scheme, motion = self.scheme, self.motion
        late = scheme.alpha_f
        self.c_a, self.c_v = scheme.rate_coefficients(dt)
        prescribed = motion.displacements_at(t)
        if late:
            prescribed = (1 - late) * prescribed + late * motion.displacements_at(t - dt)
        u_a, u_v = scheme.reference_displacements(dt, u, v, a)
        dofs, end = motion.owned_dofs, prescribed[: len(motion.owned_dofs)]
        if not late and (rates := scheme.prescribed_dof_rates(dt, end, u[dofs], v[dofs])) is not None:
            u_a[dofs], u_v[dofs] = end - rates[1] / self.c_a, end - rates[0] / self.c_v
        level = TimeLevel(t - late * dt, dt, u, v, self.c_a, self.c_v, u_a, u_v, 1 - late, self.contact_weights)
        self._set_level(level, prescribed)

    def evaluate_at(self, t: float, u: Values, v: Values, a: Values | None = None, *, dt: float | None = None) -> None:
        """Put the body into a state without a step (collective).

        Args:
            t: time, s.
            u: (owned dofs,) displacement, m.
            v: (owned dofs,) velocity, m/s.
            a: (owned dofs,) acceleration, m/s^2; None: zero.
            dt: size of the step whose rates are used, s; None: that of the last step.
        """
        if dt is not None:
            self.c_a, self.c_v = self.scheme.rate_coefficients(dt)
        self.set_displacement(u)
        u_a = u - a / self.c_a if a is not None and self.c_a else u
        weights = self.contact_weights
        level = TimeLevel(t, 0.0, u, v, self.c_a, self.c_v, u_a, u - v / self.c_v, contact_weights=weights)
        self._set_level(level, self.motion.displacements_at(t))

    def _set_level(self, level: TimeLevel, prescribed: Values) -> None:
        self.level = level
        self.motion.set_values(prescribed)
        if self.scheme.implicit:
            self.tangent.c_v = level.c_v
        for term in self.terms_with["begin_step"]:
            term.begin_step(level)

    def accept_step(self) -> None:
        """Accept the current u as the solution of the step (collective)."""
        for term in self.terms_with["accept_step"]:
            term.accept_step()

    def set_displacement(self, u: Values) -> None:
        """Put (owned dofs,) displacements into u, ghosts included (collective)."""
        if self.contact.limits_newton_steps and self.scheme.implicit:
            # Newton's method comes to each iterate twice, and terms of contact search once
            unchanged = np.array_equal(self.u.x.array[: self.owned_dof_count], u)
            if self.domain.comm.allreduce(unchanged, op=MPI.LAND):
                return
        self.displacement_version += 1
        self.u.x.array[: self.owned_dof_count] = u
        self.u.x.scatter_forward()
        for term in self.terms_with["update_displacement"]:
            term.update_displacement()
        if self.eliminated is not None:
            self.eliminated.follow(u)

    def set_iterate(self, x: PETSc.Vec, *, prescribed: bool = True) -> None:
        """Put an iterate into u; `prescribed`: with prescribed dofs at their values (collective)."""
        u = x.array_r.copy()
        if prescribed:
            u[self.motion.owned_dofs] = self.motion.values
        self.set_displacement(u)

    def rates(self) -> tuple[Values, Values]:
        """(v, a) of the owned dofs at the current u, by the rates of the scheme; m/s and m/s^2."""
        u, level = self.u.x.array[: self.owned_dof_count], self.level
        return level.c_v * (u - level.u_v), level.c_a * (u - level.u_a)

    def carried_acceleration(self, dt: float, a: Values) -> Values:
        """(owned dofs,) acceleration without that of contact, m/s^2, from which the next step starts (collective).

        Equations: docs/theory.md#contact-in-a-time-step.
        """
        if (forces := self.contact.forces()) is None:
            return a
        change = self.mass.solve(self._weighted(forces), self.motion.free_dofs) / self.c_a
        return np.asarray(a - acceleration_change(self.scheme, dt, change))

    # --- residual ---

    def assemble_residual(self, b: PETSc.Vec) -> PETSc.Vec:
        """Residual at the current u into b, N; rows of prescribed dofs hold their reactions (collective)."""
        return self._add_nodal_parts(self._assembler.assemble_local_vector(b, self._work))

    def _add_nodal_parts(self, b: PETSc.Vec) -> PETSc.Vec:
        """Add the parts of r that no form has: nodal forces, and M times the sum of accelerations."""
        r = b.array_w
        for term in self.terms_with["add_nodal_forces"]:
            term.add_nodal_forces(r)
        if (contact_forces := self.contact.forces()) is not None:
            r -= self._weighted(contact_forces)
        accelerations = [a for term in self.terms_with["acceleration"] if (a := term.acceleration()) is not None]
        if accelerations:
            r += self.mass.multiply(sum(accelerations[1:], accelerations[0]))
        return b

    def _weighted(self, contact_forces: Values) -> Values:
        """Contact forces with their weight in r; without it on prescribed dofs, so that reactions balance them."""
        if (weight := self.level.contact_weight) == 1:
            return contact_forces
        result, dofs = weight * contact_forces, self.motion.owned_dofs
        result[dofs] = contact_forces[dofs]
        return result

    def assemble_free_residual(self, x: PETSc.Vec, b: PETSc.Vec) -> None:
        """Residual at x into b, zero on rows of prescribed dofs (collective)."""
        # rows u - u_prescribed instead would mix metres with newtons in one norm, and leave prescribed dofs as inexact
        # as the Krylov solve
        self.set_iterate(x)
        np.copyto(self.reactions, self.assemble_residual(b).array_r)
        if self.eliminated is not None and (condensed := self.eliminated.condensed_residual()) is not None:
            b.array_w[:] -= condensed
        b.array_w[self.motion.owned_dofs] = 0.0

    def assemble_extension_residual(self, x: PETSc.Vec, b: PETSc.Vec, free_fraction: float | None = None) -> None:
        """Sum r + K (u_prescribed - u) into b, at an x whose prescribed dofs have other values (collective).

        Its solution extends a jump of the prescribed displacement linearly into the body. Cells at the boundary would
        otherwise take all of it and might invert.

        Args:
            x: displacement, m.
            b: the sum, N.
            free_fraction: of the jump at the prescribed dofs alone that contact allows. K then has the stiffness of
                contact, from a difference of forces. None: without.
        """
        self.set_iterate(x, prescribed=False)
        local = self._assembler.assemble_local_part(b, self._work)
        apply_lifting(local, self.tangent.form, self.motion.bcs, self.u)
        self._add_nodal_parts(self._assembler.sum_over_ranks(b))
        if free_fraction is not None:
            b.array_w[:] -= self._contact_force_change(x, 1e-4 * free_fraction)
        b.array_w[self.motion.owned_dofs] = 0.0

    def _contact_force_change(self, x: PETSc.Vec, fraction: float) -> Values:
        """(owned dofs,) change of the contact forces in r by a jump of prescribed dofs to their values, N (collective).

        Linear, from the change in a small `fraction` of the jump. The current u is x, with other prescribed values.
        """
        u, change = x.array_r.copy(), []
        for share in (fraction, 0.0):
            moved = u.copy()
            moved[self.motion.owned_dofs] += share * (self.motion.values - u[self.motion.owned_dofs])
            self.set_displacement(moved)
            forces = self.contact.forces()
            change.append(np.zeros_like(u) if forces is None else self._weighted(forces))
        return np.asarray((change[0] - change[1]) / fraction)

    def update_forces(self) -> Values:
        """(owned dofs,) residual at the current u, stored as `reactions` (collective)."""
        np.copyto(self.reactions, self.assemble_residual(self._force_vector).array_r)
        return self.reactions

    def update_reactions(self) -> None:
        """Update `reactions` on prescribed dofs alone: a residual over the cells at supports (collective)."""
        if not self._is_prescribed:
            return
        b = self._add_nodal_parts(self._assembler.assemble_local_vector(self._force_vector, self._work_at_supports))
        self.reactions[self.motion.owned_dofs] = b.array_r[self.motion.owned_dofs]

    # --- Newton's method ---

    def begin_solve(self) -> None:
        """Begin an attempt of Newton's method at the step."""
        self.contact.begin_solve()
        if self.eliminated is not None:
            self.eliminated.begin_solve()

    def max_step_fraction(self, change: Values) -> float:
        """Largest fraction in (0, 1] of a change of u (owned dofs,), m, that all terms allow (collective)."""
        if self.eliminated is not None:
            self.eliminated.begin_correction(self.u.x.array[: self.owned_dof_count], change)
        fraction = self.contact.max_step_fraction(change)
        if self.eliminated is not None:
            self.eliminated.allow(fraction)
        return fraction

    def feasible_guess(self, u: Values) -> Values:
        """(owned dofs,) displacement, m, from which Newton's method may start, near a guess u (collective)."""
        # prescribed dofs first: fixed obstacles have to be found in the way of what moves
        u[self.motion.owned_dofs] = self.motion.values
        return self.contact.feasible_guess(u, self.level.u_n)

    @cached_property
    def conservative(self) -> bool:
        """Whether r is the derivative of the incremental potential (collective)."""
        return all([term.potential() is not None for term in self.terms])

    # --- events ---

    def edges_broke(self, pattern: npt.NDArray[np.uint8]) -> None:
        """Tell all terms of broken edges: (cells,) patterns, bit k for local edge k of a cell (collective)."""
        for term in self.terms_with["edges_broke"]:
            term.edges_broke(pattern)

    def damage_changed(self) -> None:
        """Tell all terms of a lower stiffness; cells without stress are not integrated any more (not collective)."""
        for term in self.terms_with["damage_changed"]:
            term.damage_changed()
        if (dead := self.stress.dead_cells) is not None:
            self._work.exclude_cells(dead)
            self._work_at_supports.exclude_cells(dead)
        if self.scheme.implicit:
            self.tangent.damage_changed()

    def clear_search(self) -> None:
        """Clear what a checkpoint does not have: caches of contact and the tangent, which is made anew (collective)."""
        self.contact.clear_search()
        if self.scheme.implicit:
            self.tangent.destroy()
            self.tangent = self._new_tangent()
            self.tangent.c_v = self.level.c_v
            self.tangent.damage_changed()

    def destroy(self) -> None:
        """Free PETSc's objects; the balance cannot be used any more."""
        for owner in (self.work_vector, self._force_vector, self._assembler, self.mass, *self.terms):
            owner.destroy()
        if self.scheme.implicit:
            self.tangent.destroy()


class EnergySums:
    """Sums of energies and forces over the terms of a balance, and the scales of their round-off."""

    def __init__(self, balance: Balance) -> None:
        self._balance, self._comm = balance, balance.domain.comm
        self._rigid_motion, self._working = (
            fulfilling(balance.terms, RigidMotionTerm),
            fulfilling(balance.terms, StepWork),
        )
        self._obstacle_groups = fulfilling(balance.terms, ObstacleWork)

    def kinetic_energy(self, v: Values) -> float:
        """Kinetic energy of the body and of rigid obstacles, part of this rank, J; v: (owned dofs,), m/s."""
        return 0.5 * float(v @ self._balance.mass.multiply(v)) + sum(
            term.kinetic_energy() for term in self._rigid_motion
        )

    def incremental_potential(self) -> tuple[float, float]:
        """(value, size) of the incremental potential at the current u, J (collective).

        r is its derivative. The size is the sum of absolute values that it consists of, which bounds its round-off.
        """
        parts = sum_over_ranks(self._comm, np.array([term.potential() or 0.0 for term in self._balance.terms]))
        # psi is a difference of terms as large as the moduli: 4 eps Y V of it is round-off, with ROUND_OFF = 2e-12 of
        # the line search
        return float(parts.sum()), float(np.abs(parts).sum()) + 4e-4 * self._unit_strain_energy

    @cached_property
    def _unit_strain_energy(self) -> float:
        """Y V: energy at a strain of one, J (collective)."""
        young, volumes = self._balance.stress.material.young, self._balance.domain.volumes
        return float(sum_over_ranks(self._comm, np.sum(young * volumes))[0])

    def step_work(self) -> tuple[float, float]:
        """(work, dissipated) external work of the last step that no nodal force shows, of this rank, J (collective)."""
        works = [owner.step_work() for owner in self._working]
        return sum(work for work, _ in works), sum(dissipated for _, dissipated in works)

    def obstacle_work(self) -> float:
        """Work of obstacles in the step so far less the loss by friction on them, part of this rank, J (collective)."""
        works = [owner.step_work() for owner in self._working if isinstance(owner, HistoryColumns)]
        return sum(work - dissipated for work, dissipated in works)

    def works_of_obstacles(self) -> list[list[float]]:
        """Work of each obstacle in the step so far, by groups of contact, part of this rank, J."""
        return [list(group.work) for group in self._obstacle_groups]

    def replace_works_of_obstacles(self, works: Sequence[Sequence[float]]) -> None:
        """Replace the work of obstacles in the step by what `works_of_obstacles` returned earlier in it."""
        for group, work in zip(self._obstacle_groups, works, strict=True):
            group.replace_work(work)

    def applied_forces(self) -> Values:
        """(owned dofs,) external forces on the body at the current u, N; a copy (collective)."""
        forces = [
            force for term in self._balance.terms_with["applied_forces"] if (force := term.applied_forces()) is not None
        ]
        return sum(forces[1:], forces[0].copy()) if forces else np.zeros(self._balance.owned_dof_count)

    def damping_forces(self) -> Values | None:
        """(owned dofs,) forces whose work is dissipated, N; None without damping (collective)."""
        forces = [
            force for term in self._balance.terms_with["damping_forces"] if (force := term.damping_forces()) is not None
        ]
        return sum(forces[1:], forces[0]) if forces else None

    def force_scale(self) -> tuple[float, float]:
        """(size, round-off) of the forces in the residual, N, as root sums of squares over all dofs (collective).

        Size is the largest norm of the reactions and of the terms' reference forces. Round-off is eps times the norms
        of what the residual consists of: the stiffness Y h^(d-2) of a node times the extent of the body, the stiffness
        of its cells times its displacement, and M c_a u.
        """
        balance = self._balance
        u = balance.u.x.array[: balance.owned_dof_count]
        references = [
            forces for term in balance.terms_with["reference_forces"] if (forces := term.reference_forces()) is not None
        ]
        # contact forces with their weight in the residual
        contact_forces = [term.contact_forces() for term in balance.contact.contacts]
        references += [balance.level.contact_weight * forces for forces in contact_forces if forces is not None]
        inertia = balance.mass.lumped * u if balance.c_a else 0.0
        parts = (*references, balance.reactions[balance.motion.owned_dofs], u, inertia)
        *loads, moved, carried = np.sqrt(
            sum_over_ranks(self._comm, np.array([np.sum(np.square(part)) for part in parts]))
        )
        (stiffness, extent), eps = self._node_stiffness, np.finfo(float).eps
        cell_stiffness = max(stiffness, self._cell_stiffness)
        # eight times: so much is left of a body far from its rest position, more than its forces in a short step
        return float(max(loads)), float(
            eps * (stiffness * extent + 8 * (cell_stiffness * moved + balance.c_a * carried))
        )

    @cached_property
    def _node_stiffness(self) -> tuple[float, float]:
        """(largest Y h^(d-2), N/m; extent of the body as a root sum of squares over all dofs, m) (collective)."""
        domain = self._balance.domain
        dofs = domain.space.dofmap.index_map.size_global * domain.dim
        young = self._comm.allreduce(float(np.max(self._balance.stress.material.young, initial=0.0)), op=MPI.MAX)
        return float(young * domain.mean_edge_length ** (domain.dim - 2)), float(domain.bounds.diagonal * np.sqrt(dofs))

    @cached_property
    def _cell_stiffness(self) -> float:
        """Root mean square of Y V |grad l|^2 over the cells, N/m: large where they are flat (collective).

        |grad l| is the largest gradient of a barycentric coordinate, one over the least altitude of a cell.
        """
        domain, young = self._balance.domain, self._balance.stress.material.young
        gradients = barycentric_gradients(domain.nodes[domain.cell_nodes])
        stiffness = young * domain.volumes * np.square(gradients).sum(axis=2).max(axis=1)
        total, count = sum_over_ranks(self._comm, np.array([np.square(stiffness).sum(), len(stiffness)]))
        return float(np.sqrt(total / count))


def _virtual_work(domain: Domain, terms: Sequence[Term], cells: npt.NDArray[np.int32] | None = None) -> CellForm:
    """Sum of the terms' virtual works over owned cells; None: over all of them (collective)."""
    w, dx = ufl.TestFunction(domain.space), cell_measure(domain, cells)
    return CellForm(sum_of_forms([term.virtual_work(w, dx) for term in terms]))


def _cells_at_supports(domain: Domain, motion: PrescribedMotion) -> npt.NDArray[np.int32]:
    """Owned cells with a prescribed dof."""
    return np.flatnonzero(motion.prescribed_nodes[domain.all_cell_nodes].any(axis=1)).astype(np.int32)
