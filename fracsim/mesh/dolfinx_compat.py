"""Calls of DOLFINx, FFCx and Basix that differ between versions, or that no version promises to keep.

fracsim runs with DOLFINx 0.9 and 0.11; 0.10 has the interface of 0.11 as far as its sources tell, and was not tried.

0.10, 0.11  create_mesh             takes the cells, the element and the points in this order; create_cell_partitioner
                                    takes the number of cells of a facet.
            cell_geometry,          A mesh has an array of nodes and a map for each type of cell.
            cell_node_count
            exterior_facet_domain   fem.compute_integration_domains takes no dimension.
            bind_to_cells           The class of a form takes a list of kernels.
            form_domains            Integrals of a form are numbered by place, and no longer known by their identifier.
            evaluate                Values have the shape (cells, points, components ...).
            make_index_map          takes a tag of its messages.
after 0.11  create_mesh             takes `ghost_mode`; create_cell_partitioner is gone (4403).

any         CachedCellElement       subclasses a private class of Basix; basix.ufl.element returns an equal element.
            cache_kernels           replaces two functions of FFCx; without it kernels are found all the same, more
                                    slowly, and damaged ones are not noticed.

mechanics.simd_kernels reads the C code that FFCx writes. Where bind_to_cells does not fit, `tests/test_kernels.py` and
`tests/test_dead_cells.py` fail first.
"""

from __future__ import annotations

import ctypes
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
from dolfinx import fem, la
from dolfinx.common import IndexMap
from dolfinx.cpp.la import SparsityPattern
from dolfinx.cpp.la.petsc import create_matrix as create_petsc_matrix
from dolfinx.fem import petsc as fem_petsc
from dolfinx.io import distribute_entity_data
from ffcx.codegeneration import jit
from mpi4py import MPI
from petsc4py import PETSc
from ufl.algorithms import extract_coefficients

from ..meshes.topology import distinct_rows
from .library_cache import kernel_file, load_kernel, write_digest

Ints = npt.NDArray[np.int32]
VERSION = str(dolfinx.__version__)  # type: ignore[attr-defined]
IS_0_9 = VERSION.split(".")[:2] == ["0", "9"]

# --- memory ---------------------------------------------------------------------------------------------------------


def _return_freed_memory() -> None:
    """Make the C library return large freed arrays to the system, as it does by default.

    SuperLU_DIST, which Debian's PETSc loads, turns that off in the whole process: no freed byte would ever go back.
    """
    trim_threshold, mmap_threshold, mmap_max = -1, -3, -4  # M_TRIM_THRESHOLD, M_MMAP_THRESHOLD, M_MMAP_MAX of malloc.h
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except (AttributeError, OSError):
        return  # not glibc
    # Larger arrays come from the system, one by one; smaller ones are cheaper to allocate from the heap. Measured on
    # 1.5 million tetrahedra: a step that sets up multigrid takes 5 to 10 % longer. With 64 MB the peak is 6 % higher.
    mallopt(mmap_threshold, 8 << 20)
    mallopt(trim_threshold, 16 << 20)
    mallopt(mmap_max, 1 << 16)


_return_freed_memory()

# --- mesh -----------------------------------------------------------------------------------------------------------


class CachedCellElement(_BlockedElement):
    """An element that makes its UFL cell once."""

    @cached_property
    def cell(self) -> ufl.Cell:
        """Cell of the element."""
        # UFL asks for it a hundred times a scene; to make its faces, edges and vertices each time took a third of the
        # set-up of a scene in 3D
        return super().cell


def coordinate_element(dim: int, degree: int = 1) -> CachedCellElement:
    """Lagrange element of the geometry of simplices: straight for degree 1, curved for degree 2."""
    shape = "triangle" if dim == 2 else "tetrahedron"
    return CachedCellElement(basix.ufl.element("Lagrange", shape, degree, dtype=np.float64), (dim,))


def create_mesh(
    comm: MPI.Comm, cells: npt.NDArray[np.int64], points: npt.NDArray[np.float64], element: _ElementBase
) -> dolfinx.mesh.Mesh:
    """A mesh without ghost cells, of which each rank gives some cells and points (collective).

    `cells`: (n, d + 1) nodes.    `points`: (m, d), m.    `element`: of the geometry.
    """
    # with threads the partition would differ between runs
    os.environ.setdefault("SCOTCH_PTHREAD_NUMBER", "1")
    cells_of_facet = () if IS_0_9 else (2,)
    partitioner = None
    # on one rank a partitioner builds the graph of all cells for nothing, half of the time of the mesh
    if comm.size > 1:
        partitioner = dolfinx.mesh.create_cell_partitioner(dolfinx.mesh.GhostMode.none, *cells_of_facet)
    return dolfinx.mesh.create_mesh(comm, cells, x=points, e=element, partitioner=partitioner)


