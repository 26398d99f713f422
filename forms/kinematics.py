"""Kinematics of a body that moves from X to x = X + u(X): deformation gradient and measures of strain."""

from __future__ import annotations

import ufl
from ufl.core.expr import Expr

# Pairs (i, j) of the independent components of a symmetric tensor, in the order of Mandal et al. 2022, eq. 7:
# normal components first, then xy, xz, yz.
SYMMETRIC_COMPONENTS = {2: ((0, 0), (1, 1), (0, 1)), 3: ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))}


def identity(tensor: Expr) -> Expr:
    """Return the identity of the shape of a second-order tensor."""
    return ufl.Identity(tensor.ufl_shape[0])


def deformation_gradient(u: Expr) -> Expr:
    """Return F = I + grad u (d x d) of a displacement u of d components; in 2D the in-plane block."""
    return ufl.Identity(u.ufl_shape[0]) + ufl.grad(u)


def small_strain(F: Expr) -> Expr:
    """Return the linear strain eps = sym(F) - I."""
    return ufl.sym(F) - identity(F)


def green_strain(F: Expr) -> Expr:
    """Return the Green-Lagrange strain E = (F^T F - I) / 2, which vanishes for every rigid motion."""
    return (F.T * F - identity(F)) / 2


def symmetric_components(tensor: Expr) -> Expr:
    """Return the independent components of a symmetric tensor as a vector: xx, yy, xy in 2D; six in 3D."""
    return ufl.as_vector([tensor[i, j] for i, j in SYMMETRIC_COMPONENTS[tensor.ufl_shape[0]]])


def embed(tensor: Expr, out_of_plane: float) -> Expr:
    """Return the 3 x 3 tensor with a 2 x 2 tensor as in-plane block; 3 x 3 tensors are returned as they are."""
    if tensor.ufl_shape[0] == 3:
        return tensor
    rows = [[tensor[i, 0], tensor[i, 1], 0] for i in range(2)]
    return ufl.as_tensor([*rows, [0, 0, out_of_plane]])
