"""Obstacles far from a body: the bound is below every distance by brute force, and changes no result."""

from __future__ import annotations

from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from scipy.spatial import cKDTree

from fracsim.contact.clearance import Clearance, FollowingPoints
from fracsim.contact.contact_state import ContactState
from fracsim.contact.mesh_obstacle_term import MeshObstacleTerm
from fracsim.contact.penalty_contact import PenaltyMeshContact
from fracsim.contact.pose import PosedShape
from fracsim.contact.triangle_mesh_shape import TriangleMeshShape
from fracsim.scene import Scene
from support.ranks import run_on_ranks
from support.scenes import make_scene, march

Values = npt.NDArray[np.float64]

RUBBER = {"energy": "neo-hookean", "young": 1e6, "poisson": 0.3, "density": 1000.0}
BAR = {"builder": "box", "size": [1.0, 0.5, 0.5], "h": 0.25}
TIMES = {
    "explicit": {"scheme": "explicit", "step": 0.01, "end": 0.05},
    "implicit": {"scheme": "newmark", "step": 0.01, "end": 0.05},
}


def axe(**keys: Any) -> dict[str, Any]:
    """A driven obstacle from a file."""
    file = str(Path(__file__).parent / "support" / "axe.obj")
    return {"name": "axe", "shape": "mesh", "file": file, "at": [0.5, 0.25, 3.0]} | keys


OBSTACLES: dict[str, dict[str, Any]] = {
    "plane": {"name": "it", "shape": "plane", "at": [0.0, 0.0, -0.9], "normal": [0.0, 0.0, 1.0]},
    "fast ball": {"name": "it", "shape": "sphere", "radius": 0.2, "at": [0.5, 0.25, 2.5], "velocity": [0, 0, -30.0]},
    "small ball": {"name": "it", "shape": "sphere", "radius": 0.05, "at": [0.4, 0.2, 1.0], "velocity": [0, 0, -20.0]},
    "spinning bar": {"name": "it", "shape": "box", "size": [3.0, 0.1, 0.1], "at": [0.5, 0.25, 2.8], "mass": 50.0,
                     "spin": [0.0, 120.0, 0.0], "velocity": [0.0, 0.0, -25.0]},
    "mesh": axe(velocity=[0.0, 0.0, -40.0]),
    "spinning mesh": axe(at=[0.5, 0.25, 6.0], spin=[0.0, 60.0, 0.0], velocity=[0.0, 0.0, -60.0]),
}  # fmt: skip


def clearance_of(scene: Scene) -> tuple[Clearance, FollowingPoints]:
    """The bound of the only term of obstacles, and the points that it is about."""
    for term in scene.balance.terms:
        if isinstance(term, ContactState | MeshObstacleTerm):
            return term.clearance, term.clearance._points()
        if isinstance(term, PenaltyMeshContact):
            return term._clearance, term._clearance._points()
    raise AssertionError("no obstacle")


def obstacle_of(scene: Scene) -> PosedShape:
    """The obstacle at the start."""
    for term in scene.balance.terms:
        if isinstance(term, ContactState | MeshObstacleTerm | PenaltyMeshContact):
            return term.group.posed[0]
    raise AssertionError("no obstacle")


def barycentric(corners: int) -> Values:
    """(k, corners) coordinates of points of a simplex, in steps of a sixth."""
    grid = np.array(list(product(range(7), repeat=corners)), float)
    return grid[grid.sum(axis=1) == 6] / 6


def least_distance(points: FollowingPoints, u: Values, posed: PosedShape, dim: int) -> float:
    """Least distance of points of the surface and, where they count, of points within its facets, by brute force."""
    x = points.reference + points.weights @ u.reshape(-1, dim)[points.nodes]
    if len(points.facets):
        weights = barycentric(points.facets.shape[1])
        x = np.concatenate([x, np.einsum("wc,mcd->wmd", weights, x[points.facets]).reshape(-1, dim)])
    shape = posed.shape
    if isinstance(shape, TriangleMeshShape):
        corners = posed.pose.points_to_space(shape.points)[shape.triangles]
        samples = np.einsum("wc,mcd->wmd", barycentric(3), corners).reshape(-1, 3)
        return float(cKDTree(samples).query(x)[0].min())
    return float(posed.distance(x).min())