def cell_geometry(geometry: Any) -> Ints:
    """(cells, nodes) nodes of each cell in the geometry of a mesh; `geometry`: of DOLFINx, or of its C++ mesh."""
    nodes: Ints = geometry.dofmap if IS_0_9 else geometry.dofmaps[0]
    return nodes


def cell_node_count(geometry: Any) -> int:
    """Number of geometry nodes of a cell."""
    return int((geometry.cmap if IS_0_9 else geometry.cmaps[0]).dim)


def make_index_map(comm: MPI.Comm, size: int, ghosts: npt.NDArray[np.int64], owners: Ints) -> IndexMap:
    """Numbers of `size` owned entities and of ghosts, given by global number and owner (collective)."""
    if IS_0_9:
        return IndexMap(comm, size, ghosts, owners)
    return IndexMap(comm, size, ghosts, owners, 1220)  # any tag: the messages end within the call


def find_facets(
    mesh: dolfinx.mesh.Mesh, nodes: npt.NDArray[np.int64], values: npt.NDArray[np.int32]
) -> tuple[Ints, Ints]:
    """Local facets of a mesh, and their values, of sets of input nodes that ranks give (collective).

    `nodes`: (n, d) nodes of each facet, distinct over all ranks.    `values`: (n,).
    """
    dim = mesh.topology.dim
    rows, row_values = distribute_entity_data(mesh, dim - 1, nodes, values)
    mesh.topology.create_connectivity(dim - 1, 0)
    facets = mesh.topology.connectivity(dim - 1, 0).array.reshape(-1, dim)
    # DOLFINx's meshtags_from_entities takes a second for a million cells: it looks at all facets
    marked = np.zeros(int(facets.max(initial=-1)) + 1, bool)
    marked[rows] = True
    near = np.flatnonzero(marked[facets].all(axis=1))
    _, _, number = distinct_rows(np.sort(np.concatenate([facets[near], rows]).astype(np.int64), axis=1))
    facet_of = np.full(len(number), -1, np.int32)
    facet_of[number[: len(near)]] = near
    facet_of_row = facet_of[number[len(near) :]]
    order = np.argsort(facet_of_row)[np.count_nonzero(facet_of_row < 0) :]
    return facet_of_row[order], row_values[order]


def exterior_facet_domain(mesh: dolfinx.mesh.Mesh, facets: Ints) -> Ints:
    """Subdomain data of a surface measure: pairs (cell, local facet) of local exterior facets."""
    topology = mesh.topology
    dimension = (topology.dim - 1,) if IS_0_9 else ()
    domain: Ints = fem.compute_integration_domains(fem.IntegralType.exterior_facet, topology, facets, *dimension)
    return domain


# --- forms ----------------------------------------------------------------------------------------------------------


def cache_kernels() -> None:
    """Make FFCx look for each kernel once a process, and compile damaged kernels again."""
    # FFCx reads its folder at each look-up, 1 ms where the folder holds 1,000 files
    look_up, load = jit.get_cached_module, jit._load_objects
    cache: dict[tuple[str, tuple[str, ...], str], tuple[Any, Any]] = {}

    def looked_up_once(name: str, objects: Sequence[str], folder: Any, timeout: int) -> tuple[Any, Any]:
        key = name, tuple(objects), str(folder)
        if key in cache:
            return cache[key]
        compiled = load_kernel(lambda: look_up(name, objects, folder, timeout), Path(folder), name)
        # None: FFCx compiles the kernel now
        if compiled[0] is not None:
            cache[key] = compiled
        return compiled

    def load_compiled(folder: Any, name: str, objects: Sequence[str]) -> tuple[Any, Any]:
        if (library := kernel_file(Path(folder), name)) is not None:
            write_digest(library, Path(folder) / f"{name}.c")
        return load(folder, name, objects)

    jit.get_cached_module, jit._load_objects = looked_up_once, load_compiled


