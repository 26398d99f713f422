"""Impulses of all contacts of an event, with Coulomb friction.

Up to a few hundred contacts are solved by MuJoCo: a convex problem with elliptic friction cones, by Newton's method.
More contacts, and those whose solution by MuJoCo is not accurate, are solved by accelerated projected gradients on

    K_mu  3  p  _|_  u + (r / dt + mu |u_t|) n,   u = u_0 + J M^-1 J^T p,   K_mu = {|p_t| <= mu p_n}

with impulses p, velocities u of the second body relative to the first after the step, u_0 without impulses, and r the
distance that they may approach (G. De Saxce, Z.-Q. Feng 1991). The term mu |u_t| makes it Coulomb's law; without it the
convex problem separates bodies that slip.

Contacts that do not come close enough to touch are left out, and checked with the velocities of the solution.

Equations: docs/theory.md#motion-and-contact-of-rigid-bodies.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np
import numpy.typing as npt

from ..errors import NotConverged
from .bodies import Bodies, apply_contact_forces, forces_for_velocity_changes, quaternions, velocities_of_all
from .contact_law import LAW, impacts_later
from .contact_points import ContactImpulses, Contacts
from .impact_sequence import ImpactEvent
from .mujoco_model import ContactParameters, MujocoModel
from .projected_gradient import ProjectedGradientSolver

Ints = npt.NDArray[np.int64]
Values = npt.NDArray[np.float64]
Flags = npt.NDArray[np.bool_]
# Velocities and spins (n, 3).
Motions = tuple[Values, Values]

# Fields of MuJoCo's contacts that are the same in all of them.
CONTACT_FIELDS = ("dim", "solref", "solreffriction", "solimp", "includemargin", "efc_address", "mu", "H", "flex",
                  "elem", "vert", "adhesion", "surfacevel")  # fmt: skip
# Stages of MuJoCo's forward dynamics that follow the assembly of the constraints.
SOLVER_STAGES = (mujoco.mj_island, mujoco.mj_projectConstraint, mujoco.mj_fwdVelocity, mujoco.mj_fwdAcceleration,
                 mujoco.mj_fwdConstraint)  # fmt: skip


@dataclass(frozen=True)
class ContactSolverSettings:
    """Numbers of both contact solvers.

    Attributes:
        impedance: of MuJoCo's contacts, whose compliance is 1 - impedance per step; MuJoCo admits no harder ones.
        newton_tolerance: of MuJoCo's solver, relative to the mean inertia.
        newton_iterations: largest number of Newton iterations.
        direct_iterations: Newton iterations after which softer contacts are solved first.
        compliance_factors: factors of the compliance in successive solutions of a difficult problem.
        island_rows: rows of the largest island above which MuJoCo's count of iterations is not checked by the first
            one.
        slip_rounds: largest number of updates of the slip speeds.
        slip_tolerance: c_0; the slip speeds are accepted when mu times their change is below.
        refining_work: contacts times iterations of projected gradients that may refine a solution of MuJoCo.
        max_newton_contacts: contacts in an event above which projected gradients take over.
        gradient_tolerance: c_0; accepted error of velocities.
        gradient_iterations: least number of iterations that projected gradients may take.
        gradient_work: contacts times iterations that they may take in any case.
        search_rounds: largest number of searches for contacts that were left out.
        rough_iterations: iterations of a rough solution.
        obstacle_mass: mass of a driven obstacle in MuJoCo, in masses of all bodies.
        bytes_per_body: memory for MuJoCo's arena.
        min_bytes: least memory for it.
    """

    impedance: float = 0.9999
    newton_tolerance: float = 1e-10
    newton_iterations: int = 200
    direct_iterations: int = 60
    compliance_factors: tuple[float, ...] = (100.0, 10.0, 1.0)
    island_rows: int = 300
    slip_rounds: int = 10
    slip_tolerance: float = 0.02
    refining_work: int = 300_000
    max_newton_contacts: int = 300
    gradient_tolerance: float = 0.01
    gradient_iterations: int = 150
    gradient_work: int = 3_000_000
    search_rounds: int = 6
    rough_iterations: int = 30
    obstacle_mass: float = 1e6
    bytes_per_body: int = 2**18
    min_bytes: int = 2**26


SETTINGS = ContactSolverSettings()


# --- few contacts: MuJoCo ---


class MujocoNewtonSolver:
    """MuJoCo's solver for the contacts of the bodies and the driven obstacles of a model.

    It has a MuJoCo model of its own, of bodies without shapes. The model is made when it is first needed, since MuJoCo
    computes the inverse of the mass matrix for every body as it starts.
    """

    def __init__(self, model: MujocoModel, parameters: ContactParameters) -> None:
        """Compile the model; `parameters` has time step, gravity and friction."""
        n = self._count = len(model.mass)
        self._compiled = _dynamic_model(model, parameters)
        self._data, self._template = mujoco.MjData(self._compiled), _contact_template(parameters)
        moving = np.concatenate([np.arange(n), n + model.driven])
        things = int(np.concatenate([model.body_of_geom, moving]).max(initial=0)) + 1
        # geom 0 stands for everything that does not move
        self._geom = np.zeros(things, int)
        self._geom[moving] = 1 + np.arange(len(moving))

    def set_up(self, bodies: Bodies, positions: Values, rates: Values, contacts: Contacts, gravity: Values) -> None:
        """Set the state and the contacts of a step. Raises NotConverged if MuJoCo has no memory for them.

        Args:
            bodies: at the positions of the impacts.
            positions: (m, 3) of driven obstacles, m.
            rates: (m, 3) their velocities, m/s.
            contacts: all that may touch.
            gravity: (3,) m/s^2.
        """
        compiled, data, n = self._compiled, self._data, self._count
        compiled.opt.gravity[:] = gravity
        q, v = data.qpos.reshape(-1, 7), data.qvel.reshape(-1, 6)
        q[:n, :3], q[n:, :3] = bodies.position, positions
        q[:n, 3:], q[n:, 3:] = quaternions(bodies.rotation), [1.0, 0.0, 0.0, 0.0]
        v[:n, :3], v[n:, :3], v[n:, 3:] = bodies.velocity, rates, 0.0
        # MuJoCo has angular velocities in the axes of the bodies
        v[:n, 3:] = np.einsum("nji,nj->ni", bodies.rotation, bodies.spin)
        for stage in (mujoco.mj_kinematics, mujoco.mj_comPos, mujoco.mj_makeM, mujoco.mj_factorM):
            stage(compiled, data)
        self._write_contacts(contacts)
        # a warm start from the last step would give other digits after a restart
        data.qacc_warmstart[:] = 0.0

    def _write_contacts(self, contacts: Contacts) -> None:
        """Write the contacts into MuJoCo's arena; mj_addContact for every one takes ten times as long."""
        data, k = self._data, len(contacts)
        data.ncon = k
        records = data.contact
        data.parena = k * records.dist.strides[0]
        if data.parena >= data.narena:
            raise NotConverged(
                f"{k} contacts are more than the rigid engine has room for; a smaller time.step or a larger mesh.h has "
                "fewer"
            )
        for name in CONTACT_FIELDS:
            getattr(records, name)[:] = getattr(self._template, name)
        records.geom[:], records.pos[:] = self._geom[contacts.pairs], contacts.point
        records.frame[:] = contacts.axes.reshape(-1, 9)
        friction = np.maximum(contacts.friction, mujoco.mjMINMU)
        records.friction[:], records.friction[:, :2] = 0.0, friction[:, None]

    def solve(self, allowed_approach: Values, active: Flags) -> tuple[Values, Values, Flags]:
        """Return forces and moments of bodies, forces of contacts, and which contacts transmit a force.

        Args:
            allowed_approach: (k,) distance that the bodies may approach, m.
            active: (k,) contacts that are solved for.

        Returns:
            Forces and moments (n, 6), moments in the axes of the bodies, N and N m; forces (k, 3) along the axes of the
            contacts, N; flags (k,) of contacts under pressure.
        """
        data = self._data
        if not np.any(active):
            # all impacts are left to later events
            return np.zeros((self._count, 6)), np.zeros((len(active), 3)), active
        data.contact.dist[:], data.contact.exclude[:] = allowed_approach, ~active
        self._run_solver(1.0, SETTINGS.direct_iterations)
        if not self._has_converged():
            # Newton's method changes the set of closed contacts in every iteration, and may need many iterations for
            # it. Then softer contacts are solved first, of which each solution starts the next one.
            for factor in SETTINGS.compliance_factors:
                self._run_solver(factor, SETTINGS.newton_iterations)
        closed = active & (data.efc_force[data.contact.efc_address] > 0)
        rows, contact_force = np.flatnonzero(closed), np.zeros((len(active), 3))
        contact_force[rows] = data.efc_force[data.contact.efc_address[rows, None] + np.arange(3)]
        return data.qfrc_constraint.reshape(-1, 6)[: self._count].copy(), contact_force, closed

    def _run_solver(self, compliance_factor: float, max_iterations: int) -> None:
        """Solve with a multiple of the compliance, starting from the last solution."""
        compiled, data = self._compiled, self._data
        compiled.opt.iterations = max_iterations
        mujoco.mj_makeConstraint(compiled, data)
        if compliance_factor > 1:
            data.efc_R[:] *= compliance_factor
            data.efc_D[:] /= compliance_factor
        for stage in SOLVER_STAGES:
            stage(compiled, data)
        data.qacc_warmstart[:] = data.qacc

    def _has_converged(self) -> bool:
        """Return whether no island reached the limit of iterations."""
        data, islands = self._data, self._data.nisland
        # MuJoCo keeps the iterations of the first twenty islands only
        if not islands or data.island_nefc[:islands].max() < SETTINGS.island_rows:
            return bool(data.solver_niter[: max(islands, 1)].max() < SETTINGS.direct_iterations)
        counted = islands <= len(data.solver_niter)
        return counted and bool(data.solver_niter[:islands].max() < SETTINGS.direct_iterations)