@pytest.mark.parametrize("torn", (False, True), ids=("whole", "torn"))
@pytest.mark.parametrize("scheme", TIMES)
@pytest.mark.parametrize("name", OBSTACLES)
def test_nothing_far_is_near(name: str, scheme: str, torn: bool) -> None:
    """Random displacements of single nodes and of all, and random motions and rotations of the obstacle, one after
    another: what counts as far is farther than the reach by brute force. Both answers occur, and searches are few."""
    tables: dict[str, Any] = {"fracture": {"strength": 1e9}} if torn else {}
    scene, state = make_scene(mesh=BAR, material=RUBBER, obstacle=[OBSTACLES[name]], time=TIMES[scheme], **tables)
    if torn:
        graph, random = scene.fracture.graph, np.random.default_rng(3)
        graph.break_edges(random.random(len(graph.broken)) < 0.4)
        scene.fracture.mark_changed()
        scene.balance.edges_broke(graph.pattern)
    bound, _ = clearance_of(scene)
    posed, random = obstacle_of(scene), np.random.default_rng(1)
    size, dim, answers, searches = len(state.u), scene.domain.dim, [], 0
    u: Values = np.zeros(size)
    for trial in range(100):
        u = u + random.choice([0.0, 1e-3, 0.02]) * random.standard_normal(size)
        if trial % 3 == 0:  # one node moves far
            u = u.copy()
            u[dim * random.integers(size // dim) + random.integers(dim)] += random.normal(scale=0.5)
        if trial % 20 == 19:
            u = np.zeros(size)
        q = np.append(random.normal(scale=0.05, size=3), np.zeros(3))
        if "spinning" in name:
            q[3:] = random.normal(scale=0.7, size=3)
        before, posed = posed, PosedShape(posed.shape, posed.pose.incremented(q))
        last = bound._search
        is_far = bound.is_far([u], [(before, posed)])
        searches += bound._search is not last
        answers.append(is_far)
        if is_far:
            points = bound._points()
            assert least_distance(points, u, posed, dim) > bound._reach
            gap = bound.least_gap(0, u, [posed])
            x = points.reference + points.weights @ u.reshape(-1, dim)[points.nodes]
            obstacle = bound._obstacles[0]
            assert gap == pytest.approx(obstacle.distance(posed, x).min(), rel=1e-12)
    assert any(answers) and searches < 80


@pytest.mark.parametrize("scheme", TIMES)
@pytest.mark.parametrize("name", OBSTACLES)
def test_the_bound_changes_no_result(name: str, scheme: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """A body that flies and an obstacle that comes near, hits or passes: the same numbers as where nothing ever counts
    as far, but for the last digit, which depends on the processor."""
    results, end = [], 0.08 if scheme == "explicit" else 0.05
    for bounded in (True, False):
        if not bounded:
            monkeypatch.setattr(Clearance, "is_far", lambda *_: False)
        scene, state = make_scene(
            mesh=BAR, material=RUBBER, obstacle=[OBSTACLES[name]], initial={"velocity": [0.5, 0.0, -4.0]},
            time=TIMES[scheme] | {"end": end}, solver={"snes_rtol": 1e-9, "ksp_rtol": 1e-9},
        )  # fmt: skip
        rows = []
        for _ in range(200):
            if state.t >= end * (1 - 1e-12):
                break
            march(scene, state, 1)
            rows.append([state.t, *scene.probes(), *state.u, *state.v])
        results.append(np.array(rows))
    np.testing.assert_allclose(*results, rtol=1e-14, atol=1e-14 * np.abs(results[0]).max())


@pytest.mark.ranks
@pytest.mark.parametrize("ranks", (2, 3))
def test_ranks_agree_on_what_is_far(ranks: int, tmp_path: Path) -> None:
    """A body that flies towards a plane, a ball and an axe from a file: the same rows on any number of ranks."""
    one, several = (run_on_ranks("support.approached", count, tmp_path) for count in (1, ranks))
    for name, rows in one.items():
        np.testing.assert_allclose(several[name], rows, rtol=1e-7, atol=1e-9, err_msg=name)
        assert rows[:, 1].min() < 0.05 and rows[:, 1].max() > 0.3  # of the gap: far at first, near in the end