def bind_to_cells(form: fem.Form, constants: Sequence[Any], keep: Callable[[Ints], Ints]) -> Any:
    """C++ form with the kernels of a compiled `form`, over those cells of each integral that `keep` returns.

    Integrals over facets stay. `constants`: C++ constants of the form.
    """
    compiled: Any = form._cpp_object
    module: Any = form.module
    cell = fem.IntegralType.cell
    domains = {kind: form_domains(form, kind) for kind in compiled.integral_types}
    domains[cell] = [(number, keep(cells)) for number, cells in domains.get(cell, [])]
    kernels: Any = module.ffi.cast("uintptr_t", module.ffi.addressof(form.ufcx_form))
    entity_maps: Any = {}
    if not IS_0_9:
        kernels, entity_maps = [kernels], []
    bind = fem.form_cpp_class(form.dtype)
    return bind(
        kernels, compiled.function_spaces, compiled.coefficients, constants, domains, entity_maps, compiled.mesh
    )


def form_domains(form: fem.Form, kind: Any) -> list[tuple[int, Ints]]:
    """Identifier and flat array of entities of each integral of a type."""
    compiled: Any = form._cpp_object
    if IS_0_9:
        return [(number, compiled.domains(kind, number).reshape(-1)) for number in compiled.integral_ids(kind)]
    first, last = _integral_places(form.ufcx_form, kind)
    numbers = [int(form.ufcx_form.form_integral_ids[position]) for position in range(first, last)]
    return [(number, compiled.domains(kind, index).reshape(-1)) for index, number in enumerate(numbers)]


def _integral_places(ufcx_form: Any, kind: Any) -> tuple[int, int]:
    """First and last place, exclusive, of the integrals of a type in a compiled form."""
    # in the order of ufcx.h: cell, exterior facet, interior facet, ...
    position = [fem.IntegralType.cell, fem.IntegralType.exterior_facet, fem.IntegralType.interior_facet].index(kind)
    offsets = ufcx_form.form_integral_offsets
    return int(offsets[position]), int(offsets[position + 1])


def evaluate(
    expression: fem.Expression, mesh: dolfinx.mesh.Mesh, cells: Ints, values: npt.NDArray[np.float64]
) -> npt.NDArray[np.float64]:
    """Evaluate an expression in cells into `values` (cells, points times components); returns them."""
    if IS_0_9:
        expression.eval(mesh, cells, values)
    else:
        shape = len(cells), expression.X().shape[0], *expression.ufl_expression.ufl_shape
        expression.eval(mesh, cells, values.reshape(shape, copy=False))  # a copy would leave `values` as it was
    return values


def kernel_source(expression: fem.Expression, mesh: dolfinx.mesh.Mesh, options: dict[str, Any]) -> Path:
    """Path of the C code that FFCx wrote for an expression, compiled with `options` before (collective)."""
    kernel = expression.ufl_expression, expression.X()
    scalar = {"scalar_type": expression.dtype}
    _, module, _ = dolfinx.jit.ffcx_jit(mesh.comm, kernel, form_compiler_options=scalar, jit_options=options)
    source_file = Path(str(module.__file__))
    return source_file.with_name(source_file.name.split(".")[0] + ".c")


def kernel_constants(kind: fem.Form | fem.Expression) -> npt.NDArray[np.float64]:
    """Constants that are passed to the kernel of a form or expression."""
    constants: npt.NDArray[np.float64] = dolfinx.cpp.fem.pack_constants(kind._cpp_object)
    return constants


@dataclass(frozen=True)
class FormField:
    """A function that is passed to the kernel of a form.

    Attributes:
        dofs: (cells, nodes) of each cell.
        size: number of values at each dof.
        values: (dofs * size,).
    """

    dofs: Ints
    size: int
    values: npt.NDArray[np.float64]


def form_fields(form: fem.Form) -> list[FormField]:
    """Functions that are passed to the kernel of a form, in its order."""
    compiled: Any = form._cpp_object
    maps = ((function, function.function_space.dofmap) for function in compiled.coefficients)
    return [FormField(np.asarray(dofmap.map()), dofmap.bs, function.x.array) for function, dofmap in maps]


