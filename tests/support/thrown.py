"""A block of which a corner is thrown off, a few nodes at once: on any number of ranks."""

from __future__ import annotations

import numpy as np

from fracsim.scene import Scene
from fracsim.solvers import line_search, nonlinear_elimination
from support.solver_policy import other_policy

from .scenes import Values, Walk, make_scene, positions
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


def _held_back(scene: Scene) -> Values:
    """(n, 1) lengths."""
    domain, y = scene.domain, scene.balance.work_vector.duplicate()
    near = np.exp(-100 * np.sum((positions(scene) - 1.0) ** 2, axis=1))
    y.array_w[:] = np.repeat(100 * domain.mean_edge_length * near, 3)
    line_search.clip_correction(domain, y, y)
    return np.asarray(np.linalg.norm(y.array_r.reshape(-1, 3), axis=1)[:, None] / domain.mean_edge_length)


def compared() -> Found:
    """Where its nodes are after three steps, in the order of the input mesh; how often some came to rest; and how far,
    in edges, nodes go of a correction that would throw those near a corner."""
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
        "thrown-held": scene.domain.input_numbering.gather_nodes(_held_back(scene)),
    }
