"""A rigid sphere pressed into a block, against Hertz (1882): F = 4/3 E* sqrt(R) d^(3/2), a^2 = R d.

E* = E / (1 - nu^2). K. L. Johnson (1985), Contact Mechanics, ch. 4.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from .fracture_case import Figures, FractureCase, steps_of
from .precision_trials import Settings, Study

YOUNG, POISSON = 1e9, 0.3
RADIUS, DEPTH = 1.0, 1e-4  # m: the contact radius is 0.01 m
SIZE, GRADING = 30.0, 4.0  # of the block, in contact radii; growth of its cells away from the contact
GAP = 2e-6  # m: range of the barrier
ERRORS = ("force", "contact radius")


def write_quarter(path: Path, n: int) -> str:
    """Write a block of n^3 cubes that grow away from the origin, z up: the quarter x, y > 0 of the whole."""
    import meshio

    from ....meshes.builders.box import Box

    box = Box(size=(1.0, 1.0, 1.0), h=1.0 / n, origin=(0.0, 0.0, -1.0)).build()
    grown = np.sign(box.points) * np.expm1(GRADING * abs(box.points)) / np.expm1(GRADING)
    points = SIZE * np.sqrt(RADIUS * DEPTH) * grown
    meshio.Mesh(points, [("tetra", box.cells)]).write(path)
    return str(path)


def pressed_study(mesh: Study, steps: int = 4) -> Study:
    """Study of the sphere that moves into the block of `write_quarter`, in equal steps."""
    far = SIZE * np.sqrt(RADIUS * DEPTH)
    return {
        "title": "A sphere pressed into a block",
        "mesh": mesh,
        "material": {"energy": "linear", "young": YOUNG, "poisson": POISSON, "density": 1000.0},
        "obstacle": [{
            "name": "ball", "shape": "sphere", "radius": RADIUS, "at": [0.0, 0.0, RADIUS + GAP],
            "displacement": {"time": [0.0, 1.0], "value": [[0.0] * 3, [0.0, 0.0, -DEPTH]]},
        }],
        "contact": {"itself": False, "distance": GAP, "stiffness": YOUNG},
        "boundary": [
            {"on": {"box": [[-1e-9, -9.0, -9.0], [1e-9, 9.0, 9.0]]}, "fix": "x"},
            {"on": {"box": [[-9.0, -1e-9, -9.0], [9.0, 1e-9, 9.0]]}, "fix": "y"},
            {"on": {"box": [[-9.0, -9.0, -1.001 * far], [9.0, 9.0, -0.999 * far]]}, "fix": "xyz"},
        ],
        "time": {"scheme": "quasi-static", "step": 1 / steps, "end": 1.0},
        "solver": {"snes_rtol": 1e-8},
    }  # fmt: skip


def hertz_errors(scene: Any, u: Any) -> Figures:
    """Force and contact radius over those of Hertz's theory, less 1, by the displacement u of a scene in contact."""
    from ....contact.obstacle_term import ObstacleTerm

    (contact,) = [term for term in scene.balance.terms if isinstance(term, ObstacleTerm)]
    touch = contact.obstacle_forces()[0]
    pressed, r = -touch.normal[:, 2], np.linalg.norm(contact.positions[touch.points][:, :2], axis=1)
    total = 4 * float(pressed.sum())
    top = np.argmin(np.linalg.norm(scene.domain.nodes[: scene.domain.node_count], axis=1))
    # the bottom of the block stands still, where that of a half space would sink: Boussinesq
    far = SIZE * np.sqrt(RADIUS * DEPTH)
    sunk = total * (1 + POISSON) * (3 - 2 * POISSON) / (2 * np.pi * YOUNG * far)
    depth = sunk - float(u.reshape(-1, 3)[top, 2])
    radius = np.sqrt(2.5 * (pressed @ r**2) / pressed.sum())  # of a pressure p0 sqrt(1 - (r/a)^2): <r^2> = 2/5 a^2
    expected = 4 / 3 * YOUNG / (1 - POISSON**2) * np.sqrt(RADIUS) * depth**1.5
    return {ERRORS[0]: total / expected - 1, ERRORS[1]: float(radius / np.sqrt(RADIUS * depth)) - 1}


def measure(settings: Settings, folder: Path) -> Figures:
    """Errors of the force and of the contact radius."""
    from mpi4py import MPI

    from ....scene import build_scene
    from ....study.reader import validate

    mesh = {"file": write_quarter(folder / "quarter.vtu", int(settings["n"])), "order": settings["order"]}
    scene = build_scene(MPI.COMM_SELF, validate(pressed_study(mesh, int(settings["steps"])), "sphere"))
    seconds: list[float] = []
    *_, (state, _) = steps_of(scene, seconds)
    errors = hertz_errors(scene, state.u)
    signed = {f"{name}, signed": value for name, value in errors.items()}
    return {name: abs(value) for name, value in errors.items()} | signed | {"seconds": sum(seconds)}


def _settings(n: int, order: int, steps: int = 4) -> Settings:
    """Settings of a trial."""
    return {"n": n, "order": order, "steps": steps}


CASE = FractureCase(
    "hertz", "Sphere on a block: force by Hertz",
    "A rigid sphere of 1 m is pressed 0.1 mm into an elastic block (a quarter of it, 30 contact radii wide, cells "
    "growing away from the contact: a tenth of the contact radius at n = 22). Hertz (1882): force and contact radius "
    "at the depth that is reached, which is corrected for the bottom of the block (Boussinesq).",
    measure, ERRORS,
    short=(_settings(8, 1), _settings(11, 1), _settings(16, 1), _settings(8, 2)),
    full=(_settings(6, 2), _settings(16, 1, 1), _settings(22, 1), _settings(11, 2)),
    figures=tuple(f"{name}, signed" for name in ERRORS), limit=600.0,
)  # fmt: skip