def expression_fields(expression: fem.Expression) -> list[FormField]:
    """Functions that are passed to the kernel of an expression, in its order."""
    fields, kernel = extract_coefficients(expression.ufl_expression), expression.ufcx_expression
    coefficients = [fields[kernel.original_coefficient_positions[i]] for i in range(kernel.num_coefficients)]
    maps = ((function, function.function_space.dofmap) for function in coefficients)
    return [FormField(dofmap.list, dofmap.bs, function.x.array) for function, dofmap in maps]


def kernel_address(form: fem.Form) -> int:
    """Address of the kernel of a form with one integral, over cells."""
    module: Any = form.module
    return int(module.ffi.cast("uintptr_t", form.ufcx_form.form_integrals[0].tabulate_tensor_float64))


def integrated_cells_of(form: fem.Form) -> Ints | None:
    """Present cells of a form with one integral, over cells; None for any other form."""
    compiled: Any = form._cpp_object
    cell = fem.IntegralType.cell
    if list(compiled.integral_types) != [cell]:
        return None
    numbers = compiled.integral_ids(cell) if IS_0_9 else range(compiled.num_integrals(cell, 0))
    return np.asarray(compiled.domains(cell, numbers[0])) if len(numbers) == 1 else None


def coefficient_spaces(form: fem.Form) -> list[Any]:
    """C++ function spaces of the functions that are passed to the kernel of a form."""
    return [function.function_space for function in form._cpp_object.coefficients]


def form_cell_nodes(form: fem.Form) -> Ints:
    """(cells, nodes) local nodes of the test functions of a form."""
    space: Any = form.function_spaces[0]
    nodes: Ints = space.dofmap.map()
    return nodes


def set_identity_rows(matrix: la.MatrixCSR, form: fem.Form, bcs: list[fem.DirichletBC]) -> None:
    """Set the diagonal of owned rows of prescribed dofs to 1."""
    space: Any = form.function_spaces[0]
    dolfinx.cpp.fem.insert_diagonal(matrix._cpp_object, space, [bc._cpp_object for bc in bcs], 1.0)


# --- vectors and matrices -------------------------------------------------------------------------------------------


def create_vector(nodes: IndexMap, size: int) -> PETSc.Vec:
    """A vector with `size` values for each node, with ghosts."""
    ghosts, sizes = nodes.ghosts.astype(PETSc.IntType), (size * nodes.size_local, size * nodes.size_global)
    return PETSc.Vec().createGhost(ghosts, sizes, bsize=size, comm=nodes.comm)


def assemble_local_vector(b: PETSc.Vec, form: fem.Form) -> None:
    """Add the integrals of a linear form over the cells of this rank to b."""
    fem_petsc.assemble_vector(b, form)


def apply_lifting(b: PETSc.Vec, form: fem.Form, bcs: list[fem.DirichletBC], u: fem.Function) -> None:
    """Add A (g - u) of this rank to b, with A the matrix of the bilinear form and g the prescribed values."""
    fem_petsc.apply_lifting(b, [form], [bcs], x0=[u.x.petsc_vec], alpha=-1.0)


def assemble_matrix(form: fem.Form, bcs: list[fem.DirichletBC] | None = None, diagonal: float = 1.0) -> PETSc.Mat:
    """A new matrix of a bilinear form; rows and columns of prescribed dofs are 0, except `diagonal`."""
    matrix = fem_petsc.assemble_matrix(form, bcs or [], diagonal)
    matrix.assemble()
    return _reference_counted(matrix)


def make_scalar_csr(pattern: SparsityPattern) -> la.MatrixCSR:
    """DOLFINx's sparse matrix of a pattern, with scalar entries."""
    return la.matrix_csr(pattern, block_mode=la.BlockMode.expanded)  # type: ignore[attr-defined]


def make_block_csr(pattern: SparsityPattern) -> la.MatrixCSR:
    """DOLFINx's sparse matrix of a pattern, with a contiguous block for each pair of nodes."""
    return la.matrix_csr(pattern)


def create_matrix(comm: MPI.Comm, pattern: SparsityPattern) -> PETSc.Mat:
    """A PETSc matrix of a pattern, with zero entries (collective)."""
    return _reference_counted(create_petsc_matrix(comm, pattern))


def _reference_counted(matrix: PETSc.Mat) -> PETSc.Mat:
    """Reference to a matrix that is freed when Python has no reference to it any more."""
    # DOLFINx 0.9 keeps a reference to the Python object that it returns; the copy refers to the same PETSc matrix
    result = copy(matrix)
    matrix.destroy()
    return result
