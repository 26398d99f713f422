"""Length and tip of cracks: as asked for, and as edges break."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import meshio
import numpy as np
import pytest
from scipy.spatial import Delaunay

from fracsim.fracture.edge_history import EdgeHistory
from fracsim.output.crack_length import CrackExtent
from fracsim.study.conditions import initial_cracks as given
from support.scenes import make_scene


@pytest.mark.parametrize("dim", (2, 3))
def test_what_changes_is_enough(dim: int) -> None:
    """Edges break a few at a time, anywhere. The size is that of a front that has just been made. The tip lies on an
    edge that broke last, of a cell that holds together where there is one, found cell by cell."""
    scene, _ = make_scene(mesh={"builder": "box", "size": [1] * dim, "h": 0.25}, fracture={"strength": 1.0})
    graph, record = scene.fracture.graph, EdgeHistory(scene.fracture.graph)
    front, sizes, led = CrackExtent(record), [], 0
    order = np.random.default_rng(2).permutation(len(graph.broken))
    for t, edges in enumerate(np.array_split(order, 40)):
        graph.break_edges(np.isin(np.arange(len(order)), edges))
        record.record_breaks(float(t))
        front.update()
        sizes.append(front.values[0])
        np.testing.assert_allclose(front.values[0], CrackExtent(record).values[0], rtol=1e-12)
        last = set(np.flatnonzero(record.break_times == np.nanmax(record.break_times)).tolist())
        whole = [
            set(cell) & last for cell, split in zip(graph.cell_edges.tolist(), graph.split, strict=True) if not split
        ]
        into = set().union(*whole)
        led += bool(into)
        middles = graph.domain.nodes[graph.edge_nodes[sorted(into or last)]].mean(axis=1)
        assert np.abs(middles - front.values[1:]).sum(axis=1).min() < 1e-12
    assert 10 < led < 40 and max(sizes) > 0


@pytest.mark.parametrize("ahead", [1, 7])
def test_a_tip_that_has_left_stays_where_it_was(ahead: int) -> None:
    """A crack from the left, two that stand. It is cut across the body in steps of one edge or of seven: its tip goes
    to the right, and once it is through lies on the right side, not at one of the others."""
    cracks = [{"segment": [[0.0, 0.507], [0.3, 0.507]]}, {"segment": [[0.0, 0.8], [0.3, 0.8]]},
              {"segment": [[0.4, 0.2], [0.7, 0.3]]}]  # fmt: skip
    scene, _ = make_scene(
        mesh={"builder": "box", "size": [1.0, 1.0], "h": 0.05, "pattern": "unstructured"}, crack=cracks,
        fracture={"strength": 1.0},
    )  # fmt: skip
    graph, record = scene.fracture.graph, EdgeHistory(scene.fracture.graph)
    record.record_breaks(0.0, scene.fracture.initial_cuts)
    front = CrackExtent(record, given(scene.study, 2))
    ends = graph.domain.nodes[graph.edge_nodes]
    crossed = np.flatnonzero((ends[:, :, 1].min(axis=1) < 0.507) & (ends[:, :, 1].max(axis=1) > 0.507) & ~graph.broken)
    crossed = crossed[np.argsort(at_height(ends[crossed], 0.507))]
    seen, lengths = [], [front.values[0]]
    for t, k in enumerate(range(0, len(crossed), ahead)):
        graph.break_edges(np.isin(np.arange(len(graph.broken)), crossed[k : k + ahead]))
        record.record_breaks(t + 1.0)
        front.update()
        seen.append(front.values[1:].copy())
        lengths.append(front.values[0])
    assert len(seen) > 3 and np.all(np.diff([x for x, _ in seen]) > -0.03) and np.all(np.diff(lengths) > -1e-12)
    assert seen[-1] == pytest.approx([1.0, 0.507], abs=0.03)
    again = CrackExtent(record, given(scene.study, 2))  # as after a restart
    again.from_checkpoint(front.to_checkpoint())
    again.update()
    np.testing.assert_array_equal(again.values, front.values)


def at_height(ends: np.ndarray, y: float) -> np.ndarray:
    """(n,) x where edges (n, 2, 2) cross a height."""
    share = (y - ends[:, 0, 1]) / (ends[:, 1, 1] - ends[:, 0, 1])
    return np.asarray(ends[:, 0, 0] + share * (ends[:, 1, 0] - ends[:, 0, 0]))


LINES = [
    [[0.0, 0.5], [0.5, 0.5]], [[-0.2, 0.313], [0.411, 0.62]], [[0.9, 0.1], [0.2, 0.77]], [[0.25, 0.5], [0.75, 0.5]],
    [[0.3, 1.1], [0.3, 0.42]], [[0.15, 0.15], [0.62, 0.62]],
]  # fmt: skip


@pytest.mark.parametrize("mesh", ["structured", "unstructured", "turned", "scattered"])
@pytest.mark.parametrize("order", [1, 2])
def test_cracks_are_as_long_as_asked_for(mesh: str, order: int, tmp_path: Path) -> None:
    """Each segment alone, and three together: the length of what lies in the body, and a tip at an end that lies in it,
    to 0.08 h (cuts keep 2 % of an edge from nodes; before: up to 0.9 h short)."""
    h = 0.05
    for lines in ([LINES[0]], [LINES[1]], [LINES[2]], [LINES[3]], [LINES[4]], [LINES[5]], [LINES[1], LINES[3]]):
        scene, _ = make_scene(
            mesh=square(mesh, h, tmp_path) | {"order": order}, crack=[{"segment": line} for line in lines],
            fracture={"strength": 1.0},
        )  # fmt: skip
        record = EdgeHistory(scene.fracture.graph)
        record.record_breaks(0.0, scene.fracture.initial_cuts)
        length, *tip = CrackExtent(record, given(scene.study, 2)).values
        inside = [np.clip(line, 0.0, 1.0) if line is LINES[4] else cut_off(np.array(line)) for line in lines]
        assert length == pytest.approx(sum(np.linalg.norm(b - a) for a, b in inside), abs=0.08 * h * len(lines))
        ends = [end for line in lines for end in line if 0 < end[0] < 1 and 0 < end[1] < 1]
        assert min(np.linalg.norm(np.subtract(tip, end)) for end in ends) < 1e-12


def cut_off(line: np.ndarray) -> np.ndarray:
    """The part of a line with x >= 0."""
    (x, y), (right, top) = line
    return line if x >= 0 else np.array([[0.0, y - x * (top - y) / (right - x)], [right, top]])


def square(kind: str, h: float, folder: Path) -> dict[str, Any]:
    """[mesh] of a unit square."""
    if kind in ("structured", "unstructured"):
        return {"builder": "box", "size": [1.0, 1.0], "h": h, "pattern": kind}
    if kind == "scattered":
        (folder / "square.csv").write_text("0,0\n1,0\n1,1\n0,1\n")
        return {"outline": str(folder / "square.csv"), "h": h}
    # a lattice turned by 20 degrees: its points inside, and points on the sides
    turn = np.deg2rad(20.0)
    grid = np.stack(np.meshgrid(*[np.arange(-40, 41) * h] * 2), axis=-1).reshape(-1, 2)
    points = grid @ np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])
    points = points[np.all((points > 0.5 * h) & (points < 1 - 0.5 * h), axis=1)]
    side = np.linspace(0, 1, round(1 / h) + 1)
    around = [
        np.column_stack(each)
        for each in ((side, 0 * side), (side, 0 * side + 1), (0 * side, side), (0 * side + 1, side))
    ]
    points = np.unique(np.round(np.concatenate([points, *around]), 12), axis=0)
    meshio.Mesh(np.pad(points, ((0, 0), (0, 1))), [("triangle", Delaunay(points).simplices)]).write(
        folder / "square.vtu"
    )
    return {"file": str(folder / "square.vtu")}


def test_polygons_are_as_large_as_asked_for() -> None:
    """A pentagon that is not convex, aslant in space, of 0.2 m^2, to 4 % on each of three meshes and to 3 % in the
    mean; a plane through all of the body to 0.1 %."""
    flat = np.array([[0.2, 0.2], [0.8, 0.2], [0.8, 0.8], [0.5, 0.45], [0.2, 0.8]])
    area = 0.5 * abs(np.sum(flat[:, 0] * np.roll(flat[:, 1], -1) - np.roll(flat[:, 0], -1) * flat[:, 1]))
    polygon = np.column_stack([flat, 0.4 + 0.1 * flat[:, 0]]).tolist()
    plane = {"plane": {"point": [0.5, 0.5, 0.43], "normal": [0.0, 0.1, 1.0]}}
    for crack, exact, each, mean in (
        ({"polygon": polygon}, area * np.hypot(1, 0.1), 0.04, 0.03), (plane, np.hypot(1, 0.1), 1e-3, 1e-3),
    ):  # fmt: skip
        errors = []
        for seed in (1, 2, 3):
            box = {"builder": "box", "size": [1.0] * 3, "h": 0.08, "pattern": "unstructured", "seed": seed}
            scene, _ = make_scene(mesh=box, crack=[crack], fracture={"strength": 1.0})
            record = EdgeHistory(scene.fracture.graph)
            record.record_breaks(0.0, scene.fracture.initial_cuts)
            errors.append(CrackExtent(record, given(scene.study, 3)).values[0] / exact - 1)
        assert np.abs(errors).max() < each and abs(np.mean(errors)) < mean
