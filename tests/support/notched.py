"""Plates of steel with a crack: the field around its tip in closed form, and one that is torn."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import numpy.typing as npt
from mpi4py import MPI

from fracsim.mesh.domain import distribute
from fracsim.scene import Scene, build_scene_on

from .scenes import make_study
from .squares import square
from .tips import criterion_of, tips

Values = npt.NDArray[np.float64]

YOUNG, POISSON = 210e9, 0.3
STIFF = YOUNG / (1 - POISSON**2)


def plate_tables(**fracture: Any) -> dict[str, Any]:
    return {
        "material": {"energy": "linear", "young": YOUNG, "poisson": POISSON, "density": 7800.0},
        "fracture": {"strength": 1e11, "energy": 2.7e3} | fracture,
    }


def near_tip(points: Values, first: float, second: float) -> Values:
    """(n, 2) displacement around the tip of a crack along - x with K_I, K_II in Pa sqrt(m), plane strain."""
    r, t = np.linalg.norm(points, axis=1), np.arctan2(points[:, 1], points[:, 0])
    mu, kappa = YOUNG / 2 / (1 + POISSON), 3 - 4 * POISSON
    c, s = np.cos(t / 2), np.sin(t / 2)
    opening = np.column_stack([c * (kappa - 1 + 2 * s**2), s * (kappa + 1 - 2 * c**2)])
    sliding = np.column_stack([s * (kappa + 1 + 2 * c**2), -c * (kappa - 1 - 2 * s**2)])
    return np.asarray((np.sqrt(r / (2 * np.pi)) / (2 * mu))[:, None] * (first * opening + second * sliding))


def plate(kind: str, n: int, side: float = 1.0, order: int = 1, **tables: Any) -> Scene:
    """A square of n by n cells of this kind, its side in m."""
    mesh = {"builder": "box", "size": [side, side], "h": side, "order": order}
    study = make_study(**plate_tables() | tables, mesh=mesh)
    return build_scene_on(distribute(MPI.COMM_SELF, square(kind, n, side), order), study)


def balanced(kind: str, n: int, end: float = 0.5, order: int = 1, start: float = 0.0, **tables: Any) -> Scene:
    """A square of 1 m with a crack from x = start to x = end, m, whose sides `put_in_balance` moves."""
    return plate(
        kind, n, order=order, crack=[{"segment": [[start, 0.507], [end, 0.507]]}],
        boundary=[{"on": side, "fix": "xy"} for side in ("left", "right", "bottom", "top")],
        time={"scheme": "quasi-static", "step": 1.0, "end": 1.0}, **tables,
    )  # fmt: skip


def put_in_balance(scene: Scene, u: Values) -> None:
    """Move the sides of a scene by the displacement (n, 2) of its nodes, m; its cracks are held."""
    motion, values = scene.balance.motion, u.ravel()
    criterion_of(scene).toughness = np.inf
    motion.displacements_at = lambda t, dofs=motion.dofs: values[dofs]  # type: ignore[method-assign,misc]
    scene.stepper.advance(scene.start())


def torn(scene: Scene) -> Iterator[tuple[float, float, Any]]:
    """(reaction in N/m, tip's x in m, state) of each step."""
    state = scene.start()
    while not scene.ended(state):
        state, _ = scene.stepper.advance(state)
        found = tips(scene)
        yield scene.probes()[1], float(found[0, 0]) if len(found) else np.nan, state


def notched(kind: str, n: int, end: float = 31.0, order: int = 1) -> Scene:
    """Miehe's plate of 1 mm, cut to its middle between two rows of nodes, pulled in steps of 0.6 % about its peak."""
    at = (0.5 + 0.3 / n) * 1e-3
    motion = {"time": [0, 1, 31], "value": [[0, 0], [0, 4.1e-6], [0, 4.85e-6]]}
    return plate(
        kind, n, 1e-3, order, crack=[{"segment": [[0.0, at], [5e-4, at]]}], probe=[{"name": "grip", "on": "top"}],
        boundary=[{"on": "bottom", "fix": "xy"}, {"on": "top", "displacement": motion}],
        time={"scheme": "quasi-static", "step": 1.0, "end": end},
    )  # fmt: skip
