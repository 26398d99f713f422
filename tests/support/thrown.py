"""A block of which a corner is thrown off, a few nodes at once: on any number of ranks."""

from __future__ import annotations

import numpy as np

from fracsim.scene import Scene
from fracsim.solvers import nonlinear_elimination
from support.solver_policy import other_policy

from .scenes import Walk, make_scene, positions
from .torn import Found


def thrown(steps: int = 3) -> tuple[Scene, Walk]:
    """The scene, and its state after some steps."""
    scene, state = make_scene(
        mesh={"builder": "box", "size": [1.0, 1.0, 1.0], "h": 0.2}, solver={"snes_rtol": 1e-10},
        material={"energy": "neo-hookean", "young": 1e4, "poisson": 0.3, "density": 1.0},
        fracture={"strength": 1e9}, boundary=[{"on": "left", "fix": "xyz"}],
        time={"scheme": "backward-euler", "step": 0.01, "end": 1.0},
    )  # fmt: skip
    assert scene.solver is not None
    scene.solver.edges_broke(None)
    v = np.zeros_like(positions(scene))
    v[np.linalg.norm(positions(scene) - 1.0, axis=1) < 0.1] = -40.0  # through the cells behind it in a step
    state.v = v.reshape(-1)
    state.settle()
    for _ in range(steps):
        state.advance()
    return scene, state


def compared() -> Found:
    """Where its nodes are after three steps, in the order of the input mesh, and how often some came to rest."""
    rest, rested = nonlinear_elimination.NonlinearElimination.relax_nodes, []
    nonlinear_elimination.NonlinearElimination.relax_nodes = lambda self, little: (
        rest(self, little) and not rested.append(1)
    )  # type: ignore[method-assign]
    with other_policy(max_relaxed_nodes=0.2):
        scene, state = thrown()
    nonlinear_elimination.NonlinearElimination.relax_nodes = rest  # type: ignore[method-assign]
    return {
        "thrown-u": scene.domain.input_numbering.gather_nodes(state.u.reshape(-1, 3)),
        "thrown-rested": np.array([len(rested)]),
    }
