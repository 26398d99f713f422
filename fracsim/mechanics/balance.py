"""Residual and tangent of one time step: internal and viscous forces from compiled forms, inertia from a kept vector.

    r(u) = f_int(u) + M (c_a (u - u_a) + a c_v (u - u_v)) + f_visc(u) - f_ext
    K(u) = d f_int / d u + (c_a + a c_v) M + ...

M is made once (mechanics.inertia) and added; as a term of the form it would be integrated anew in every tangent.
"""

from __future__ import annotations

from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt
import ufl
from dolfinx import fem
from dolfinx.fem import petsc as fem_petsc
from mpi4py import MPI
from petsc4py import PETSc

from ..forms.balance import pressure_work, traction_work, viscous_work
from ..forms.schemes import Scheme
from ..mesh.domain import Domain
from ..mesh.ranks import total
from ..study import Study
from .inertia import ConsistentMass, LumpedMass, Mass
from .kernels import CellForm, compile_form, over
from .loads import Forces, Motion
from .material import MaterialFields, _coefficient
from .stress import InternalForces
from .tangent import Assembly

Values = npt.NDArray[np.float64]


class Equilibrium:
    """The discrete equations of a study on its mesh.

    Attributes:
        u: displacement (m), the unknown; u_n: the same at the start of the step (only with stiffness damping).
        internal: the stress, with the fields of damage: chi, integrity, energy and rotation are its own.
        inertia: the mass matrix.    mass: (owned dofs,) lumped mass of each dof, kg.
        held: owned dofs whose motion is prescribed.    free: (owned dofs,) bool, all others.
        unbalanced: (owned dofs,) r before rows of prescribed dofs are replaced; on those rows it is the reaction, N.
        external: (owned dofs,) dead loads, N.
    """

    def __init__(self, domain: Domain, study: Study, material: MaterialFields, scheme: Scheme) -> None:
        self.domain, self.material, self.scheme = domain, material, scheme
        self.u = fem.Function(domain.space, name="displacement")
        self.c_a, self.c_v = scheme.rates(study.time.step)
        self.internal = InternalForces(domain, self.u, study, material, scheme.inertia)
        self.chi, self.integrity, self.energy = self.internal.chi, self.internal.integrity, self.internal.energy
        self.rotation = self.internal.rotation
        self.damping = study.damping
        self.u_n: Any = None
        self.u_v: Any = None
        self.motion = Motion(domain, study.boundary)
        density = _coefficient(domain, material.density)
        self.forces = Forces(domain, study, density)
        self._owned = domain.node_count * domain.dim
        self.held = self.motion.dofs[: self.motion.owned]
        self.free = np.ones(self._owned, bool)
        self.free[self.held] = False
        self._compile(study, density)
        self._make_vectors()
        self.inertia = self._make_mass(study, density)
        self.mass = self.inertia.lumped
        self._references: tuple[Values, Values] = (self.u.x.array[: self._owned],) * 2

    # --- set-up ---

    def _compile(self, study: Study, density: Any) -> None:
        domain, internal = self.domain, self.internal
        w, dx = ufl.TestFunction(domain.space), over(domain.mesh, np.arange(domain.cell_count, dtype=np.int32))
        work = internal.work(w, dx)
        self._internal_form, self._energy = CellForm(work), compile_form(internal.stored(dx))
        viscous, pressure = self._viscous(w, dx), self._pressure(w)
        self._viscous_form = CellForm(viscous) if viscous else None
        self._pressure_form = compile_form(pressure) if pressure else None
        others = viscous + pressure
        self._residual = CellForm(work + others)
        near = over(domain.mesh, self._cells_at_supports())
        self._reactions = CellForm(internal.work(w, near) + self._viscous(w, near) + pressure)
        forms = self._internal_form, self._viscous_form, self._residual, self._reactions
        self._of_stress = [form for form in forms if form is not None]
        if self.scheme.implicit:
            v = ufl.TrialFunction(domain.space)
            tangent = CellForm(internal.stiffness(v, w, dx) + (ufl.derivative(others, self.u, v) if others else 0))
            self._of_stress.append(tangent)
            self._assembly = Assembly(tangent)
        self._dead = self._dead_loads(w, dx)

    def _viscous(self, w: Any, dx: ufl.Measure) -> ufl.Form | int:
        """Stiffness-proportional damping; the start of the step and c_v are coefficients that `begin` moves."""
        if self.damping is None or self.damping.stiffness == 0:
            return 0
        if self.u_n is None:
            space = self.domain.space
            self.u_n, self.u_v = fem.Function(space), fem.Function(space)
            self._c_v = fem.Constant(self.domain.mesh, np.float64(0.0))
        rate = self._c_v * (self.u - self.u_v)
        chi = self.internal.stiffness_left
        return viscous_work(self.material.energy, rate, self.u_n, w, dx, b=self.damping.stiffness, chi=chi)

    def _pressure(self, w: Any) -> ufl.Form | int:
        normal, linear = ufl.FacetNormal(self.domain.mesh), self.material.energy.linear
        terms = [pressure_work(p, self.u, w, normal, ds, linear=linear) for p, ds in self.forces.pressures]
        return -sum(terms) if terms else 0

    def _dead_loads(self, w: Any, dx: ufl.Measure) -> fem.Form | None:
        terms = [traction_work(t, w, ds) for t, ds in self.forces.tractions]
        if self.forces.body is not None:
            terms.append(ufl.inner(self.forces.body, w) * dx)
        return compile_form(sum(terms)) if terms else None

    def _make_vectors(self) -> None:
        self.residual = fem_petsc.create_vector(self._residual)
        self._work = fem_petsc.create_vector(self._residual)
        self.external: Values = np.zeros(self._owned)
        self.unbalanced = np.zeros(self._owned)
        self._prescribed = fem.Function(self.domain.space)
        self.bcs = [self._condition()] if self.domain.comm.allreduce(len(self.motion.dofs)) else []

    def _make_mass(self, study: Study, density: Any) -> Mass:
        if study.time.mass == "consistent":
            return ConsistentMass(self.domain, density, self.residual, self.bcs)
        return LumpedMass(self.domain, density, self.residual)

    def _condition(self) -> fem.DirichletBC:
        # A condition on single components of a blocked space: dofs of the sub-space's parent, values from the space.
        dofs = self.motion.dofs
        pair: Any = [dofs, dofs]
        return fem.dirichletbc(self._prescribed, pair, self.domain.space.sub(0))

    def _assembled(self, form: fem.Form) -> Values:
        """(owned dofs,) copy of an assembled linear form."""
        return self._assemble_into(self._work, form).array_r.copy()

    def _assemble_into(self, b: PETSc.Vec, form: fem.Form) -> PETSc.Vec:
        with b.localForm() as local:
            local.set(0.0)
        fem_petsc.assemble_vector(b, form)
        b.ghostUpdate(PETSc.InsertMode.ADD, PETSc.ScatterMode.REVERSE)
        return b

    def leave_out_dead_cells(self) -> None:
        """Cells without stress are not integrated from here on: they would add zeros for ever (not collective)."""
        dead = self.internal.dead
        if dead is not None:
            for form in self._of_stress:
                form.leave_out(dead)

    @property
    def tangent(self) -> PETSc.Mat:
        """The matrix of K, until `fit_tangent` makes another."""
        return self._assembly.matrix

    def fit_tangent(self, share: float) -> bool:
        """Give up the tangent's entries of dead cells where at most that share of its cells are alive; whether it is a
        new matrix (collective)."""
        dead = self.internal.dead
        return dead is not None and self.inertia.diagonal and self._assembly.fit(dead, share)

    def exchange_damage(self, values: list[Values]) -> list[Values]:
        """Put in what `internal.damage` has returned, and its living cells; returns what was there."""
        found = self.internal.exchange_damage(values)
        self.leave_out_dead_cells()
        return found

    # --- a step ---

    def begin(self, t: float, dt: float, start: Values, v: Values, a: Values) -> None:
        """Set the end time, the loads and the scheme's references; `start`, v, a are the owned state at t - dt."""
        self.c_a, self.c_v = self.scheme.rates(dt)
        late = self.scheme.alpha_f
        if self.material.plastic is not None:
            self.material.plastic.begin((1 - late) * dt)
        held = (1 - late) * self.motion.at(t) + late * self.motion.at(t - dt)
        u_a, u_v = self.scheme.references(dt, start, v, a)
        if self.scheme.rings and not late:
            u, own = held[: len(self.held)], self.held
            rate, change = driven(dt, u, start[own], v[own])
            u_a[own], u_v[own] = u - change / self.c_a, u - rate / self.c_v
        self._refer(t - late * dt, held, start, u_a, u_v)

    def hold(self, t: float, u: Values, v: Values, a: Values | None = None) -> None:
        """Put the body at u with velocity v and acceleration a (none where not given) at time t."""
        self.displace(u)
        u_a = u - a / self.c_a if a is not None and self.c_a else u
        self._refer(t, self.motion.at(t), u, u_a, u - v / self.c_v)

    def _refer(self, t: float, held: Values, start: Values, u_a: Values, u_v: Values) -> None:
        self._references = u_a, u_v
        self._prescribed.x.array[self.motion.dofs] = held
        self.set_loads(t)
        if self.u_n is not None:
            self.u_n.x.array[: self._owned] = start
            self.u_v.x.array[: self._owned] = u_v
            self.u_n.x.scatter_forward()
            self.u_v.x.scatter_forward()
            self._c_v.value = self.c_v

    def set_loads(self, t: float) -> None:
        """Dead loads at time t, assembled only where they changed."""
        if self.forces.set_time(t) and self._dead is not None:
            self.external = self._assembled(self._dead)

    def rates(self) -> tuple[Values, Values]:
        """(v, a) of the owned dofs at the current u."""
        u = self.u.x.array[: self._owned]
        u_a, u_v = self._references
        return self.c_v * (u - u_v), self.c_a * (u - u_a)

    @property
    def _mass_factors(self) -> tuple[float, float]:
        """Factors of M in front of (u - u_a) and (u - u_v)."""
        drag = self.damping.mass if self.damping is not None else 0.0
        return self.c_a, drag * self.c_v

    def load_displacement(self, x: PETSc.Vec, *, hold: bool = True) -> None:
        """Bring an iterate into u, ghosts included; `hold`: with prescribed dofs at their values."""
        u = x.array_r.copy()
        if hold:
            u[self.held] = self._prescribed.x.array[self.held]
        self.displace(u)

    def assemble_residual(self, snes: Any, x: PETSc.Vec, b: PETSc.Vec) -> None:
        """r(u) into b, zero on rows of prescribed dofs, which hold their values in every iterate.

        Rows u - u_prescribed instead would mix metres with newtons in one norm, and leave prescribed dofs as inexact as
        the Krylov solve.
        """
        self.load_displacement(x)
        self._assemble_into(b, self._residual)
        self._add_inertia(b)
        np.copyto(self.unbalanced, b.array_r)
        b.array_w[self.held] = 0.0

    def assemble_extension(self, x: PETSc.Vec, b: PETSc.Vec) -> None:
        """r + K (u_prescribed - u) at an x whose prescribed dofs are not at their values yet.

        The linear way to carry a jump of the boundary into the body before Newton starts; cells at the boundary would
        otherwise take all of it and may turn inside out.
        """
        self.load_displacement(x, hold=False)
        with b.localForm() as local:
            local.set(0.0)
        fem_petsc.assemble_vector(b, self._residual)
        fem_petsc.apply_lifting(b, [self._assembly.form], [self.bcs], x0=[self.u.x.petsc_vec], alpha=-1.0)
        b.ghostUpdate(PETSc.InsertMode.ADD, PETSc.ScatterMode.REVERSE)
        self._add_inertia(b)
        b.array_w[self.held] = 0.0

    def largest_gap(self, u: Values) -> float:
        """Farthest that a prescribed dof of the owned values `u` is from its value, in mean edge lengths."""
        if not self.bcs:
            return 0.0
        gap = np.max(np.abs(u[self.held] - self._prescribed.x.array[self.held]), initial=0.0)
        return float(self.domain.comm.allreduce(gap, op=MPI.MAX)) / self.domain.mean_edge

    def forces_in_balance(self) -> Values:
        """(owned dofs,) f_int + f_visc - f_ext at the current u, kept as `unbalanced` (explicit steps)."""
        self._assemble_into(self._work, self._residual)
        self._add_inertia(self._work)
        np.copyto(self.unbalanced, self._work.array_r)
        return self.unbalanced

    def update_reactions(self) -> None:
        """Refresh `unbalanced` on prescribed dofs alone: a residual over the few cells that touch them."""
        self._assemble_into(self._work, self._reactions)
        self._add_inertia(self._work)
        self.unbalanced[self.held] = self._work.array_r[self.held]

    def _cells_at_supports(self) -> npt.NDArray[np.int32]:
        """Owned cells with a prescribed dof."""
        touched = np.zeros(len(self.domain.nodes), bool)
        touched[self.motion.dofs // self.domain.dim] = True
        return np.flatnonzero(touched[self.domain.cell_nodes].any(axis=1)).astype(np.int32)

    def _add_inertia(self, b: PETSc.Vec) -> None:
        c_mass, c_drag = self._mass_factors
        rows = b.array_w
        rows -= self.external
        u, (u_a, u_v) = self.u.x.array[: self._owned], self._references
        if c_mass or c_drag:
            rows += self.inertia.times(c_mass * (u - u_a) + c_drag * (u - u_v))

    def assemble_tangent(self, snes: Any, x: PETSc.Vec, A: PETSc.Mat, P: PETSc.Mat) -> None:
        """K(u) into A, rows and columns of prescribed dofs replaced by the identity's."""
        self._assembly(self.bcs)
        c_mass, c_drag = self._mass_factors
        if c_mass or c_drag:
            self.inertia.add_to(A, c_mass + c_drag)

    def displace(self, u: Values) -> None:
        """Put the owned values of a displacement into u, ghosts included."""
        self.u.x.array[: self._owned] = u
        self.u.x.scatter_forward()
        if self.rotation is not None:
            self.rotation.update()

    # --- figures ---

    def elastic_energy(self) -> float:
        """This rank's share of int chi psi dX, J."""
        return float(fem.assemble_scalar(self._energy))

    def kinetic_energy(self, v: Values) -> float:
        """This rank's share of 1/2 v . M v, J."""
        return 0.5 * float(v @ self.inertia.times(v))

    def viscous_force(self) -> Values | None:
        """(owned dofs,) damping forces at the current step, N; None where there is no damping."""
        if self.damping is None:
            return None
        force = self.damping.mass * self.inertia.times(self.rates()[0])
        return force + self._assembled(self._viscous_form) if self._viscous_form is not None else force

    def internal_force(self) -> Values:
        """(owned dofs,) forces of the stress at the current u, without damping or pressure, N."""
        return self._assembled(self._internal_form)

    def corners(self, cells: npt.NDArray[np.integer]) -> Values:
        """(n, d + 1, d) corners of cells in the configuration that the energy's stress belongs to, m."""
        nodes, d = self.domain.cell_nodes[cells], self.domain.dim
        corners = self.domain.nodes[nodes]
        return corners if self.energy.linear else corners + self.u.x.array.reshape(-1, d)[nodes]

    def nodal_forces(self) -> Values:
        """(owned and ghost dofs,) forces of the stress at the current u, N."""
        result = fem.Function(self.domain.space)
        result.x.array[: self._owned] = self.internal_force()
        result.x.scatter_forward()
        return np.asarray(result.x.array)

    def applied_force(self) -> Values:
        """(owned dofs,) dead loads and pressures on the current shape, N."""
        if self._pressure_form is None:
            return self.external
        return self.external - self._assembled(self._pressure_form)

    def force_scale(self) -> tuple[float, float]:
        """(size, round-off) of the forces in the residual, N, as root sums of squares over all dofs.

        Size: reactions, inertia and dead loads, which the residual is the balance of. Round-off: eps times what the
        residual is made of, the stiffness Y h^(d-2) of a node times the extent of the body and its displacement, and
        M c_a u. Some 8 of these are left of a body far from where it began, more than all its forces in a short step.
        """
        c_mass, _ = self._mass_factors
        u = self.u.x.array[: self._owned]
        inertia = c_mass * self.mass * (u - self._references[0]) if c_mass else 0.0
        reactions = self.unbalanced[self.held]
        parts = (inertia, self.external, reactions, u, self.mass * u if c_mass else 0.0)
        *loads, moved, carried = np.sqrt(total(self.domain.comm, np.array([np.sum(np.square(part)) for part in parts])))
        (stiffness, extent), eps = self._stiffest, np.finfo(float).eps
        return float(max(loads)), float(eps * (stiffness * extent + 8 * (stiffness * moved + c_mass * carried)))

    @cached_property
    def _stiffest(self) -> tuple[float, float]:
        """(largest Y h^(d-2), N/m; extent of the body as a root sum of squares over all dofs, m)."""
        domain = self.domain
        dofs = domain.space.dofmap.index_map.size_global * domain.dim
        young = domain.comm.allreduce(float(np.max(self.material.young, initial=0.0)), op=MPI.MAX)
        return float(young * domain.mean_edge ** (domain.dim - 2)), float(domain.size * np.sqrt(dofs))


def driven(dt: float, u: Values, start: Values, v: Values) -> tuple[Values, Values]:
    """(velocity, acceleration) of prescribed dofs over a step, from u at its ends and the velocity before.

    They move by their own law: Newmark's formulae would swing about a velocity that jumps for ever.
    """
    rate = np.asarray((u - start) / dt, np.float64)
    return rate, np.asarray((rate - v) / dt, np.float64)
