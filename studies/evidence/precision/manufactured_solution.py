r"""A body with a smooth manufactured displacement u_m, whose stress is applied as a load.

    python -m fracsim.studies.evidence.precision.manufactured_solution --energy linear --dim 2 --order 2 --h 0.125 \
        -o F.json

int (P(u) - P(u_m)) : grad w dX = 0,   u = u_m on the whole boundary. Writes |u - u_m| / |u_m| and the same of the
gradient, in L2, and `seconds` of the step.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import ufl
from dolfinx import fem
from mpi4py import MPI
from ufl.core.expr import Expr

from ....forms.energies import first_piola_kirchhoff
from ....forms.kinematics import deformation_gradient
from ....mechanics.term import Form, Term
from ....scene import TERMS, Scene, TermInputs, build_scene
from ....study.reader import validate
from .convergence_orders import ENERGIES

Values = npt.NDArray[np.float64]
AMPLITUDE = 0.15  # of the displacement, m: strains of 0.3, rotations of 0.2


def exact_displacement(x: Any, m: Any = np) -> list[Any]:
    """Manufactured displacement u_m at coordinates, by the functions of NumPy or UFL."""
    if len(x) == 2:
        return [AMPLITUDE * m.sin(x[0] + 2 * x[1]), AMPLITUDE * m.cos(2 * x[0] - x[1])]
    return [AMPLITUDE * m.sin(x[0] + 2 * x[1]), AMPLITUDE * m.cos(2 * x[1] - x[2]), AMPLITUDE * m.sin(x[2] + x[0])]


class ManufacturedLoad(Term):
    """Load -int P(u_m) : grad w dX."""

    name = "load"
    linear = True

    def __init__(self, parts: TermInputs) -> None:
        domain = parts.domain
        x = ufl.SpatialCoordinate(domain.mesh)
        F = deformation_gradient(ufl.as_vector(exact_displacement([x[i] for i in range(domain.dim)], ufl)))
        energy = parts.stress.material.energy
        self._P = first_piola_kirchhoff(energy, F, plane_rotation(F) if energy.needs_rotation else None)

    def virtual_work(self, w: Expr, dx: ufl.Measure) -> Form:
        """Virtual work, N m."""
        return -ufl.inner(self._P, ufl.grad(w)) * dx(metadata={"quadrature_degree": 6})


def plane_rotation(F: Expr) -> Expr:
    """Rotation R of F = R U in the plane, from F11 + F22 and F21 - F12."""
    a, b = F[0, 0] + F[1, 1], F[1, 0] - F[0, 1]
    return ufl.as_tensor([[a, -b], [b, a]]) / ufl.sqrt(a**2 + b**2)


@contextmanager
def with_manufactured_load() -> Iterator[None]:
    """Context in which scenes are built with the manufactured load."""
    TERMS["load"] = lambda inputs: [ManufacturedLoad(inputs)]
    try:
        yield
    finally:
        del TERMS["load"]


def solve(energy: str, order: int, dim: int, h: float) -> Scene:
    """Scene of a square or cube of 1 m with its solution in u."""
    sides = ["left", "right", "bottom", "top", "front", "back"]
    study = {
        "title": "a smooth displacement",
        "mesh": {"builder": "box", "size": [1.0] * dim, "h": h, "order": order},
        "material": {"energy": energy, "young": 1.0, "poisson": 0.3, "density": 1.0},
        "boundary": [{"on": side, "fix": "xyz"[:dim]} for side in sides[: 2 * dim]],
        "time": {"scheme": "quasi-static", "step": 1.0, "end": 1.0},
    }
    with with_manufactured_load():
        scene = build_scene(MPI.COMM_SELF, validate(study, "manufactured"))
    motion, nodes = scene.balance.motion, scene.domain.nodes
    values = np.stack(exact_displacement(nodes.T), axis=1).reshape(-1)[motion.dofs]
    motion.displacements_at = lambda t: t * values  # type: ignore[method-assign]
    _, report = scene.stepper.advance(scene.start())
    assert report.solve.converged
    return scene


def relative_errors(scene: Scene) -> Values:
    """L2 errors of displacement and gradient, relative to u_m."""
    domain, u = scene.domain, scene.balance.u
    x = ufl.SpatialCoordinate(domain.mesh)
    exact = ufl.as_vector(exact_displacement([x[i] for i in range(domain.dim)], ufl))
    dx = ufl.dx(domain=domain.mesh, metadata={"quadrature_degree": 6})

    def norm(of: Callable[[Expr], Expr], what: Expr) -> float:
        return float(np.sqrt(fem.assemble_scalar(fem.form(ufl.inner(of(what), of(what)) * dx))))

    return np.array([norm(of, u - exact) / norm(of, exact) for of in (lambda a: a, ufl.grad)])


def main() -> None:
    """Solve and write the errors."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--energy", choices=ENERGIES, required=True)
    parser.add_argument("--dim", type=int, choices=(2, 3), required=True)
    parser.add_argument("--order", type=int, choices=(1, 2), required=True)
    parser.add_argument("--h", type=float, required=True, help="cell size, m")
    parser.add_argument("-o", type=Path, default=Path("figures.json"))
    given = parser.parse_args()
    began = time.process_time()
    scene = solve(given.energy, given.order, given.dim, given.h)
    seconds = time.process_time() - began
    displacement, gradient = (float(error) for error in relative_errors(scene))
    figures = {"displacement": displacement, "gradient": gradient, "seconds": seconds}
    given.o.write_text(json.dumps(figures) + "\n")


if __name__ == "__main__":
    main()
