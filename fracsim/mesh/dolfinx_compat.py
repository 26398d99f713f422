"""Calls of DOLFINx that changed after 0.9, or that no version promises to keep: all that a newer version touches.

Run with 0.9 alone; the rest is from the sources, release notes and pull requests of 0.10 and 0.11.

0.10        create_vector       la.create_petsc_vector is la.petsc.create_vector.
            create_mesh         The element comes before the points (pull request 3826).
            exterior_facets     fem.compute_integration_domains takes no dimension.
            facets_of_nodes     graph.AdjacencyList has a class in Python; graph.adjacencylist, as here, makes it.
            bind_to_cells       The class of a form takes a list of kernels, and entity maps as a list (mesh.EntityMap).
                                Whether integrals still have `integral_ids` is to be tried.
            assemble_matrix     `bcs` and the diagonal are given by place: their names are not the same in all versions.
0.11        evaluate            Entities of facets are rows (cell, facet) (4140); cells, as here, are as before.
after 0.11  create_mesh         takes `ghost_mode`; create_cell_partitioner is gone (4403).

any         KeptCell            is a private class of Basix with one property kept; basix.ufl.element gives its equal.
            keep_kernels        takes the place of two functions of FFCx; without it kernels are found alike, later, and
                                damaged ones are not noticed.

Nothing was found of the others: cells_of, integrals, nodes_of_cells, source_of, form_fields, constants_of,
identity_rows, assemble_into, apply_lifting, pattern_of, expanded_csr, create_matrix. What FFCx writes is read by
mechanics.simd_kernels. `tests/test_kernels.py` and `tests/test_dead_cells.py` fail first where bind_to_cells does not
fit.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from copy import copy
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import basix.ufl
import dolfinx
import numpy as np
import numpy.typing as npt
import ufl
from basix.ufl import _BlockedElement, _ElementBase
from dolfinx import fem, graph, la
from dolfinx.cpp.la import SparsityPattern
from dolfinx.cpp.la.petsc import create_matrix as create_petsc_matrix
from dolfinx.fem import petsc as fem_petsc
from dolfinx.io import distribute_entity_data
from ffcx.codegeneration import jit
from mpi4py import MPI
from petsc4py import PETSc
from ufl.algorithms import extract_coefficients

from .library_cache import kernel_file, load_whole, put_seal

Ints = npt.NDArray[np.int32]

# --- mesh -----------------------------------------------------------------------------------------------------------


class KeptCell(_BlockedElement):
    """An element that is asked for its cell a hundred times a scene, and makes one, with all its faces, edges and
    vertices, once: a third of the time that a scene in 3D takes to set up."""

    @cached_property
    def cell(self) -> ufl.Cell:
        """Cell of the element."""
        return super().cell


def coordinate_element(dim: int, degree: int = 1) -> KeptCell:
    """Straight simplices; of degree 2 bent ones."""
    shape = "triangle" if dim == 2 else "tetrahedron"
    return KeptCell(basix.ufl.element("Lagrange", shape, degree, dtype=np.float64), (dim,))


def create_mesh(
    comm: MPI.Comm, cells: npt.NDArray[np.int64], points: npt.NDArray[np.float64], element: _ElementBase
) -> dolfinx.mesh.Mesh:
    """A mesh without ghost cells from (n, d + 1) nodes of cells and (m, d) points in m, each rank giving its share
    (collective)."""
    os.environ.setdefault("SCOTCH_PTHREAD_NUMBER", "1")  # with threads each run would be parted otherwise
    partitioner = dolfinx.mesh.create_cell_partitioner(dolfinx.mesh.GhostMode.none)
    return dolfinx.mesh.create_mesh(comm, cells, points, element, partitioner)


def facets_of_nodes(
    mesh: dolfinx.mesh.Mesh, nodes: npt.NDArray[np.int64], values: npt.NDArray[np.int32]
) -> tuple[Ints, Ints]:
    """Local facets of (n, d) distinct sets of input nodes, each rank giving its share, and values (collective)."""
    dim = mesh.topology.dim
    local, local_values = distribute_entity_data(mesh, dim - 1, nodes, values)
    mesh.topology.create_connectivity(dim - 1, 0)
    tags = dolfinx.mesh.meshtags_from_entities(mesh, dim - 1, graph.adjacencylist(local), local_values)
    return tags.indices, tags.values


def exterior_facets(mesh: dolfinx.mesh.Mesh, facets: Ints) -> Ints:
    """What a surface measure is given as subdomain data: pairs (cell, local facet) of local exterior facets."""
    topology = mesh.topology
    return fem.compute_integration_domains(fem.IntegralType.exterior_facet, topology, facets, topology.dim - 1)


# --- forms ----------------------------------------------------------------------------------------------------------


def keep_kernels() -> None:
    """Have FFCx look for a kernel once a process: it reads its folder for each, 1 ms where that holds 1,000 files. It
    loads whole ones alone: others are compiled once more."""
    look_up, load = jit.get_cached_module, jit._load_objects
    cache: dict[tuple[str, tuple[str, ...], str], tuple[Any, Any]] = {}

    def looked_up_once(name: str, objects: Sequence[str], folder: Any, timeout: int) -> tuple[Any, Any]:
        key = name, tuple(objects), str(folder)
        if key in cache:
            return cache[key]
        compiled = load_whole(lambda: look_up(name, objects, folder, timeout), Path(folder), name)
        if compiled[0] is not None:  # None: it is compiled now
            cache[key] = compiled
        return compiled

    def load_compiled(folder: Any, name: str, objects: Sequence[str]) -> tuple[Any, Any]:
        if (library := kernel_file(Path(folder), name)) is not None:
            put_seal(library, Path(folder) / f"{name}.c")
        return load(folder, name, objects)

    jit.get_cached_module, jit._load_objects = looked_up_once, load_compiled


def bind_to_cells(form: fem.Form, whole: Any, constants: Sequence[Any], keep: Callable[[Ints], Ints]) -> Any:
    """The C++ form of `whole`, with the kernels of `form`, over the cells that `keep` leaves of each of its integrals.

    `whole`: C++ form as it was compiled; its integrals over facets stay. `constants`: C++ constants of the form.
    """
    module: Any = form.module
    cell = fem.IntegralType.cell
    domains = {
        kind: [(number, whole.domains(kind, number).reshape(-1)) for number in whole.integral_ids(kind)]
        for kind in whole.integral_types
    }
    domains[cell] = [(number, keep(cells)) for number, cells in domains.get(cell, [])]
    kernels = module.ffi.cast("uintptr_t", module.ffi.addressof(form.ufcx_form))
    bind = fem.form_cpp_class(whole.dtype)
    return bind(kernels, whole.function_spaces, whole.coefficients, constants, domains, {}, whole.mesh)


def evaluate(
    expression: fem.Expression, mesh: dolfinx.mesh.Mesh, cells: Ints, values: npt.NDArray[np.float64]
) -> npt.NDArray[np.float64]:
    """Evaluate an expression in cells into `values` (cells, points times components); returns them."""
    return expression.eval(mesh, cells, values)


def source_of(expression: fem.Expression, mesh: dolfinx.mesh.Mesh, options: dict[str, Any]) -> Path:
    """The C that FFCx has written for an expression, compiled with `options` before (collective)."""
    kernel = expression.ufl_expression, expression.X()
    scalar = {"scalar_type": expression.dtype}
    _, module, _ = dolfinx.jit.ffcx_jit(mesh.comm, kernel, form_compiler_options=scalar, jit_options=options)
    source_file = Path(str(module.__file__))
    return source_file.with_name(source_file.name.split(".")[0] + ".c")


def constants_of(kind: fem.Form | fem.Expression) -> npt.NDArray[np.float64]:
    """The constants that the kernel of a form or an expression is given."""
    return constants_in(kind._cpp_object)


def constants_in(compiled: Any) -> npt.NDArray[np.float64]:
    """The same of a C++ form."""
    constants: npt.NDArray[np.float64] = dolfinx.cpp.fem.pack_constants(compiled)
    return constants


@dataclass(frozen=True)
class FormField:
    """A function that the kernel of a form is given: `size` numbers at each of the dofs (cells, nodes) of a cell."""

    dofs: Ints
    size: int
    values: npt.NDArray[np.float64]


def form_fields(form: fem.Form) -> list[FormField]:
    """All of a form, in the order of its kernel."""
    compiled: Any = form._cpp_object
    maps = ((function, function.function_space.dofmap) for function in compiled.coefficients)
    return [FormField(np.asarray(dofmap.map()), dofmap.bs, function.x.array) for function, dofmap in maps]


def expression_fields(expression: fem.Expression) -> list[FormField]:
    """The same of an expression."""
    fields, kernel = extract_coefficients(expression.ufl_expression), expression.ufcx_expression
    coefficients = [fields[kernel.original_coefficient_positions[i]] for i in range(kernel.num_coefficients)]
    maps = ((function, function.function_space.dofmap) for function in coefficients)
    return [FormField(dofmap.list, dofmap.bs, function.x.array) for function, dofmap in maps]


def kernel_of(form: fem.Form) -> int:
    """The address of the kernel of a form with one integral, over cells."""
    module: Any = form.module
    return int(module.ffi.cast("uintptr_t", form.ufcx_form.form_integrals[0].tabulate_tensor_float64))


def cells_of(form: fem.Form) -> Ints:
    """The cells that a form with one integral, over cells, is integrated over now."""
    compiled: Any = form._cpp_object
    (number,) = compiled.integral_ids(fem.IntegralType.cell)
    return np.asarray(compiled.domains(fem.IntegralType.cell, number))


def only_cells(compiled: Any) -> npt.NDArray[np.int64] | None:
    """The cells of a C++ form with one integral, over cells; None of any other."""
    if integrals_in(compiled) != [fem.IntegralType.cell]:
        return None
    (number,) = compiled.integral_ids(fem.IntegralType.cell)
    return np.array(compiled.domains(fem.IntegralType.cell, number), np.int64)


def integrals(form: fem.Form) -> list[Any]:
    """The kind of each integral of a form."""
    return integrals_in(form._cpp_object)


def integrals_in(compiled: Any) -> list[Any]:
    """The same of a C++ form."""
    return [kind for kind in compiled.integral_types for _ in compiled.integral_ids(kind)]


def nodes_of_cells(form: fem.Form) -> Ints:
    """(cells, nodes) local nodes of a form's functions."""
    space: Any = form.function_spaces[0]
    nodes: Ints = space.dofmap.map()
    return nodes


