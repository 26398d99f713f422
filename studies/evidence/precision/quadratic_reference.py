"""Reference with quadratic elements on the mesh of a study of linear elasticity, with separate forms and solver.

    python -m fracsim.studies.evidence.precision.quadratic_reference --case cantilever --h 0.025 -o figures.json

Writes the figures of linear_statics.py and vibrating_beam.py, and `seconds`.
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path
from typing import Any

import numpy as np

from . import linear_statics, vibrating_beam

STUDIES = linear_statics.STUDIES | {"frequency": vibrating_beam.static_study}


def assemble_system(study: dict[str, Any]) -> tuple[Any, ...]:
    """(domain, displacement u, stress of u, forms K, M, f, Dirichlet conditions) of the study in P2."""
    import ufl
    from dolfinx import fem
    from mpi4py import MPI

    from ....mechanics.loads import surface_measures
    from ....mesh.domain import distribute
    from ....mesh.selection import select_facets
    from ....mesh.selectors import Group
    from ....study.check import build_checked_mesh
    from ....study.reader import validate

    checked = validate(study | {"mesh": study["mesh"] | {"order": 2}}, "quadratic")
    domain = distribute(MPI.COMM_SELF, build_checked_mesh(checked), 2)  # for its round sides
    d, material = domain.dim, checked.material
    V = fem.functionspace(domain.mesh, ("Lagrange", 2, (d,)))
    u, v, w = fem.Function(V), ufl.TrialFunction(V), ufl.TestFunction(V)
    mu = material.young / (2 * (1 + material.poisson))
    lmbda = material.young * material.poisson / ((1 + material.poisson) * (1 - 2 * material.poisson))
    if material.plane == "stress" and d == 2:
        lmbda = 2 * lmbda * mu / (lmbda + 2 * mu)

    def stress(a: Any) -> Any:
        strain = ufl.sym(ufl.grad(a))
        return 2 * mu * strain + lmbda * ufl.tr(strain) * ufl.Identity(d)

    loads = [entry for entry in checked.boundary if entry.kind == "traction"]
    measures = surface_measures(domain, [select_facets(domain, Group(str(entry.on))) for entry in loads])
    zero: Any = fem.Constant(domain.mesh, np.zeros(d))
    force = ufl.inner(zero, w) * ufl.dx
    for entry, ds in zip(loads, measures, strict=True):
        force += ufl.inner(ufl.as_vector(entry.traction), w) * ds
    bcs = []
    for entry in checked.boundary:
        for axis in entry.fix or "":
            part = V.sub("xyz".index(axis))
            held = fem.locate_dofs_topological(part, d - 1, domain.facets.groups[str(entry.on)])
            bcs.append(fem.dirichletbc(np.float64(0.0), held, part))  # type: ignore[arg-type]
    K = ufl.inner(stress(v), ufl.sym(ufl.grad(w))) * ufl.dx
    M = material.density * ufl.inner(v, w) * ufl.dx
    return domain, u, stress(u), K, M, force, bcs


def deflection(case: str, h: float) -> dict[str, float]:
    """Figures of a static case."""
    from dolfinx import fem
    from dolfinx.fem import petsc as fem_petsc
    from petsc4py import PETSc

    study = STUDIES[case](h)
    domain, u, stress, K, _, force, bcs = assemble_system(study)
    A = fem_petsc.assemble_matrix(fem.form(K), bcs=bcs)
    A.assemble()
    b = fem_petsc.assemble_vector(fem.form(force))
    load = b.array_r.copy()
    fem_petsc.set_bc(b, bcs)
    ksp = PETSc.KSP().create(domain.comm)
    ksp.setType("preonly")
    ksp.pc.setType("lu")
    ksp.pc.setFactorSolverType("mumps")
    ksp.setOperators(A)
    ksp.solve(b, u.x.petsc_vec)
    work = float(load @ u.x.array)
    if case == "cantilever":
        return {"deflection": work / (linear_statics.TRACTION * linear_statics.DEPTH**2)}
    space = fem.functionspace(domain.mesh, ("DG", 1))
    along = fem.Function(space)
    points = space.element.interpolation_points  # a method in DOLFINx 0.9
    along.interpolate(fem.Expression(stress[0, 0], points() if callable(points) else points))
    return {
        "deflection": work / (linear_statics.PULL * linear_statics.SIDE),
        "peak": float(along.x.array.max() / linear_statics.PULL),
    }


def frequency(h: float) -> dict[str, float]:
    """First frequency (Hz) of the beam, from K and the consistent M."""
    from dolfinx import fem
    from dolfinx.fem import petsc as fem_petsc
    from scipy.sparse import csr_matrix
    from scipy.sparse.linalg import eigsh

    _, u, _, K, M, _, bcs = assemble_system(STUDIES["frequency"](h))
    free = np.ones(len(u.x.array), bool)
    for bc in bcs:
        free[bc.dof_indices()[0]] = False
    matrices = []
    for form in (K, M):
        A = fem_petsc.assemble_matrix(fem.form(form))
        A.assemble()
        matrices.append(csr_matrix(A.getValuesCSR()[::-1], shape=A.size)[free][:, free].tocsc())
    value = eigsh(matrices[0], k=1, M=matrices[1], sigma=0, which="LM", return_eigenvectors=False)[0]
    return {"frequency": float(np.sqrt(value) / (2 * np.pi))}


def main() -> None:
    """Solve and write the figures."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--case", choices=STUDIES, required=True)
    parser.add_argument("--h", type=float, required=True, help="cell size, m")
    parser.add_argument("-o", type=Path, default=Path("figures.json"))
    given = parser.parse_args()
    began = time.perf_counter()
    figures = frequency(given.h) if given.case == "frequency" else deflection(given.case, given.h)
    given.o.write_text(json.dumps(figures | {"seconds": time.perf_counter() - began}) + "\n")


if __name__ == "__main__":
    main()
