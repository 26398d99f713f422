"""Calls of DOLFINx that changed after 0.9, in one place.

0.10    fem.petsc.create_vector takes a function space (or spaces) in place of a form; fem.petsc.assemble_vector may
        return vectors of kind "mpi" and takes the form first, as here; fem.petsc.LinearProblem and NonlinearProblem
        (unused) were rewritten; fem.Form keeps `module` and `ufcx_form` (mechanics.kernels binds kernels through them);
        mesh.create_mesh takes the element before the points; la.InsertMode stays.
0.11    not looked at yet.
"""

from __future__ import annotations

from dolfinx import fem, la
from dolfinx.fem import petsc as fem_petsc
from petsc4py import PETSc


def create_vector(space: fem.FunctionSpace) -> PETSc.Vec:
    """A vector over the dofs of a space, ghosts included."""
    return la.create_petsc_vector(space.dofmap.index_map, space.dofmap.index_map_bs)


def assemble_into(b: PETSc.Vec, form: fem.Form) -> None:
    """Add this rank's part of a linear form to b."""
    fem_petsc.assemble_vector(b, form)


def apply_lifting(b: PETSc.Vec, form: fem.Form, bcs: list[fem.DirichletBC], u: fem.Function) -> None:
    """b += A (g - u) of this rank, A the bilinear form's matrix, for prescribed values g that u does not have yet."""
    fem_petsc.apply_lifting(b, [form], [bcs], x0=[u.x.petsc_vec], alpha=-1.0)


def assemble_matrix(form: fem.Form, bcs: list[fem.DirichletBC] | None = None, diagonal: float = 1.0) -> PETSc.Mat:
    """A new matrix of a bilinear form; rows and columns of prescribed dofs are empty but for `diagonal`."""
    matrix = fem_petsc.assemble_matrix(form, bcs=bcs or [], diagonal=diagonal)
    matrix.assemble()
    return matrix
