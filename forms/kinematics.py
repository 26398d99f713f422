"""Measures of deformation of a body that moves from X to x = X + u(X)."""

from __future__ import annotations

import ufl
from ufl.core.expr import Expr

# Pairs (i, j) of the independent components of a symmetric tensor, in the order of Mandal et al. 2022, eq. 7:
# normal components first, then xy, xz, yz.
SYMMETRIC_COMPONENTS = {2: ((0, 0), (1, 1), (0, 1)), 3: ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))}


def identity(tensor: Expr) -> Expr:
    """Identity of the shape of a second-order tensor."""
    return ufl.Identity(tensor.ufl_shape[0])


def deformation_gradient(u: Expr) -> Expr:
    """F = I + grad u, d x d, for a displacement u of d components; in 2D the in-plane block."""
    return ufl.Identity(u.ufl_shape[0]) + ufl.grad(u)


def small_strain(F: Expr) -> Expr:
    """Linear strain eps = sym(F) - I."""
    return ufl.sym(F) - identity(F)


def green_strain(F: Expr) -> Expr:
    """Green-Lagrange strain E = (F^T F - I) / 2; vanishes for every rigid motion."""
    return (F.T * F - identity(F)) / 2


def symmetric_components(tensor: Expr) -> Expr:
    """Independent components of a symmetric tensor as a vector: 3 in 2D (xx, yy, xy), 6 in 3D."""
    return ufl.as_vector([tensor[i, j] for i, j in SYMMETRIC_COMPONENTS[tensor.ufl_shape[0]]])


def embed(tensor: Expr, out_of_plane: float) -> Expr:
    """A 2 x 2 tensor as the in-plane block of a 3 x 3 one; 3 x 3 tensors pass."""
    if tensor.ufl_shape[0] == 3:
        return tensor
    rows = [[tensor[i, 0], tensor[i, 1], 0] for i in range(2)]
    return ufl.as_tensor([*rows, [0, 0, out_of_plane]])
