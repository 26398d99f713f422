"""Studies of contact at extremes of step, stiffness, mass and shape, as TOML data, and measures of their runs.

Known results: the impulse of a fall, the momentum of two bodies, Hooke's law in a press, and equal forces through a
stack. In no frame may a point of one body lie inside another.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from . import run_results, stability_studies
from .stability_measures import Figures, measure_run

Values = npt.NDArray[np.float64]

BARRIER_DISTANCE = (
    1e-3  # m, of the barrier before obstacles: the fall of a bar at 10 m/s in a hundred of the shortest steps
)
BAR_MASS = stability_studies.RUBBER["density"] * float(np.prod(stability_studies.BAR["size"]))  # kg, of the bar
BALL_RADIUS = 0.25  # m, of the ball
# m: contact acts at points, so that facets enter the ball between them by L^2 / (8 R), with L = sqrt(2) h the longest
# edge of a face; a crack may create points there
CHORD_HEIGHT = stability_studies.BAR["h"] ** 2 / (4 * BALL_RADIUS)
SOFT_MODULUS = 1e7  # Pa


# --- studies --------------------------------------------------------------------------------------------------------


def falling_bar(
    step: float, *, young: float = SOFT_MODULUS, speed: float = 10.0, gravity: float = 9.81, steps: int = 100,
    scheme: str = "backward-euler",
) -> stability_studies.Data:  # fmt: skip
    """Study of a bar that falls flat on a floor."""
    study = stability_studies.base_study("a bar falls on a floor", stability_studies.BAR, {"young": young}, steps)
    study["load"] = {"gravity": [0.0, 0.0, -gravity]}
    study["initial"] = {"velocity": [0.0, 0.0, -speed]}
    study["obstacle"] = [
        {"name": "floor", "shape": "plane", "at": [0.0, 0.0, -1.1 * BARRIER_DISTANCE], "normal": [0.0, 0.0, 1.0]}
    ]
    return _with_time(study, step, steps, scheme)


def bar_hit_by_ball(
    ratio: float, *, step: float = 1e-4, young: float = SOFT_MODULUS, steps: int = 100, scheme: str = "backward-euler"
) -> stability_studies.Data:
    """Study of a free bar hit beside its middle by a free ball of `ratio` times its mass at 10 m/s."""
    study = stability_studies.base_study("a bar struck by a ball", stability_studies.BAR, {"young": young}, steps)
    ball = {
        "name": "ball",
        "shape": "sphere",
        "radius": BALL_RADIUS,
        "at": [0.47, 0.12, 0.25 + BALL_RADIUS + 1.5 * BARRIER_DISTANCE],
    }
    study["obstacle"] = [ball | {"mass": ratio * BAR_MASS, "velocity": [0.0, 0.0, -10.0]}]
    return _with_time(study, step, steps, scheme)


def pressed_shell(thickness: float, *, young: float = SOFT_MODULUS) -> stability_studies.Data:
    """Study of a shell of 1 m^2 between two rigid blocks, pressed by about 10 % of its thickness; nu = 0."""
    mesh = {"builder": "box", "size": [1.0, 1.0, thickness], "h": 0.05}
    study = stability_studies.base_study(
        "a shell between blocks", mesh, {"young": young, "energy": "linear", "poisson": 0.0}, 20
    )
    gap = 0.05 * thickness
    block = {"shape": "box", "size": [1.2, 1.2, 0.5], "rounding": 0.01}
    down = {"time": [0.0, 1.0], "value": [[0.0, 0.0, 0.0], [0.0, 0.0, -3 * gap]]}
    study["obstacle"] = [
        block | {"name": "lower", "at": [0.5, 0.5, -0.25 - gap]},
        block | {"name": "upper", "at": [0.5, 0.5, 0.25 + thickness + gap], "displacement": down},
    ]
    # a little less than the gap: facets act a little farther away, and blocks within their reach would be moved back
    study["contact"] = {"itself": False, "distance": 0.9 * gap}
    study["time"] = {"scheme": "backward-euler", "step": 0.05, "end": 1.0}
    return study


def solid_stack() -> stability_studies.Data:
    """Study of the stack with a shell of 4 mm as one solid block."""
    _, study = shell_between_blocks(4e-3, 4e-3)
    motion = {"time": [0.0, 1.0], "value": [[0.0, 0.0, 0.0], [0.0, 0.0, -4e-3]]}
    block = {"mesh": {"builder": "box", "size": [0.5, 0.5, 0.504], "h": 0.125}}
    pressed = {"boundary": [{"on": "bottom", "fix": "xyz"}, {"on": "top", "displacement": motion}]}
    return without_contact(study) | block | pressed


def without_contact(study: stability_studies.Data) -> stability_studies.Data:
    """The same study without obstacles and contact."""
    alone = {key: table for key, table in study.items() if key not in ("obstacle", "contact", "probe")}
    return alone | {"output": study["output"] | {"surface": True}}


def shell_between_blocks(
    thickness: float, gap: float, *, young: float = SOFT_MODULUS
) -> tuple[Any, stability_studies.Data]:
    """Mesh and study of a deformable shell between two deformable blocks, `gap` apart, pressed until at rest."""
    upper = 0.25 + 2 * gap + thickness
    mesh = _join_meshes(
        _box((0.5, 0.5, 0.25), 0.125),
        _box((0.6, 0.6, thickness), 0.1, (-0.05, -0.05, 0.25 + gap)),
        _box((0.5, 0.5, 0.25), 0.125, (0.0, 0.0, upper)),
    )
    study = stability_studies.base_study(
        "a shell between blocks", {"file": "mesh.msh"}, {"young": young, "poisson": 0.0}, 20
    )
    down = {"time": [0.0, 1.0], "value": [[0.0, 0.0, 0.0], [0.0, 0.0, -2 * gap - 4e-3]]}
    base, top = ({"point": [0.0, 0.0, z], "normal": [0.0, 0.0, 1.0]} for z in (0.0, upper + 0.25))
    study["boundary"] = [{"on": base, "fix": "xyz"}, {"on": top, "displacement": down}]
    study["probe"] = [{"name": "base", "on": base}, {"name": "top", "on": top}]
    study["damping"] = {"mass": 50.0}
    study["time"] = {"scheme": "backward-euler", "step": 0.1, "end": 2.0}
    return mesh, study | {"contact": {}}


def block_on_block(step: float, *, young: float, speed: float, steps: int = 100) -> tuple[Any, stability_studies.Data]:
    """Mesh and study of a block that falls flat on a fixed one with another mesh: contact by `[contact]` alone."""
    mesh = _join_meshes(
        _box((0.5, 0.5, 0.25), 0.125), _box((0.4, 0.4, 0.25), 0.1, (0.03, 0.04, 0.25 + 1.1 * BARRIER_DISTANCE))
    )
    study = stability_studies.base_study("a block falls on a block", {"file": "mesh.msh"}, {"young": young}, steps)
    anvil = {"box": [[-1.0, -1.0, -1.0], [1.0, 1.0, 0.25 + BARRIER_DISTANCE / 2]]}
    study["boundary"] = [{"on": anvil, "fix": "xyz"}]
    study["probe"] = [{"name": "anvil", "on": anvil}]
    study["initial"] = {"velocity": [0.0, 0.0, -speed]}
    study["output"]["surface"] = True
    return mesh, _with_time(study, step, steps, "backward-euler") | {"contact": {"distance": BARRIER_DISTANCE}}


def _with_time(study: stability_studies.Data, step: float, steps: int, scheme: str) -> stability_studies.Data:
    """The study with a scheme, a step and outputs."""
    study["contact"] = {"itself": False, "distance": BARRIER_DISTANCE}
    study["time"] = {"scheme": scheme, "step": step, "end": steps * step}
    return study


def _box(size: tuple[float, ...], h: float, origin: tuple[float, ...] = ()) -> Any:
    """Mesh of a box of the given size, m, with cells of size h."""
    from ...meshes.builders.box import Box

    return Box(size=size, h=h, origin=origin).build()


def _join_meshes(*meshes: Any) -> Any:
    """One mesh of bodies that share no node."""
    from ...meshes.data import MeshData

    first = np.cumsum([0, *(len(item.points) for item in meshes)])
    cells = [item.cells + number for item, number in zip(meshes, first, strict=False)]
    return MeshData(np.concatenate([item.points for item in meshes]), np.concatenate(cells))


MESH_STUDIES = {
    "stacked-4mm": lambda: shell_between_blocks(4e-3, 4e-3),
    "itself-dt-1e-6": lambda: block_on_block(1e-6, young=SOFT_MODULUS, speed=10.0),
    "itself-dt-5e-2": lambda: block_on_block(5e-2, young=SOFT_MODULUS, speed=10.0),
    "itself-1e3-Pa": lambda: block_on_block(5e-3, young=1e3, speed=0.3),
    "itself-1e11-Pa": lambda: block_on_block(5e-3, young=1e11, speed=0.3),
}


# --- measures --------------------------------------------------------------------------------------------------------


def measure_fall(run: Path) -> Figures:
    """Figures of `measure_run`, error of the momentum balance along z, and number of points below the floor.

    The error of m v - m v_0 = sum dt f - m g t with the floor's force is relative to its impulse. It is computed for
    backward Euler, which satisfies the balance in each step.
    """
    if not (run / "history.csv").exists():
        return {}
    study, rows = run_results.study(run), run_results.history(run)
    (floor,) = study["obstacle"]
    below = [int((points[:, 2] <= floor["at"][2]).sum()) for _, points in surface_points(run)]
    figures = measure_run(run) | {"passed": sum(below)}
    if study["time"]["scheme"] != "backward-euler":
        return figures
    return figures | {"error": _impulse_error(run, -rows["contact_floor_z"])}


def measure_block_fall(run: Path) -> Figures:
    """Figures as of `measure_fall`, with the reaction of the fixed block, and nodes of one block inside the other."""
    if not (run / "history.csv").exists():
        return {}
    error = _impulse_error(run, run_results.history(run)["reaction_anvil_z"])
    return measure_run(run) | {"error": error, "passed": count_penetrating_nodes(run)}


def measure_impact(run: Path) -> Figures:
    """Figures of `measure_run`, error of the momentum of bar and ball, and points of the bar inside the ball.

    The error is relative to the momentum exchanged. Points that lie less than a chord's height inside the ball are not
    counted.
    """
    if not (run / "history.csv").exists():
        return {}
    (ball,), rows, pieces = (
        run_results.study(run)["obstacle"],
        run_results.history(run),
        run_results.columns(run / "pieces.csv"),
    )
    last = pieces["time"] == pieces["time"].max()
    given = np.array([(pieces["mass"] * pieces[f"velocity_{axis}"])[last].sum() for axis in "xyz"])
    kept = ball["mass"] * np.array([rows[f"velocity_ball_{axis}"][-1] for axis in "xyz"])
    exchanged = given + kept - ball["mass"] * np.array(ball["velocity"])
    centres = np.array([np.interp(pieces["time"], rows["time"], rows[f"position_ball_{axis}"]) for axis in "xyz"])
    inside = [
        int((np.linalg.norm(points - centres[:, pieces["time"] == t][:, 0],
                            axis=1) <= BALL_RADIUS - CHORD_HEIGHT).sum())
        for t, points in surface_points(run) if t > 0
    ]  # fmt: skip
    return measure_run(run) | {
        "error": float(np.linalg.norm(exchanged) / np.linalg.norm(given)), "passed": sum(inside),
    }  # fmt: skip


def measure_press(run: Path) -> Figures:
    """Figures of `measure_run`, and error of F = E A strain; the strain follows from the remaining gaps."""
    if not (run / "history.csv").exists():
        return {}
    study, rows = run_results.study(run), run_results.history(run)
    x, y, thickness = study["mesh"]["size"]
    lower, upper = study["obstacle"]
    faces = lower["at"][2] + 0.25, upper["at"][2] - 0.25 + upper["displacement"]["value"][-1][2]
    strain = 1 - (faces[1] - faces[0] - rows["gap_lower"][-1] - rows["gap_upper"][-1]) / thickness
    force = study["material"]["young"] * x * y * strain
    measured = np.array([-rows["contact_lower_z"][-1], rows["contact_upper_z"][-1]])
    *_, (_, points) = surface_points(run)
    out = (points[:, 2] <= faces[0]) | (points[:, 2] >= faces[1])
    return measure_run(run) | {"error": float(np.abs(measured / force - 1).max()), "passed": int(out.sum())}


def measure_stack(run: Path) -> Figures:
    """Figures of `measure_run`, error of the force through the stack, and nodes of one part inside another."""
    if not (run / "history.csv").exists():
        return {}
    rows = run_results.history(run)
    error = abs(rows["reaction_base_z"][-1] / rows["reaction_top_z"][-1] + 1)
    return measure_run(run) | {"error": float(error), "passed": count_penetrating_nodes(run)}


def _impulse_error(run: Path, force: Values) -> float:
    """Error of m v - m v_0 = sum dt f - m g t along z, relative to the impulse of f (steps,), N, on the body.

    A fixed body starts at rest.
    """
    study, rows, pieces = run_results.study(run), run_results.history(run), run_results.columns(run / "pieces.csv")
    t = pieces["time"]
    ends = [(pieces["mass"] * pieces["velocity_z"])[t == when].sum() for when in (t.min(), t.max())]
    weight = pieces["mass"][t == 0].sum() * -study.get("load", {}).get("gravity", [0.0, 0.0, 0.0])[2]
    impulse = (force * rows["dt"]).sum()
    return float(abs(ends[1] - ends[0] - impulse + weight * t.max()) / np.abs(force * rows["dt"]).sum())


def surface_points(run: Path) -> Iterator[tuple[float, Values]]:
    """Yield (time in s, points (n, 3) in m) of the split surface for each frame."""
    from ...output.surface.vtk_files import read_body_frames
    from .stability_measures import read_surface

    for t, file in read_body_frames(run / "surface.pvd"):
        yield t, np.asarray(read_surface(run / file).points, float)


def count_penetrating_nodes(run: Path) -> int:
    """Number of nodes in the last frame inside a cell of another body, by barycentric coordinates of all pairs."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    frame = run_results.last_frame(run)
    cells, x = frame["cells"], frame["points"] + frame["displacement"]
    pairs = cells[:, [0, 0, 0]].ravel(), cells[:, 1:].ravel()
    body = connected_components(coo_array((np.ones(len(pairs[0])), pairs), (len(x), len(x))))[1]
    corners = x[cells]
    sides = np.linalg.inv(np.swapaxes(corners[:, 1:] - corners[:, :1], 1, 2))
    weights = np.einsum("cij,cnj->cni", sides, x[None] - corners[:, :1])
    inside = (weights >= 0).all(axis=2) & (weights.sum(axis=2) <= 1)
    return int((inside & (body[cells[:, 0]][:, None] != body[None])).any(axis=0).sum())
