"""The balance of forces of a body: a sum of terms, its residual, and what belongs to it at a state.

r(u) = sum of the terms' virtual works  +  M (sum of their accelerations)  +  sum of their nodal forces
K(u) = d r / d u (mechanics.tangent)
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
from ufl.core.expr import Expr

from ..forms.schemes import Scheme
from ..mesh.dolfinx_compat import apply_lifting
from ..mesh.domain import Domain
from ..mesh.parallel import sum_over_ranks
from .contact_time_weights import ContactTimeWeights, acceleration_change
from .inertia import MassMatrix
from .jit import CellForm, cell_measure
from .matrix_assembly import VectorAssembler
from .prescribed_motion import PrescribedMotion
from .stress import Stress
from .tangent import Tangent
from .term import Cuts, Form, Term, TimeLevel, sum_of_forms

Values = npt.NDArray[np.float64]


class Balance:
    """The equations of a body, and the displacement that they are asked about.

    Attributes:
        u: displacement (m), the unknown.    owned: its dofs on this rank.
        terms: what adds to the balance, in this order.    stress: the one among them that damage acts on.
        motion: dofs whose motion is prescribed.    mass: the mass matrix.
        scheme: where in a step forces balance, and the rates there.    c_a, c_v: those of the last step.
        blow: how contact enters a step of that scheme.
        stiffness: its tangent; of implicit schemes alone.
        moves: how often u has been put elsewhere.
        reactions: (owned dofs,) r before rows of prescribed dofs are replaced; on those rows it is the reaction, N.
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
        """One of the terms is the stress; `step`: s, of the rates that a first state is looked at with.

        Compiles what the forms of the terms add up to (collective).
        """
        self.domain: Domain = assembler.domain
        self.u, self.owned_dof_count, self.terms = u, assembler.owned_dof_count, tuple(terms)
        self.stress = next(term for term in terms if isinstance(term, Stress))
        self.motion, self.mass, self.scheme, self.contact_weights = (
            motion,
            mass,
            scheme,
            ContactTimeWeights.for_scheme(scheme),
        )
        self.c_a, self.c_v = scheme.rates(step)
        self._assembler = assembler
        self.displacement_version = 0
        self.work_vector = assembler.create_vector()
        self._kept = assembler.create_vector()
        self.reactions: Values = np.zeros(self.owned_dof_count)
        self._compile()
        rest = np.zeros(self.owned_dof_count)
        self._tell(TimeLevel(0.0, 0.0, rest, rest, self.c_a, self.c_v, rest, rest), motion.displacements_at(0.0))

    def _compile(self) -> None:
        domain = self.domain
        w, dx = ufl.TestFunction(domain.space), cell_measure(domain)
        self._work = CellForm(self._sum_of_works(w, dx))
        self._work_at_supports = CellForm(self._sum_of_works(w, cell_measure(domain, self._cells_at_supports())))
        if self.scheme.implicit:
            self.tangent = self._new_tangent()

    def _new_tangent(self) -> Tangent:
        return Tangent(self.u, self.terms, self.stress, self.motion, self.mass)

    def _renew_tangent(self) -> None:
        """With the damage of now (collective)."""
        self.tangent.destroy()
        self.tangent = self._new_tangent()
        self.tangent.c_v = self.level.c_v
        self.tangent.damage_changed()

    def _sum_of_works(self, w: Expr, dx: ufl.Measure) -> Form:
        return sum_of_forms([term.virtual_work(w, dx) for term in self.terms])

    def _cells_at_supports(self) -> npt.NDArray[np.int32]:
        """Owned cells with a prescribed dof."""
        return np.flatnonzero(self.motion.prescribed_nodes[self.domain.all_cell_nodes].any(axis=1)).astype(np.int32)

    # --- a step, or a look at a state ---

    def accept_step(self) -> None:
        """A solution of the step is found (collective)."""
        for term in self.terms:
            term.accept_step()

    def begin_step(self, t: float, dt: float, u: Values, v: Values, a: Values) -> None:
        """A step of dt to t begins at the owned state u, v, a (collective)."""
        scheme, motion = self.scheme, self.motion
        late = scheme.alpha_f
        self.c_a, self.c_v = scheme.rates(dt)
        where = (1 - late) * motion.displacements_at(t) + late * motion.displacements_at(t - dt)
        u_a, u_v = scheme.references(dt, u, v, a)
        own, to = motion.owned_dofs, where[: len(motion.owned_dofs)]
        if not late and (led := scheme.prescribed(dt, to, u[own], v[own])) is not None:
            u_a[own], u_v[own] = to - led[1] / self.c_a, to - led[0] / self.c_v
        self._tell(
            TimeLevel(t - late * dt, dt, u, v, self.c_a, self.c_v, u_a, u_v, 1 - late, self.contact_weights), where
        )

    def evaluate_at(self, t: float, u: Values, v: Values, a: Values | None = None, *, dt: float | None = None) -> None:
        """Put the body at u with velocity v and acceleration a (none where not given) at time t (collective).

        `dt`: with the rates of a step of that size; None: with those of the last step.
        """
        if dt is not None:
            self.c_a, self.c_v = self.scheme.rates(dt)
        self.set_displacement(u)
        u_a = u - a / self.c_a if a is not None and self.c_a else u
        level = TimeLevel(t, 0.0, u, v, self.c_a, self.c_v, u_a, u - v / self.c_v, contact_weights=self.contact_weights)
        self._tell(level, self.motion.displacements_at(t))

    def _tell(self, level: TimeLevel, where: Values) -> None:
        self.level = level
        self.motion.set_values(where)
        if self.scheme.implicit:
            self.tangent.c_v = level.c_v
        for term in self.terms:
            term.begin_step(level)

    def set_displacement(self, u: Values) -> None:
        """Put the owned values of a displacement into u, ghosts included (collective).

        Newton's method comes to each iterate twice. Terms that look for what touches look once.
        """
        if self.limits_newton_steps and self._is_at(u):
            return
        self.displacement_version += 1
        self.u.x.array[: self.owned_dof_count] = u
        self.u.x.scatter_forward()
        for term in self.terms:
            term.update_displacement()

    def _is_at(self, u: Values) -> bool:
        """Whether u is there already, on all ranks (collective)."""
        return bool(self.domain.comm.allreduce(np.array_equal(self.u.x.array[: self.owned_dof_count], u), op=MPI.LAND))

    def set_iterate(self, x: PETSc.Vec, *, prescribed: bool = True) -> None:
        """Bring an iterate into u; `prescribed`: with prescribed dofs at their values (collective)."""
        u = x.array_r.copy()
        if prescribed:
            u[self.motion.owned_dofs] = self.motion.values
        self.set_displacement(u)

    def rates(self) -> tuple[Values, Values]:
        """(v, a) of the owned dofs at the current u, by the rates of the scheme; m/s and m/s^2."""
        u, level = self.u.x.array[: self.owned_dof_count], self.level
        return level.c_v * (u - level.u_v), level.c_a * (u - level.u_a)

    # --- residual ---

    def assemble_residual(self, b: PETSc.Vec) -> PETSc.Vec:
        """r at the current u into b, N; rows of prescribed dofs hold their reactions (collective)."""
        return self._add_nodal(self._assembler.assemble_into(b, self._work))

    def _add_nodal(self, b: PETSc.Vec) -> PETSc.Vec:
        """What no form says: forces on nodes, and M times the sum of accelerations."""
        rows = b.array_w
        for term in self.terms:
            term.add_nodal_forces(rows)
        if (struck := self.contact_forces()) is not None:
            rows -= self._weighted(struck)
        accelerations = [each for term in self.terms if (each := term.acceleration()) is not None]
        if accelerations:
            rows += self.mass.multiply(sum(accelerations[1:], accelerations[0]))
        return b

    def contact_forces(self) -> Values | None:
        """(owned dofs,) forces of contact at the end of the step, N; None where nothing touches (collective)."""
        forces = [force for term in self.terms if (force := term.contact_forces()) is not None]
        return sum(forces[1:], forces[0]) if forces else None

    def _weighted(self, struck: Values) -> Values:
        """As they enter r; what holds a prescribed dof feels them as they are."""
        if (weight := self.level.contact_weight) == 1:
            return struck
        result, own = weight * struck, self.motion.owned_dofs
        result[own] = struck[own]
        return result

    def carried_acceleration(self, dt: float, a: Values) -> Values:
        """(owned dofs,) a at the end of a step without what blows have given, m/s^2: what the next step goes on from
        (collective)."""
        if (struck := self.contact_forces()) is None:
            return a
        moved = self.mass.solve(self._weighted(struck), self.motion.free_dofs) / self.c_a
        return np.asarray(a - acceleration_change(self.scheme, dt, moved))

    def assemble_free_residual(self, x: PETSc.Vec, b: PETSc.Vec) -> None:
        """r at x into b, zero on rows of prescribed dofs, which hold their values in every iterate.

        Rows u - u_prescribed instead would mix metres with newtons in one norm, and leave prescribed dofs as inexact as
        the Krylov solve.
        """
        self.set_iterate(x)
        np.copyto(self.reactions, self.assemble_residual(b).array_r)
        b.array_w[self.motion.owned_dofs] = 0.0

    def assemble_extension_residual(self, x: PETSc.Vec, b: PETSc.Vec) -> None:
        """r + K (u_prescribed - u) at an x whose prescribed dofs are not at their values yet.

        The linear way to carry a jump of the boundary into the body before Newton starts; cells at the boundary would
        otherwise take all of it and may turn inside out.
        """
        self.set_iterate(x, prescribed=False)
        apply_lifting(self._assembler.assemble_local_part(b, self._work), self.tangent.form, self.motion.bcs, self.u)
        self._add_nodal(self._assembler.sum_over_ranks(b))
        b.array_w[self.motion.owned_dofs] = 0.0

    def update_forces(self) -> Values:
        """(owned dofs,) r at the current u, kept as `reactions` (collective)."""
        np.copyto(self.reactions, self.assemble_residual(self._kept).array_r)
        return self.reactions

    def update_reactions(self) -> None:
        """Refresh `reactions` on prescribed dofs alone: a residual over the few cells that touch them (collective)."""
        if not self._is_held:
            return
        b = self._add_nodal(self._assembler.assemble_into(self._kept, self._work_at_supports))
        self.reactions[self.motion.owned_dofs] = b.array_r[self.motion.owned_dofs]

    @cached_property
    def _is_held(self) -> bool:
        """Whether the motion of any dof is prescribed (collective the first time)."""
        return bool(sum_over_ranks(self.domain.comm, len(self.motion.owned_dofs))[0])

    @cached_property
    def limits_newton_steps(self) -> bool:
        """Whether a term has a say in how long a step of Newton's method is."""
        return any(term.limits_newton_steps for term in self.terms)

    def is_in_contact(self) -> bool:
        """Whether a term that limits steps has a potential at the current u (collective)."""
        limiting = (term for term in self.terms if term.limits_newton_steps)
        return bool(sum_over_ranks(self.domain.comm, sum(abs(term.potential() or 0.0) for term in limiting))[0] > 0)

    def begin_solve(self) -> None:
        """Newton's method sets out on the step, once more where it has failed before."""
        self.tangent.begin_solve()
        for term in self.terms:
            term.begin_solve()

    def max_step_fraction(self, change: Values) -> float:
        """Largest share of a change of u (owned dofs,) that all terms allow (collective)."""
        share = min(term.max_step_fraction(change) for term in self.terms)
        share = float(self.domain.comm.allreduce(share, op=MPI.MIN))
        self.tangent.record_step_fraction(share)
        return share

    def feasible_guess(self, u: Values) -> Values:
        """(owned dofs,) a first guess of u that Newton's method may start from: the step's start where there is no
        better one, with terms held back until it has gone on (collective).

        Prescribed dofs are at their values first: what is held has to be found in the way of what moves.
        """
        u[self.motion.owned_dofs] = self.motion.values
        for term in self.terms:
            u = term.feasible_guess(u)
        if all([term.is_feasible(u) for term in self.terms]):
            return u
        for term in self.terms:
            term.restrict_motion()
        return self.level.u_n

    def remaining_motion(self) -> float:
        """The share of their way that is left to terms that are held back: once they have gone on r = 0 is to be solved
        once more; 0: none is."""
        return max(term.remaining_motion() for term in self.terms)

    def continue_motion(self) -> None:
        """Terms that are held back go on (collective)."""
        for term in self.terms:
            term.continue_motion()

    def incremental_potential(self) -> tuple[float, float]:
        """The incremental potential, whose derivative is r, at the current u, and the size of what it is the sum of,
        J (collective).

        psi is a difference of terms as large as the moduli: 4 eps Y V of it is round-off, with ROUND_OFF of descent.
        """
        parts = sum_over_ranks(self.domain.comm, np.array([term.potential() or 0.0 for term in self.terms]))
        return float(parts.sum()), float(np.abs(parts).sum()) + 4e-4 * self._stored_at_strain_one

    @cached_property
    def _stored_at_strain_one(self) -> float:
        """Y V, J (collective)."""
        domain = self.domain
        return float(sum_over_ranks(domain.comm, np.sum(self.stress.material.young * domain.volumes))[0])

    @cached_property
    def linear(self) -> bool:
        """Whether K depends on damage and on the rates of the scheme alone."""
        return all(term.linear for term in self.terms)

    @cached_property
    def conservative(self) -> bool:
        """Whether r is the derivative of `potential` (collective)."""
        return all([term.potential() is not None for term in self.terms])

    def set_cuts(self, cuts: Cuts) -> None:
        """Broken edges are cut where `cuts` says."""
        for term in self.terms:
            term.set_cuts(cuts)

    def edges_broke(self, pattern: npt.NDArray[np.uint8]) -> None:
        """Edges have broken: patterns (cells,) of those of each cell (collective)."""
        for term in self.terms:
            term.edges_broke(pattern)

    def snapshot(self) -> dict[str, object]:
        """What terms are between two steps beside u."""
        return {term.name: past for term in self.terms if (past := term.snapshot()) is not None}

    def restore(self, memory: object) -> None:
        """Be again what `memory` gave, with the damage of then (collective)."""
        assert isinstance(memory, dict)
        for term in self.terms:
            if term.name in memory:
                term.restore(memory[term.name])

    def to_checkpoint(self) -> dict[str, Values]:
        """The same for a checkpoint, by term and name, whole on rank 0 (collective)."""
        return {f"{term.name}.{name}": values for term in self.terms for name, values in term.to_checkpoint().items()}

    def from_checkpoint(self, saved: object) -> None:
        """Be again what `saved` gave on rank 0; the same arrays on all ranks (collective)."""
        assert isinstance(saved, dict)
        for term in self.terms:
            own = {name.removeprefix(f"{term.name}."): values for name, values in saved.items()
                   if name.startswith(f"{term.name}.")}  # fmt: skip
            if own:
                term.from_checkpoint(own)

    def clear_search(self) -> None:
        """Forget what a checkpoint does not hold: the tangent is another one, whose matrix the solver has to take
        (collective)."""
        for term in self.terms:
            term.clear_search()
        if self.scheme.implicit:
            self._renew_tangent()

    def step_work(self) -> tuple[float, float]:
        """Work from outside that no nodal force shows, and what of it is lost, this rank's share, J (collective)."""
        work, lost = zip(*(term.step_work() for term in self.terms), strict=True)
        return sum(work), sum(lost)

    def stiffen_contact(self) -> float:
        """Contact that is too soft acts stiffer from here on; what energy it gets for that, this rank's share, J
        (collective)."""
        return sum(term.stiffen_contact() for term in self.terms)

    @property
    def symmetric(self) -> bool:
        """Whether K is symmetric, as all terms say of their share."""
        return all(term.symmetric for term in self.terms)

    def damage_changed(self) -> None:
        """Cells lost stiffness: those without any stress are not integrated from here on (not collective)."""
        for term in self.terms:
            term.damage_changed()
        if (dead := self.stress.dead_cells) is not None:
            self._work.exclude_cells(dead)
            self._work_at_supports.exclude_cells(dead)
        if self.scheme.implicit:
            self.tangent.damage_changed()

    # --- figures ---

    def kinetic_energy(self, v: Values) -> float:
        """This rank's share of 1/2 v . M v and of what terms move beside the body, J."""
        return 0.5 * float(v @ self.mass.multiply(v)) + sum(term.kinetic_energy() for term in self.terms)

    def applied_forces(self) -> Values:
        """(owned dofs,) forces on the body from outside at the current u, N; a copy (collective)."""
        forces = [force for term in self.terms if (force := term.applied_forces()) is not None]
        return sum(forces[1:], forces[0].copy()) if forces else np.zeros(self.owned_dof_count)

    def damping_forces(self) -> Values | None:
        """(owned dofs,) forces whose work is lost, N; None where nothing damps (collective)."""
        forces = [force for term in self.terms if (force := term.damping_forces()) is not None]
        return sum(forces[1:], forces[0]) if forces else None

    def force_scale(self) -> tuple[float, float]:
        """(size, round-off) of the forces in the residual, N, as root sums of squares over all dofs.

        Size: what the residual is the balance of, reactions and the terms' scales. Round-off: eps times what the
        residual is made of, the stiffness Y h^(d-2) of a node times the extent of the body and its displacement, and
        M c_a u. Some 8 of these are left of a body far from where it began, more than all its forces in a short step.
        """
        u = self.u.x.array[: self.owned_dof_count]
        scales = [scale for term in self.terms if (scale := term.reference_forces()) is not None]
        parts = (*scales, self.reactions[self.motion.owned_dofs], u, self.mass.lumped * u if self.c_a else 0.0)
        *loads, moved, carried = np.sqrt(
            sum_over_ranks(self.domain.comm, np.array([np.sum(np.square(part)) for part in parts]))
        )
        (stiffness, extent), eps = self._stiffest, np.finfo(float).eps
        return float(max(loads)), float(eps * (stiffness * extent + 8 * (stiffness * moved + self.c_a * carried)))

    @cached_property
    def _stiffest(self) -> tuple[float, float]:
        """(largest Y h^(d-2), N/m; extent of the body as a root sum of squares over all dofs, m)."""
        domain = self.domain
        dofs = domain.space.dofmap.index_map.size_global * domain.dim
        young = domain.comm.allreduce(float(np.max(self.stress.material.young, initial=0.0)), op=MPI.MAX)
        return float(young * domain.mean_edge_length ** (domain.dim - 2)), float(domain.size * np.sqrt(dofs))

    def destroy(self) -> None:
        """Give the memory of PETSc's objects back; nothing may be asked any more."""
        for kept in (self.work_vector, self._kept, self._assembler, self.mass, *self.terms):
            kept.destroy()
        if self.scheme.implicit:
            self.tangent.destroy()
