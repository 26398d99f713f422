"""Rayleigh damping a M v + b K v: mass-proportional drag and stiffness-proportional viscosity.

Equations: docs/theory.md#elastic-energies.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import ufl
from dolfinx import fem
from ufl.core.expr import Expr

from ..forms.balance import viscous_work
from .inertia import MassMatrix
from .jit import CellForm, cell_measure
from .matrix_assembly import VectorAssembler
from .stress import Stress
from .term import Term, TimeLevel

Values = npt.NDArray[np.float64]


class Drag(Term):
    """Mass-proportional damping a M v, with the velocity v = c_v (u - u_v) of the time level.

    Attributes:
        a: coefficient, 1/s.
    """

    name = "drag"
    linear = True

    def __init__(self, u: fem.Function, mass: MassMatrix, a: float) -> None:
        self.a = a
        self._u, self._mass = u, mass
        self._level: TimeLevel | None = None

    def begin_step(self, level: TimeLevel) -> None:
        """Take the velocity of the time level."""
        self._level = level

    @property
    def mass_factor(self) -> float:
        """Factor a c_v, 1/s^2."""
        assert self._level is not None
        return self.a * self._level.c_v

    def acceleration(self) -> Values:
        """(owned dofs,) a c_v (u - u_v), m/s^2."""
        assert self._level is not None
        u_v = self._level.u_v
        return np.asarray(self.mass_factor * (self._u.x.array[: len(u_v)] - u_v))

    def potential(self) -> float:
        """Potential a c_v (u - u_v) . M (u - u_v) / 2, J."""
        a = self.acceleration()
        return float(a @ self._mass.multiply(a)) / (2 * self.mass_factor) if self.mass_factor else 0.0

    def damping_forces(self) -> Values:
        """(owned dofs,) a M v, N."""
        assert self._level is not None
        level, u = self._level, self._u.x.array[: len(self._level.u_v)]
        return self.a * self._mass.multiply(level.c_v * (u - level.u_v))


class Viscosity(Term):
    """Stiffness-proportional damping int chi b (C : Edot) : sym(F_p^T grad w) dX (forms.balance.viscous_work).

    Attributes:
        b: coefficient, s.
    """

    name = "viscosity"

    def __init__(self, assembler: VectorAssembler, u: fem.Function, stress: Stress, b: float) -> None:
        domain = assembler.domain
        self.b = b
        self._assembler, self._u, self._stress, self.linear = assembler, u, stress, stress.linear
        self._u_p, self._u_v = fem.Function(domain.space), fem.Function(domain.space)
        self._c_v = fem.Constant(domain.mesh, np.float64(0.0))
        self._form = CellForm(self.virtual_work(ufl.TestFunction(domain.space), cell_measure(domain)))

    def begin_step(self, level: TimeLevel) -> None:
        """Predict the displacement at the time level, and take its velocity."""
        predicted = level.u_n + level.fraction * level.dt * level.v_n
        for field, values in ((self._u_p, predicted), (self._u_v, level.u_v)):
            field.x.array[: len(values)] = values
            field.x.scatter_forward()
        self._c_v.value = level.c_v

    def virtual_work(self, w: Expr, dx: ufl.Measure) -> ufl.Form:
        """Virtual work of the viscous stress, N m."""
        stress, rate = self._stress, self._c_v * (self._u - self._u_v)
        chi = stress.degradation_factor
        return viscous_work(stress.material.energy, rate, self._u_p, w, dx, b=self.b, chi=chi)

    def tangent_form(self, v: Expr, w: Expr, dx: ufl.Measure) -> ufl.Form:
        """Derivative of the virtual work in the direction v."""
        return ufl.derivative(self.virtual_work(w, dx), self._u, v)

    def damping_forces(self) -> Values:
        """(owned dofs,) viscous forces, N (collective)."""
        return self._assembler(self._form)

    def damage_changed(self) -> None:
        """Cells without stress have no viscosity either."""
        if (dead := self._stress.dead_cells) is not None:
            self._form.exclude_cells(dead)
