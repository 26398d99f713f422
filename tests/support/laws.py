"""UFL energies evaluated at a deformation gradient without DOLFINx, rotations to try them on, M22's matrix T."""

from __future__ import annotations

from functools import cache, cached_property
from typing import Any

import basix.ufl
import numpy as np
import numpy.typing as npt
import ufl
from scipy.linalg import polar
from scipy.spatial.transform import Rotation
from ufl.algorithms.apply_algebra_lowering import apply_algebra_lowering
from ufl.algorithms.apply_derivatives import apply_derivatives
from ufl.algorithms.expand_indices import expand_indices
from ufl.algorithms.transformer import strip_variables
from ufl.utils.stacks import StackDict

from fracsim.forms.energies import Energy, cauchy_stress, first_piola_kirchhoff, full_cauchy_stress
from fracsim.mesh.simplices import local_edges

Tensor = npt.NDArray[np.float64]


class Law:
    """psi, P and the Cauchy stress of an energy as functions of a NumPy F (d x d)."""

    def __init__(self, energy: Energy, dim: int) -> None:
        mesh = ufl.Mesh(basix.ufl.element("Lagrange", {2: "triangle", 3: "tetrahedron"}[dim], 1, shape=(dim,)))
        self._F, self._R = ufl.Constant(mesh, (dim, dim)), ufl.Constant(mesh, (dim, dim))
        self._rotates = energy.needs_rotation
        self._arguments = (energy, self._F, self._R if energy.needs_rotation else None)

    @cached_property
    def _psi(self) -> Any:
        return _plain(self._arguments[0].psi(*self._arguments[1:]))

    @cached_property
    def _P(self) -> list[list[Any]]:
        return _entries(first_piola_kirchhoff(*self._arguments))

    @cached_property
    def _cauchy(self) -> list[list[Any]]:
        return _entries(cauchy_stress(*self._arguments))

    @cached_property
    def _full(self) -> list[list[Any]]:
        return _entries(full_cauchy_stress(*self._arguments))

    def psi(self, F: Tensor) -> float:
        return _value(self._psi, self._values(F))

    def P(self, F: Tensor) -> Tensor:
        return self._tensor(self._P, F)

    def cauchy(self, F: Tensor) -> Tensor:
        return self._tensor(self._cauchy, F)

    def full_cauchy(self, F: Tensor) -> Tensor:
        return self._tensor(self._full, F)

    def _values(self, F: Tensor) -> dict[Any, Tensor]:
        return {self._F: F, self._R: polar(F)[0]} if self._rotates else {self._F: F}

    def _tensor(self, expression: Any, F: Tensor) -> Tensor:
        values = self._values(F)
        return np.array([[_value(entry, values) for entry in row] for row in expression])


def _plain(expression: Any) -> Any:
    """Derivatives carried out, so that the expression can be evaluated.

    Variables go first: expand_indices keeps one component of a tensor-valued variable for all (UFL 2024.2).
    """
    return expand_indices(strip_variables(apply_derivatives(apply_algebra_lowering(expression))))


def _value(plain: Any, values: dict[Any, Tensor]) -> float:
    """What calling the expression gives; that would look for derivatives in it first, each time."""
    return float(plain.evaluate((), values, (), StackDict()))


def _entries(tensor: Any) -> list[list[Any]]:
    return [[_plain(tensor[i, j]) for j in range(tensor.ufl_shape[1])] for i in range(tensor.ufl_shape[0])]


@cache
def law_of(energy: Energy, dim: int) -> Law:
    """A law, made once."""
    return Law(energy, dim)


def rotation(dim: int, seed: int) -> Tensor:
    """A random rotation matrix."""
    if dim == 3:
        return Rotation.random(random_state=seed).as_matrix()
    angle = np.random.default_rng(seed).uniform(0, 2 * np.pi)
    return np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])


def T_stress(corners: Tensor) -> Tensor:
    """Rows turn stress components into normal stress along one edge: n_i^2 on normal, 2 n_i n_j on shear components."""
    rows = []
    for i, j in local_edges(corners.shape[1]):
        n = (corners[j] - corners[i]) / np.linalg.norm(corners[j] - corners[i])
        if len(n) == 2:
            rows.append([n[0] ** 2, n[1] ** 2, 2 * n[0] * n[1]])
        else:
            rows.append([*(n**2), 2 * n[0] * n[1], 2 * n[0] * n[2], 2 * n[1] * n[2]])
    return np.array(rows)