def _dynamic_model(model: MujocoModel, parameters: ContactParameters) -> Any:
    """Return MuJoCo's model of bodies without shapes: one geom a body, to name it, and one for all that is fixed."""
    spec, driven = mujoco.MjSpec(), len(model.driven)
    option = spec.option
    option.timestep, option.gravity = parameters.time_step, parameters.gravity
    option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    # the tolerance is relative to the mean inertia, which driven obstacles raise
    option.tolerance = SETTINGS.newton_tolerance / (SETTINGS.obstacle_mass if driven else 1.0)
    option.iterations = SETTINGS.newton_iterations
    # round-off may give slivers an inertia that no body has
    spec.compiler.balanceinertia = True
    spec.memory = max(SETTINGS.min_bytes, SETTINGS.bytes_per_body * (len(model.mass) + driven))
    _add_name_geom(spec.worldbody)
    for mass, inertia in zip(model.mass, [*model.inertia], strict=True):
        _add_free_body(spec, float(mass), inertia)
    heavy = SETTINGS.obstacle_mass * max(float(model.mass.sum()), 1e-9)
    for _ in range(driven):
        _add_free_body(spec, heavy, heavy * np.eye(3), weightless=True)
    return spec.compile()


def _add_free_body(spec: Any, mass: float, inertia: Values, weightless: bool = False) -> None:
    """Add a body with a free joint at its centre of mass; inertia (3, 3), kg m^2."""
    body = spec.worldbody.add_body()
    body.add_freejoint()
    body.explicitinertial, body.mass, body.ipos = True, mass, np.zeros(3)
    body.fullinertia = inertia[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]
    body.gravcomp = 1.0 if weightless else 0.0
    _add_name_geom(body)


