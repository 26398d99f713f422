"""[[crack]]: which edges are broken before the start, where they are cut, and what is refused."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mpi4py import MPI
from scipy.spatial import ConvexHull

from fracsim.deformable_run import Run
from fracsim.errors import InputError
from fracsim.mesh.crack_planes import plane_crack, polygon_crack, segment_crack
from fracsim.mesh.fragments import find_fragments
from fracsim.scene import Scene, build_scene
from fracsim.study.check import check_study
from support.scenes import make_study
from support.vtu import frames

HELD = [{"on": "bottom", "fix": "xy"}, {"on": "top", "displacement": {"time": [0, 1], "value": [[0, 0], [0, 1e-3]]}}]


def cracked(crack: list[dict[str, Any]], dim: int = 2, h: float = 0.1, **tables: Any) -> Scene:
    given = {
        "mesh": {"builder": "box", "size": [1.0] * dim, "h": h, "pattern": "unstructured"},
        "fracture": {"strength": 1e9},
        "crack": crack,
    }
    return build_scene(MPI.COMM_SELF, make_study(**(given | tables)))


def cut_points(scene: Scene) -> np.ndarray:
    """(n, d) places where edges were cut before the start."""
    breaking = scene.fracture
    assert breaking is not None and breaking.initial_cuts is not None
    broken = np.flatnonzero(breaking.graph.broken)
    ends = breaking.graph.edge_nodes[broken]
    nodes, number = scene.domain.nodes, scene.domain.input_numbering.nodes[ends]
    ends = np.where((number[:, 0] > number[:, 1])[:, None], ends[:, ::-1], ends)
    share = breaking.initial_cuts[broken, None]
    return np.asarray(nodes[ends[:, 0]] + share * (nodes[ends[:, 1]] - nodes[ends[:, 0]]))


def test_a_segment_cuts_what_it_crosses() -> None:
    """Every broken edge has its ends on two sides, and the crossing lies on the segment; all others have not."""
    start, end = np.array([-0.1, 0.37]), np.array([0.52, 0.56])
    scene = cracked([{"segment": [start.tolist(), end.tolist()]}])
    graph, nodes = scene.fracture.graph, scene.domain.nodes

    def side(a: Any, b: Any, c: Any) -> Any:
        return (b[..., 0] - a[..., 0]) * (c[..., 1] - a[..., 1]) - (b[..., 1] - a[..., 1]) * (c[..., 0] - a[..., 0])

    a, b = nodes[graph.edge_nodes[:, 0]], nodes[graph.edge_nodes[:, 1]]
    crosses = (side(start, end, a) * side(start, end, b) < 0) & (side(a, b, start) * side(a, b, end) < 0)
    np.testing.assert_array_equal(graph.broken, crosses)
    off = np.abs(side(start, end, cut_points(scene))) / np.linalg.norm(end - start)
    assert np.median(off) < 1e-15 and off.max() < 0.02 * 0.15  # cuts keep 2 % of an edge from its ends
    assert np.all(scene.balance.stress.chi.x.array[: scene.domain.cell_count] == ~graph.split)


@pytest.mark.parametrize("seed", (1, 2, 3))
def test_a_polygon_in_space_is_a_hole_of_its_area(seed: int) -> None:
    """Cuts lie in its plane; cells of which it has all that the plane cuts have come apart, those at a distance from it
    are whole; and what is cut through is as large as the polygon to 4 % (of cells with all of it inside: 17 % less)."""
    corners = np.array([[0.2, 0.2, 0.41], [0.8, 0.2, 0.41], [0.8, 0.7, 0.41], [0.2, 0.7, 0.41]])
    mesh = {"builder": "box", "size": [1.0] * 3, "h": 0.08, "pattern": "unstructured", "seed": seed}
    scene = cracked([{"polygon": corners.tolist()}], dim=3, mesh=mesh)
    assert np.median(np.abs(cut_points(scene)[:, 2] - 0.41)) < 1e-15
    domain, graph = scene.domain, scene.fracture.graph
    sections = [section(domain.nodes[cell], 0.41) for cell in domain.cell_nodes]
    crossed = np.array([len(each) > 2 for each in sections])
    inside = np.array([bool(len(each)) and in_rectangle(each, 0.0).all() for each in sections])
    outside = np.array([not len(each) or not in_rectangle(each, 0.1).any() for each in sections])
    assert graph.split[crossed & inside].all() and not graph.split[outside].any()
    held = sum(ConvexHull(sections[k]).volume for k in np.flatnonzero(graph.split))
    assert held == pytest.approx(0.3, rel=0.04)


def section(corners: np.ndarray, z: float) -> np.ndarray:
    """(n, 2) where the edges of a tetrahedron cross a height."""
    low, high = (corners[list(side)] for side in ((0, 0, 0, 1, 1, 2), (1, 2, 3, 2, 3, 3)))
    crosses = (low[:, 2] < z) != (high[:, 2] < z)
    low, high = low[crosses], high[crosses]
    return np.asarray(low + ((z - low[:, 2]) / (high[:, 2] - low[:, 2]))[:, None] * (high - low))[:, :2]


def in_rectangle(points: np.ndarray, margin: float) -> np.ndarray:
    return np.all((points > 0.2 - margin) & (points < np.array([0.8, 0.7]) + margin), axis=1)


def test_a_plane_along_nodes_cuts_one_row_of_edges() -> None:
    """A plane through a row of nodes leaves them all on one side: two pieces, and edges cut at 2 % of their length."""
    scene = cracked(
        [{"plane": {"point": [0.0, 0.5], "normal": [0.0, 2.0]}}], mesh={"builder": "box", "size": [1.0, 1.0], "h": 0.25}
    )
    assert find_fragments(scene.fracture.graph).count == 2
    np.testing.assert_allclose(np.abs(cut_points(scene)[:, 1] - 0.5), 0.02 * 0.25, rtol=1e-9)


def test_a_plate_with_a_crack_is_as_stiff_as_one_with_a_slit() -> None:
    """The energy that a pulled square stores with an edge crack of half its width is that of one with a narrow slit cut
    out of its mesh, to 4 % (h = 1/30; a crack ends somewhere in a cell), and less than that of a whole one."""
    stored = []
    slit = {"builder": "notched-plate", "length": 1.0, "height": 1.0, "notch_length": 0.5, "notch_width": 1e-3}
    whole = {"builder": "box", "size": [1.0, 1.0], "pattern": "unstructured"}
    for mesh, crack in ((slit | {"h_tip": 1 / 30}, []), (whole, [{"segment": [[0.0, 0.5], [0.5, 0.5]]}]), (whole, [])):
        scene = cracked(
            crack, mesh=mesh | {"h": 1 / 30}, boundary=HELD, time={"scheme": "quasi-static", "step": 1.0, "end": 1.0}
        )
        stored.append(scene.stepper.advance(scene.start())[1].elastic)
    assert stored[1] == pytest.approx(stored[0], rel=0.04)
    assert stored[1] < 0.9 * stored[2]


def test_a_crack_gives_way_as_one_of_the_length_asked_for() -> None:
    """Energy of a pulled square against that of slits of 0.45 and 0.55 m, each as a share of a whole one's: ten cracks
    of random lengths and heights are within 0.2 h in the mean, though the last cell is cut on one side alone."""
    steps = {"scheme": "quasi-static", "step": 1.0, "end": 1.0}

    def share(mesh: dict[str, Any], crack: list[dict[str, Any]], whole: float = 1.0) -> float:
        scene = cracked(crack, mesh=mesh, boundary=HELD, time=steps)
        return float(scene.stepper.advance(scene.start())[1].elastic) / whole

    h, random, off = 1 / 20, np.random.default_rng(0), []
    plain = {"builder": "box", "size": [1.0, 1.0], "h": h, "pattern": "unstructured"}
    slit = {"builder": "notched-plate", "length": 1.0, "height": 1.0, "notch_width": 1e-4, "h": 0.03, "h_tip": 1 / 500}
    whole = share(plain | {"h": 0.02}, [])
    low, high = (share(slit | {"notch_length": length}, [], whole) for length in (0.55, 0.45))
    for seed in range(1, 11):
        mesh, length, y = plain | {"seed": seed}, random.uniform(0.45, 0.55), 0.5 + random.uniform(-0.01, 0.01)
        found = share(mesh, [{"segment": [[0.0, y], [length, y]]}], share(mesh, []))
        off.append((0.45 + 0.1 * (high - found) / (high - low) - length) / h)
    assert abs(np.mean(off)) < 0.2 and np.std(off) < 0.4


def test_the_surface_is_drawn_through_the_cuts(tmp_path: Path) -> None:
    """The crack is there in the first frame, as old as the run, straight through its cuts."""
    scene = cracked(
        [{"segment": [[0.0, 0.5], [0.5, 0.5]]}], boundary=HELD, output={"picture": False},
        time={"scheme": "quasi-static", "step": 0.5, "end": 0.5},
    )  # fmt: skip
    Run(scene, tmp_path / "out")()
    first = frames(tmp_path / "out")[0]
    used = first.points[np.unique(first.segments), :2]
    inside = used[(used[:, 0] > 1e-9) & (used[:, 0] < 0.499) & (np.abs(used[:, 1] - 0.5) < 0.05)]
    assert len(inside) > 6 and np.median(np.abs(inside[:, 1] - 0.5)) < 1e-12


@pytest.mark.parametrize(
    ("crack", "tables", "message"),
    [
        ({"segment": [[2.0, 0.5], [3.0, 0.5]]}, {}, r"crack\.0 lies outside the body, which spans \(0, 0\) to"),
        ({"segment": [[0.5, 0.5], [0.5, 0.50001]]}, {}, r"crack\.0 cuts no edge .* shorter than the cells there"),
        ({"segment": [[0.5, 0.5], [0.5, 0.5]]}, {}, r"crack\.0\.segment: both ends are \[0\.5, 0\.5\]"),
        ({"segment": [[0.0, 0.5, 0.0], [0.5, 0.5, 0.0]]}, {}, r"crack\.0\.segment = .*: this mesh needs 2 numbers"),
        ({"polygon": [[0.0, 0.5, 0], [0.5, 0.5, 0], [1, 1, 0]]}, {}, r"crack\.0\.polygon is for 3D meshes"),
        ({"plane": {"point": [0, 0.5], "normal": [0, 0]}}, {}, r"crack\.0\.plane: the normal must not be zero"),
        (
            {"segment": [[-1.0, 0.5], [2.0, 0.5]]},
            {"time": {"scheme": "quasi-static", "step": 1.0, "end": 1.0}, "boundary": HELD},
            r"crack\.0 cuts the body in two, and quasi-static loads have no answer.*scheme with inertia",
        ),
    ],
)
def test_refused(crack: dict[str, Any], tables: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message):
        cracked([crack], **tables)


def test_refused_in_the_study_file() -> None:
    with pytest.raises(ValueError, match=r"\[\[crack\]\] needs a \[fracture\] table"):
        make_study(crack=[{"segment": [[0, 0], [1, 1]]}])
    with pytest.raises(ValueError, match="give exactly one of segment, polygon, plane; found none"):
        make_study(crack=[{}], fracture={"strength": 1.0})


def test_check_tells_of_cracks() -> None:
    lines = check_study(make_study(crack=[{"segment": [[0, 0.3], [0.4, 0.3]]}], fracture={"strength": 1.0}))
    assert "cracks      1, broken before the start" in lines


def test_shapes_in_space() -> None:
    """A polygon need not be convex; one that is bent has no plane."""
    corners = np.array([[0, 0, 1], [2, 0, 1], [2, 2, 1], [1, 0.5, 1], [0, 2, 1]], float)
    crack = polygon_crack("it", corners)
    points = np.array([[0.2, 0.5, 1], [1.0, 1.5, 1], [1.8, 0.5, 1], [2.1, 0.5, 1], [2.0, 1.0, 1]])
    np.testing.assert_array_equal(crack.contains(points, 1e-9), [True, False, True, False, True])
    assert crack.intersects_box(np.zeros(3), np.full(3, 1.5)) and not crack.intersects_box(np.zeros(3), np.full(3, 0.9))
    corners[3, 2] = 1.5
    with pytest.raises(InputError, match="do not span a plane"):
        polygon_crack("it", corners)
    assert not plane_crack("it", np.array([0.0, 3.0]), np.array([0.0, 1.0])).intersects_box(np.zeros(2), np.ones(2))
    assert segment_crack("it", np.array([[-1.0, 0.5], [2.0, 0.6]])).intersects_box(np.zeros(2), np.ones(2))
