"""A body made of mesh, material and terms, without a study: what the scene does, by hand."""

from __future__ import annotations

import numpy as np
import pytest
from dolfinx import fem
from mpi4py import MPI

from fracsim.forms.schemes import Newmark
from fracsim.mechanics.balance import Balance
from fracsim.mechanics.inertia import Inertia, LumpedMass
from fracsim.mechanics.material_fields import coefficient, material_fields
from fracsim.mechanics.matrix_assembly import VectorAssembler
from fracsim.mechanics.prescribed_motion import PrescribedMotion
from fracsim.mechanics.stress import Stress
from fracsim.mechanics.time_functions import constant_function
from fracsim.mesh.domain import distribute
from fracsim.mesh.selection import select_nodes
from fracsim.mesh.selectors import Group
from fracsim.meshes.builders.box import Box
from fracsim.solvers.nonlinear_solver import NonlinearSolver
from fracsim.timestepping.implicit import ImplicitStepper
from fracsim.timestepping.inelastic_update import NoFracture, NoPlasticFlow
from fracsim.timestepping.step_sizes import StepSizes

LENGTH, YOUNG, DENSITY = 2.0, 8.0, 2.0  # m, Pa, kg/m^3: waves of 2 m/s


def test_a_bar_swings_in_its_first_mode() -> None:
    """Held at x = 0, free at L, nu = 0, set off with v = sin(k x), k = pi / (2 L):

        u(x, t) = sin(k x) sin(w t) / w,   w = k sqrt(E / rho).

    40 elements along the bar change the frequency by (k h)^2 / 24 = 6e-5, the trapezoidal rule in 100 steps a period
    by (w dt)^2 / 12 = 3e-4, and so sin(w t) by less than pi / 2 times both in a quarter of the period.
    """
    k = np.pi / (2 * LENGTH)
    w = k * np.sqrt(YOUNG / DENSITY)
    dt = 2 * np.pi / w / 100

    domain = distribute(MPI.COMM_SELF, Box(size=(LENGTH, 0.1), h=0.05).build())
    assembler, u = VectorAssembler(domain), fem.Function(domain.space)
    material = material_fields(domain, "linear", young=YOUNG, poisson=0.0, density=DENSITY)
    left, right = select_nodes(domain, Group("left")), select_nodes(domain, Group("right"))
    motion = PrescribedMotion(domain, [(left, np.array([True, True]), constant_function([0.0, 0.0]))])
    mass = LumpedMass(assembler, coefficient(domain, DENSITY))
    terms = [Stress(assembler, u, material), Inertia(u, mass)]
    balance = Balance(assembler, u, terms, motion, mass, Newmark(), dt)
    sizes = StepSizes(dt, end=25 * dt, smallest=dt)
    stepper = ImplicitStepper(balance, sizes, NoPlasticFlow(), NoFracture(balance), NonlinearSolver(balance, {}))
    state = stepper.start((np.sin(k * domain.nodes[:, :1]) * [1.0, 0.0]).reshape(-1))
    while state.step < 25:
        state, report = stepper.advance(state)
        tip = state.u.reshape(-1, 2)[right, 0].mean()
        assert tip * w == pytest.approx(np.sin(w * state.t), abs=6e-4)

    # at the turn all that the bar had of kinetic energy, rho A L / 4 at the start, is elastic
    assert report.elastic == pytest.approx(DENSITY * 0.1 * LENGTH / 4, rel=1e-3)
    assert report.kinetic < 1e-3 * report.elastic