def _add_name_geom(body: Any) -> None:
    """Add a geom that collides with nothing; contacts refer to a body by it."""
    geom = body.add_geom()
    geom.type, geom.size = mujoco.mjtGeom.mjGEOM_SPHERE, np.ones(3)
    geom.contype = geom.conaffinity = 0


def _contact_template(parameters: ContactParameters) -> Any:
    """Return a MuJoCo contact with reference acceleration -(c + r / dt) / dt, without bodies and position."""
    contact, hard = mujoco.MjContact(), SETTINGS.impedance
    contact.dim, contact.flex, contact.elem, contact.vert = 3, [-1, -1], [-1, -1], [-1, -1]
    contact.solref = [-hard / parameters.time_step**2, -hard / parameters.time_step]
    contact.solimp = [hard, hard, 1e-3, 0.5, 2.0]
    return contact


# --- either of them ---


def has_many_contacts(event: ImpactEvent) -> bool:
    """Return whether an event has too many contacts for Newton's method."""
    return np.count_nonzero(event.constraints.may_touch) > SETTINGS.max_newton_contacts


class ContactSolver:
    """Solver for the contact forces of an event, of the bodies of a model.

    Attributes:
        error: of the velocities of the last solution, m/s; 0 if it is below the speed at which overlapping bodies
            separate, which those that are jammed do not reach.
    """

    def __init__(self, model: MujocoModel, parameters: ContactParameters) -> None:
        """Keep the model; MuJoCo's solver is made when it is first needed."""
        self._model, self._parameters, self.error = model, parameters, 0.0
        self._newton: MujocoNewtonSolver | None = None

    def __call__(
        self, event: ImpactEvent, obstacle_points: Values, *, rough: bool
    ) -> tuple[Values, ContactImpulses, bool]:
        """Return contact forces of an event, the record of impulses, and whether the solution is accurate.

        Args:
            event: its flags of active contacts and its impulses are updated.
            obstacle_points: (m, 3) reference points of prescribed obstacles, m.
            rough: with many contacts, find an approximation that shows which contacts close.

        Returns:
            Forces and moments (n, 6), moments in the axes of the bodies, N and N m; the record; False if rough.
        """
        self.error = 0.0
        if not np.any(event.constraints.may_touch):
            return np.zeros((len(event.bodies), 6)), ContactImpulses.empty(), True
        if has_many_contacts(event):
            force, accurate = self._solve_by_gradients(event, SETTINGS.gradient_work, rough=rough), not rough
        else:
            force, accurate = self._refine(event, self._solve_by_newton(event, obstacle_points)), True
        if self.error <= LAW.recovery_speed * self._parameters.impact_threshold:
            self.error = 0.0
        rows = np.flatnonzero(event.impulse[:, 0] > 0)
        impact_speed = np.where(event.impacts, event.constraints.impact_speed, 0.0)
        return force, event.contacts.impulse_record(rows, event.impulse[rows], impact_speed), accurate

    def apply_forces(self, event: ImpactEvent, force: Values) -> Bodies:
        """Return the bodies of an event with the velocities that forces and moments (n, 6) give them in a step."""
        return apply_contact_forces(
            self._model, event.bodies, force, event.conditions.gravity, self._parameters.time_step
        )  # fmt: skip

    def _solve_by_newton(self, event: ImpactEvent, obstacle_points: Values) -> Values:
        """Return forces and moments (n, 6) by MuJoCo's solver."""
        dt, contacts, active, model = self._parameters.time_step, event.contacts, event.active, self._model
        threshold = self._parameters.impact_threshold
        rates, newton = event.bounds.obstacle_velocity, self._newton or MujocoNewtonSolver(model, self._parameters)
        self._newton = newton
        points = obstacle_points[model.driven]
        newton.set_up(event.bodies, points, rates[model.driven], contacts, event.conditions.gravity)
        # MuJoCo's convex problem separates contacts that slip with speed s at mu s. Therefore they may approach by
        # mu s dt more, with the slip speed of the solution, which is updated a few times.
        factor = dt * contacts.friction
        slip_approach = factor * contacts.slip_speeds(*velocities_of_all(event.bodies, rates), active)
        for _ in range(SETTINGS.slip_rounds):
            force, contact_force, closed = newton.solve(event.constraints.allowed_approach + slip_approach, active)
            motion = velocities_of_all(self.apply_forces(event, force), rates)
            missed = self._find_missed(event, active, motion)
            active, before = active | missed, slip_approach
            # with a slip speed that is too large the body would sink in by the difference in every step
            slip_approach = np.minimum(slip_approach, factor * contacts.slip_speeds(*motion, active))
            change = float((before - slip_approach)[closed].max(initial=0.0)) / dt
            if not np.any(missed) and change < SETTINGS.slip_tolerance * threshold:
                break
        # without the forces of earlier searches
        event.impulse[:] = np.where(closed[:, None], dt * contact_force, 0.0)
        event.active[:] = active
        return force

    def _refine(self, event: ImpactEvent, force: Values) -> Values:
        """Forces and moments (n, 6) of impulses that projected gradients have refined, unless `force` is accurate.

        MuJoCo separates pressed contacts, or lets them approach, where it has a wrong slip speed.
        """
        if not np.any(event.active):
            return force
        error, active, impulse = self._error_of(event), event.active.copy(), event.impulse.copy()
        if error <= self._tolerance:
            return force
        refined = self._solve_by_gradients(event, SETTINGS.refining_work, rough=False)
        if self.error < error:
            return refined
        self.error, event.active[:], event.impulse[:] = error, active, impulse
        return force

    @property
    def _tolerance(self) -> float:
        """Accepted error of velocities, m/s."""
        return SETTINGS.gradient_tolerance * self._parameters.impact_threshold

    def _error_of(self, event: ImpactEvent) -> float:
        """Error of the velocities that follow from the impulses of an event, m/s."""
        rows, free = np.flatnonzero(event.active), self._motion_without_contact(event)
        return self._system(event, rows, free).error(event.impulse[rows])

    def _motion_without_contact(self, event: ImpactEvent) -> Motions:
        """Velocities and spins of bodies and obstacles at the end of the step without contact forces."""
        bodies = self.apply_forces(event, np.zeros((len(event.bodies), 6)))
        return velocities_of_all(bodies, event.bounds.obstacle_velocity)

    def _system(self, event: ImpactEvent, rows: Ints, free: Motions) -> ProjectedGradientSolver:
        """Coulomb's law at contacts `rows` (k,) of bodies that move with `free` without contact."""
        bodies, model, contacts = event.bodies, self._model, event.contacts.select(rows)
        inverse = bodies.rotation @ model.inverse_inertia @ np.swapaxes(bodies.rotation, 1, 2)
        approach_rate: Values = np.asarray(event.constraints.allowed_approach[rows] / self._parameters.time_step)
        relative = contacts.relative_velocities(*free)
        return ProjectedGradientSolver.assemble(contacts, relative, approach_rate, model.mass, inverse)

    def _solve_by_gradients(self, event: ImpactEvent, work: int, *, rough: bool) -> Values:
        """Return forces and moments (n, 6) by projected gradients, starting from the impulses of the event.

        `work`: contacts times iterations that they may take.
        """
        rates, free = event.bounds.obstacle_velocity, self._motion_without_contact(event)
        for _ in range(1 if rough else SETTINGS.search_rounds):
            rows = np.flatnonzero(event.active)
            system = self._system(event, rows, free)
            iterations = max(SETTINGS.gradient_iterations, work // max(len(rows), 1))
            if rough:
                iterations = SETTINGS.rough_iterations
            event.impulse[rows], self.error = system.solve(self._tolerance, iterations, event.impulse[rows])
            change = system.velocity_changes(event.impulse[rows])
            force = forces_for_velocity_changes(self._model, event.bodies, change, self._parameters.time_step)
            motion = velocities_of_all(self.apply_forces(event, force), rates)
            missed = self._find_missed(event, event.active, motion)
            event.active |= missed
            if not np.any(missed):
                break
        error = self._closing_error(event, missed, motion)
        if error > self._tolerance:
            self.error = max(self.error, error)
        return force

    def _closing_error(self, event: ImpactEvent, missed: Flags, motion: Motions) -> float:
        """Return the largest speed, m/s, at which contacts `missed` (k,) would overlap at the end of the step."""
        if not np.any(missed):
            return 0.0
        overlap = self._closing_motion(event, event.contacts.approach_speeds(*motion)) - event.constraints.gap
        return float(overlap[missed].max()) / self._parameters.time_step

    def _closing_motion(self, event: ImpactEvent, speeds: Values) -> Values:
        """Return by how much gaps (k,) close in the rest of the step at approach speeds (k,), m."""
        return np.asarray(self._parameters.time_step * event.constraints.remaining_fraction * speeds)

    def _find_missed(self, event: ImpactEvent, active: Flags, motion: Motions) -> Flags:
        """Return (k,) flags of contacts beyond the active ones that close with velocities and spins `motion`."""
        parameters, constraints = self._parameters, event.constraints
        speeds = event.contacts.approach_speeds(*motion)
        missed: Flags = ~active & (constraints.gap < self._closing_motion(event, speeds))
        if event.is_last:
            return missed
        return missed & ~impacts_later(constraints.gap, speeds, parameters.time_step, parameters.impact_threshold)
