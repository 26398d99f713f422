"""A rigid sphere pressed into a block: force, depth and contact radius by Hertz (1882).

F = 4/3 E* sqrt(R) d^(3/2), a^2 = R d, E* = E / (1 - nu^2); K. L. Johnson: Contact Mechanics (1985), ch. 4.
"""

from __future__ import annotations

from pathlib import Path

import meshio
import numpy as np
import pytest

from fracsim.contact.obstacle_term import ObstacleTerm
from fracsim.meshes.builders.box import Box
from support.scenes import make_scene, march, positions

YOUNG, POISSON = 1e9, 0.3
RADIUS, DEPTH = 1.0, 1e-4  # m: the contact radius is 0.01 m
SIZE, GRADING = 30.0, 4.0  # of the block, in contact radii; cells at the contact are a tenth of one


def quarter(path: Path, n: int) -> str:
    """A block whose cells grow away from its corner at the origin, z up; the quarter x, y > 0 of the whole."""
    box = Box(size=(1.0, 1.0, 1.0), h=1.0 / n, origin=(0.0, 0.0, -1.0)).build()
    grown = np.sign(box.points) * np.expm1(GRADING * abs(box.points)) / np.expm1(GRADING)
    points = SIZE * np.sqrt(RADIUS * DEPTH) * grown
    meshio.Mesh(points, [("tetra", box.cells)]).write(path / "quarter.vtu")
    return str(path / "quarter.vtu")


@pytest.mark.slow
def test_a_sphere_on_a_half_space(tmp_path: Path) -> None:
    far = SIZE * np.sqrt(RADIUS * DEPTH)
    stiff = YOUNG / (1 - POISSON**2)
    gap = 2e-6
    scene, state = make_scene(
        mesh={"file": quarter(tmp_path, 22)},
        material={"energy": "linear", "young": YOUNG, "poisson": POISSON, "density": 1000.0},
        obstacle=[{"name": "ball", "shape": "sphere", "radius": RADIUS, "at": [0.0, 0.0, RADIUS + gap],
                   "displacement": {"time": [0.0, 1.0], "value": [[0.0] * 3, [0.0, 0.0, -DEPTH]]}}],
        contact={"itself": False, "distance": gap, "stiffness": YOUNG},
        boundary=[
            {"on": {"box": [[-1e-9, -9.0, -9.0], [1e-9, 9.0, 9.0]]}, "fix": "x"},
            {"on": {"box": [[-9.0, -1e-9, -9.0], [9.0, 1e-9, 9.0]]}, "fix": "y"},
            {"on": {"box": [[-9.0, -9.0, -1.001 * far], [9.0, 9.0, -0.999 * far]]}, "fix": "xyz"},
        ],
        time={"scheme": "quasi-static", "step": 0.25, "end": 1.0}, solver={"snes_rtol": 1e-8},
    )  # fmt: skip
    march(scene, state)
    (contact,) = [term for term in scene.balance.terms if isinstance(term, ObstacleTerm)]
    touch = contact.obstacle_forces()[0]
    pressed, r = -touch.normal[:, 2], np.linalg.norm(contact.positions[touch.points][:, :2], axis=1)
    total = 4 * pressed.sum()
    top = np.argmin(np.linalg.norm(positions(scene), axis=1))
    # the bottom of the block stands still, where that of a half space would sink: Boussinesq
    sunk = total * (1 + POISSON) * (3 - 2 * POISSON) / (2 * np.pi * YOUNG * far)
    depth = sunk - state.u.reshape(-1, 3)[top, 2]
    assert total == pytest.approx(4 / 3 * stiff * np.sqrt(RADIUS) * depth**1.5, rel=0.05)
    radius = np.sqrt(2.5 * (pressed @ r**2) / pressed.sum())  # of a pressure p0 sqrt(1 - (r/a)^2): <r^2> = 2/5 a^2
    assert radius == pytest.approx(np.sqrt(RADIUS * depth), rel=0.1)