def identity_rows(matrix: la.MatrixCSR, form: fem.Form, bcs: list[fem.DirichletBC]) -> None:
    """Put 1 on the diagonal of owned rows of prescribed dofs."""
    space: Any = form.function_spaces[0]
    dolfinx.cpp.fem.insert_diagonal(matrix._cpp_object, space, [bc._cpp_object for bc in bcs], 1.0)


# --- vectors and matrices -------------------------------------------------------------------------------------------


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
    matrix = fem_petsc.assemble_matrix(form, bcs or [], diagonal)
    matrix.assemble()
    return _freed_with_its_name(matrix)


def pattern_of(form: Any) -> SparsityPattern:
    """A new pattern of a bilinear form of C++, which may be added to."""
    return dolfinx.cpp.fem.create_sparsity_pattern(form)


def expanded_csr(pattern: SparsityPattern) -> la.MatrixCSR:
    """DOLFINx's own sparse matrix of a pattern, with an entry for every dof, not for every block of them."""
    return la.matrix_csr(pattern, block_mode=la.BlockMode.expanded)  # type: ignore[attr-defined]


def block_csr(pattern: SparsityPattern) -> la.MatrixCSR:
    """The same with a block for every two nodes, the entries of a block one after another."""
    return la.matrix_csr(pattern)


def create_matrix(comm: MPI.Comm, pattern: SparsityPattern) -> PETSc.Mat:
    """PETSc's matrix of a pattern, empty (collective)."""
    return _freed_with_its_name(create_petsc_matrix(comm, pattern))


def _freed_with_its_name(matrix: PETSc.Mat) -> PETSc.Mat:
    """The same matrix, which is freed when the last name for it is gone: DOLFINx 0.9 never drops the object of Python
    that it gives a matrix out as."""
    same = copy(matrix)
    matrix.destroy()
    return same
