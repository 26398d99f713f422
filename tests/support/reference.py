"""Linear elasticity of P1 simplices in dense NumPy: what the program's matrices are compared with."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt
from petsc4py import PETSc
from scipy.linalg import eigh

from fracsim.scene import Scene

Values = npt.NDArray[np.float64]


def gradients(corners: Values) -> tuple[Values, Values]:
    """((n, d + 1, d) gradients of the hat functions, (n,) volumes): rows of the inverse of [1 x] but for the first."""
    n, k, dim = corners.shape
    homogeneous = np.concatenate([np.ones((n, k, 1)), corners], axis=2)
    return np.linalg.inv(homogeneous)[:, 1:].transpose(0, 2, 1), np.abs(np.linalg.det(homogeneous)) / math.factorial(
        dim
    )


def stiffness(
    nodes: Values, cells: npt.NDArray[np.integer], mu: float, lmbda: float, chi: Values | float = 1.0
) -> Values:
    """K of int 2 mu eps(u):eps(v) + lambda tr tr: per cell V (mu (g_a.g_b I + g_b x g_a) + lambda g_a x g_b)."""
    dim = nodes.shape[1]
    G, V = gradients(nodes[cells])
    V = V * chi
    dots = np.einsum("nai,nbi->nab", G, G)
    local = mu * np.einsum("nab,ij->naibj", dots, np.eye(dim)) + mu * np.einsum("naj,nbi->naibj", G, G)
    local = (local + lmbda * np.einsum("nai,nbj->naibj", G, G)) * V[:, None, None, None, None]
    dofs = (cells[:, :, None] * dim + np.arange(dim)).reshape(len(cells), -1)
    K = np.zeros((nodes.size, nodes.size))
    np.add.at(K, (dofs[:, :, None], dofs[:, None, :]), local.reshape(len(cells), dofs.shape[1], -1))
    return K


def lumped_mass(nodes: Values, cells: npt.NDArray[np.integer], density: float) -> Values:
    """(dofs,) a cell gives each of its nodes an equal share of its mass."""
    V = gradients(nodes[cells])[1] * density / cells.shape[1]
    mass = np.bincount(cells.reshape(-1), np.repeat(V, cells.shape[1]), minlength=len(nodes))
    return np.repeat(mass, nodes.shape[1])


def dense_tangent(scene: Scene, *, small: float | None = None) -> Values:
    """The assembled tangent at the present displacement, without inertia, as a dense matrix (serial); `small`: with
    moduli made positive."""
    balance = scene.balance
    x = balance.work_vector.duplicate()
    x.array_w[:] = balance.u.x.array
    balance.tangent.assemble(psd_tolerance=small)
    matrix = balance.tangent.matrix.copy()
    dense = matrix.convert(PETSc.Mat.Type.DENSE).getDenseArray().copy()
    x.destroy()
    return dense - (balance.c_a * np.diag(balance.mass.lumped) if balance.scheme.inertia else 0.0)


def modes(K: Values, mass: Values, free: npt.NDArray[np.bool_]) -> tuple[Values, Values]:
    """(angular frequencies in rad/s, (dofs, modes) shapes with phi . M phi = 1, zero on dofs that are held)."""
    values, vectors = eigh(K[np.ix_(free, free)], np.diag(mass[free]))
    shapes = np.zeros((len(mass), len(values)))
    shapes[free] = vectors
    return np.sqrt(np.maximum(values, 0.0)), shapes
