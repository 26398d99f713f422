"""Small scenes built from study tables, moved step by step in the test's own process."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from itertools import islice
from typing import Any

import numpy as np
import numpy.typing as npt
from mpi4py import MPI

from fracsim.meshes.data import MeshData
from fracsim.scene import Scene, build_scene
from fracsim.study import Study
from fracsim.timestepping.state import State
from fracsim.timestepping.stepper import StepReport

Values = npt.NDArray[np.float64]

# Newton's method with a direct solver: what is left is round-off, not a tolerance.
DIRECT = {"ksp_type": "preonly", "pc_type": "lu", "snes_rtol": 1e-11}


def make_study(**tables: Any) -> Study:
    """A study with the tables given; the others have small, plain defaults (E = 1 Pa, rho = 1 kg/m^3: c0 = 1 m/s)."""
    plain: dict[str, Any] = {
        "title": "test",
        "mesh": {"builder": "box", "size": [1.0, 1.0], "h": 0.5},
        "material": {"energy": "linear", "young": 1.0, "poisson": 0.0, "density": 1.0},
        "time": {"scheme": "newmark", "step": 0.1, "end": 1.0},
        "solver": DIRECT,
    }
    return Study.model_validate(plain | tables)


class Walk:
    """A scene on its way: the state of the moment, whose attributes it has, and the steps.

    Setting an attribute changes the state: `walk.v = ...`.
    """

    state: State

    def __init__(self, scene: Scene) -> None:
        vars(self).update(scene=scene, state=scene.start())

    def __getattr__(self, name: str) -> Any:
        return getattr(vars(self)["state"], name)

    def __setattr__(self, name: str, value: Any) -> None:
        vars(self)["state"] = value if name == "state" else replace(self.state, **{name: value})

    def advance(self) -> StepReport:
        """Take a step."""
        self.state, report = vars(self)["scene"].stepper.advance(self.state)
        return report

    def remember(self) -> None:
        """The body was damaged by hand: go on from there."""
        scene = vars(self)["scene"]
        scene.fracture.mark_changed()
        self.state = scene.stepper.inelastic.with_snapshot(self.state)

    def settle(self) -> None:
        """Forces and accelerations that belong to the displacement and the velocity."""
        self.state = vars(self)["scene"].stepper.with_forces(self.state)


def make_scene(**tables: Any) -> tuple[Scene, Walk]:
    """A scene on every rank of the world, at t = 0."""
    scene = build_scene(MPI.COMM_WORLD, make_study(**tables))
    return scene, Walk(scene)


def each_step(scene: Scene, state: Walk) -> Iterator[StepReport]:
    """Advance to the end of the study; `state` can be looked at after each step."""
    while state.t < scene.study.time.end * (1 - 1e-12):
        yield state.advance()


def march(scene: Scene, state: Walk, steps: int | None = None) -> list[StepReport]:
    """Advance to the end of the study, or by a number of steps."""
    return list(islice(each_step(scene, state), steps))


def mesh_of(scene: Scene) -> MeshData:
    """The mesh as it was built (serial)."""
    assert scene.domain.input_mesh is not None
    return scene.domain.input_mesh


def positions(scene: Scene) -> Values:
    """(nodes, d) reference positions of the owned nodes, in the order of the dofs."""
    return scene.domain.nodes[: scene.domain.node_count]


def displacement(scene: Scene, state: Walk | State) -> Values:
    """(nodes, d) displacement of the owned nodes."""
    return state.u.reshape(-1, scene.domain.dim)


def cell_corners(scene: Scene) -> Values:
    """(cells, d + 1, d) reference corners."""
    return scene.domain.nodes[scene.domain.cell_nodes]


def deform(scene: Scene, F: Values) -> None:
    """Give the body the homogeneous displacement u = (F - I) X."""
    X = positions(scene)
    scene.balance.set_displacement((X @ (F - np.eye(len(F))).T).reshape(-1))


def break_across(scene: Scene, normal: list[float], at: float) -> None:
    """Edges with an end on either side of normal . X = `at` break by hand, and all terms hear of it."""
    graph = scene.fracture.graph
    height = scene.domain.nodes[graph.edge_nodes] @ np.array(normal)
    graph.break_edges((height.min(axis=1) < at) & (height.max(axis=1) > at))
    scene.fracture.damage_restored()
    scene.balance.damage_changed()
    scene.balance.edges_broke(graph.pattern)


def at_nodes(points: Values, values: Values) -> list[dict[str, Any]]:
    """[[boundary]] entries that prescribe a displacement at each of the given nodes."""
    size = 1e-9
    return [
        {"on": {"box": [(p - size).tolist(), (p + size).tolist()]}, "displacement": np.asarray(u).tolist()}
        for p, u in zip(points, values, strict=True)
    ]
