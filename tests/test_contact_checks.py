"""Notes at the end of a run: obstacles that were missed or met too fast, and pieces that pass through each other."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import meshio
import numpy as np
import numpy.typing as npt
import pytest
import pyvista
from mpi4py import MPI

from fracsim.deformable_run import Run
from fracsim.errors import Stopped
from fracsim.mesh import interpenetration
from fracsim.mesh.interpenetration import find_interpenetration
from fracsim.scene import build_scene
from support.scenes import make_study, positions
from support.solids import lattice

Values = npt.NDArray[np.float64]
Tables = dict[str, Any]

STRIP: Tables = {
    "mesh": {"builder": "box", "size": [1.0, 0.1], "h": 0.05},
    "material": {"energy": "neo-hookean", "young": 1e6, "poisson": 0.3, "density": 1.0},
    "obstacle": [{"name": "striker", "shape": "sphere", "radius": 0.1, "at": [0.5, 0.205], "velocity": [0.0, -1.0]}],
    "time": {"scheme": "generalized-alpha", "step": 5e-3, "end": 2e-2}, "solver": {}, "output": {"picture": False},
}  # fmt: skip


def begun(tables: Tables, folder: Path, **how: Any) -> Run:
    return Run(build_scene(MPI.COMM_SELF, make_study(**tables)), folder, **how)


def notes(tables: Tables, folder: Path, capsys: pytest.CaptureFixture[str]) -> list[str]:
    begun(tables, folder)()
    return [line for line in capsys.readouterr().err.splitlines() if line.startswith("fracsim: note")]


def struck(**more: Any) -> Tables:
    return STRIP | {"obstacle": [STRIP["obstacle"][0] | more]}


# --- obstacles ------------------------------------------------------------------------------------------------------


def test_a_striker_that_the_steps_can_follow_needs_no_word(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """5 mm a step, an edge of some 35."""
    assert not [note for note in notes(STRIP, tmp_path, capsys) if "striker" in note]


def test_a_striker_faster_than_its_steps(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """20 m/s are 0.1 m in 5 ms; the mean edge is sqrt(0.05^2 / 2) m, so that a step of 1.77 ms is short enough. The
    floor below is out of reach all the time: 3 m less what the strip is pushed."""
    tables = struck(velocity=[0.0, -20.0], at=[0.5, 0.25])
    tables["obstacle"] += [{"name": "floor", "shape": "plane", "at": [0.0, -3.0], "normal": [0.0, 1.0]}]
    missed, fast = (note for note in notes(tables, tmp_path, capsys) if "floor" in note or "striker" in note)
    assert "the obstacle floor never met the body: it came no nearer than 2." in missed and "t = 0.02 s" in missed
    assert "striker and the body met faster than the step can follow: at t = 0.005 s they closed in by 0.1 m" in fast
    assert "an edge of the mesh is 0.0354 m; a time.step of 0.001 s would do" in fast


def test_a_body_that_falls_fast_on_what_is_held(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """It is the motion of both that counts."""
    tables = struck(velocity=[0.0, 0.0], at=[0.5, -0.105]) | {"initial": {"velocity": [0.0, -20.0]}}
    (note,) = (note for note in notes(tables, tmp_path, capsys) if "striker" in note)
    assert "at t = 0.005 s they closed in by 0.1 m in 0.005 s" in note


@pytest.mark.parametrize("scheme", ("backward-euler", "explicit"))
def test_a_needle_does_not_pass_between_the_points(
    scheme: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """2 cm across, an edge of some 3.5: facets feel it; where it never comes, that alone is said."""
    tables = struck(radius=0.01, at=[0.5, 0.5]) | {"time": STRIP["time"] | {"scheme": scheme}}
    (note,) = notes(tables, tmp_path, capsys)
    assert "the obstacle striker never met the body: it came no nearer than 0.37 m" in note


@pytest.mark.parametrize(("stiffness", "told"), ((1e3, True), (None, False)))
def test_a_press_that_enters_the_body_in_explicit_steps(
    stiffness: float | None, told: bool, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A soft penalty lets a plate, which sinks at 1 m/s, into the strip; the note has the depth at the end.

    The depth is that of the points in contact, which lie inside of the facets: nodes at the ends of the strip are 5 %
    deeper.
    """
    plate = {"name": "plate", "shape": "plane", "at": [0.0, 0.101], "normal": [0.0, -1.0], "velocity": [0.0, -1.0]}
    contact = {"itself": False} | ({} if stiffness is None else {"stiffness": stiffness})
    tables = STRIP | {"obstacle": [plate], "contact": contact, "boundary": [{"on": "bottom", "fix": "xy"}]}
    tables |= {"time": STRIP["time"] | {"scheme": "explicit", "end": 0.02}}
    run = begun(tables, tmp_path)
    run()
    found = [line for line in capsys.readouterr().err.splitlines() if "plate was inside the body by up to" in line]
    assert bool(found) == told
    if told:
        top = positions(run.scene)[:, 1] + run.state.u.reshape(-1, 2)[:, 1]
        depth = float(found[0].split("up to ")[1].split(" m,")[0])
        assert depth >= 0.95 * (top.max() - (0.101 - 0.02)) > 0.1 * run.scene.domain.mean_edge_length


def test_a_table_that_moves_along_is_not_fast(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A strip a little above its table, both going up at 20 m/s, falls on it by its weight: nothing strikes."""
    table = {"name": "table", "shape": "plane", "at": [0.0, -2e-3], "normal": [0.0, 1.0], "velocity": [0.0, 20.0]}
    tables = STRIP | {"obstacle": [table], "initial": {"velocity": [0.0, 20.0]}, "load": {"gravity": [0.0, -10.0]}}
    tables["time"] = {"scheme": "backward-euler", "step": 5e-3, "end": 0.05}
    assert not [note for note in notes(tables, tmp_path, capsys) if "table" in note]


def test_it_is_told_after_a_restart_too(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The blow was before the checkpoint; and a run that was stopped does not say what was missed."""
    tables = struck(velocity=[0.0, -20.0], at=[0.5, 0.25])
    tables["obstacle"] += [{"name": "floor", "shape": "plane", "at": [0.0, -3.0], "normal": [0.0, 1.0]}]
    stopped = begun(tables, tmp_path)
    stopped.interrupt.stop_reason = lambda: "the test" if stopped.state.t > 0.008 else ""  # type: ignore[method-assign]
    with pytest.raises(Stopped):
        stopped()
    assert "never met" not in capsys.readouterr().err
    begun(tables, tmp_path, restart=True)()
    told = capsys.readouterr().err
    assert "at t = 0.005 s they closed in by 0.1 m" in told and "the obstacle floor never met the body" in told


# --- pieces ---------------------------------------------------------------------------------------------------------


def two_blocks(dim: int) -> tuple[Values, npt.NDArray[np.int64], npt.NDArray[np.int64]]:
    """Points, cells and pieces of two unit blocks, of 4^d and 3^d lattice squares or cubes."""
    first, second = (lattice(*[number] * dim, size=1 / number) for number in (4, 3))
    cells = np.concatenate([first.cells, second.cells + len(first.points)]).astype(np.int64)
    piece = np.repeat([0, 1], [len(first.points), len(second.points)])
    return np.concatenate([first.points, second.points]), cells, piece


@pytest.mark.parametrize("dim", (2, 3))
def test_overlap_is_what_vtk_finds(dim: int) -> None:
    """The second block turned and shifted at random: nodes of the smaller one in cells of the other, by VTK."""
    points, cells, piece = two_blocks(dim)
    rng, found_at = np.random.default_rng(dim), 0
    in_space = lambda x: np.pad(x, ((0, 0), (0, 3 - dim)))  # noqa: E731
    kind = pyvista.CellType.TRIANGLE if dim == 2 else pyvista.CellType.TETRA
    grid = pyvista.UnstructuredGrid({kind: cells[piece[cells[:, 0]] == 0]}, in_space(points[piece == 0]))
    for _ in range(60):
        x = points.copy()
        turn = np.linalg.qr(rng.normal(size=(dim, dim)))[0]
        x[piece == 1] = (x[piece == 1] - 0.5) @ turn + rng.uniform(-1, 2, dim)
        inner = np.append(np.zeros((piece == 0).sum(), bool), grid.find_containing_cell(in_space(x[piece == 1])) >= 0)
        found = find_interpenetration(x, cells, piece)
        if found is None:
            assert inner.sum() <= 2  # all in the rim of their cells
        else:
            assert inner[found.node] and found.fragments == (1, 0)
            found_at += 1
    assert 10 < found_at < 50


@pytest.mark.parametrize("dim", (2, 3))
def test_blocks_that_touch_do_not_overlap(dim: int) -> None:
    """Side by side, and a little apart; pushed into one another by half an edge, and a little sideways, they do."""
    points, cells, piece = two_blocks(dim)
    for shift, meets in ((1.0, False), (1.1, False), (0.88, True)):
        x = points + (np.eye(dim)[0] * shift + 0.07 * np.arange(dim)) * piece[:, None]
        assert (find_interpenetration(x, cells, piece) is not None) == meets
    assert find_interpenetration(points, cells, np.zeros_like(piece)) is None


PAIR: Tables = {
    "material": {"energy": "linear", "young": 1.0, "poisson": 0.3, "density": 1.0}, "solver": {},
    "boundary": [{"on": {"box": [[-0.1, -0.1], [1.1, 1.1]]}, "fix": "xy"},
                 {"on": {"box": [[1.5, -0.1], [2.7, 1.1]]}, "displacement": {
                     "time": [0.0, 1.0], "value": [[0.0, 0.0], [-1.0, 0.0]]}}],
    "time": {"scheme": "quasi-static", "step": 0.25, "end": 1.0},
    "output": {"picture": False, "every": 1, "surface": True},
}  # fmt: skip


def two_bodies(folder: Path) -> Tables:
    """PAIR with its mesh: two blocks 0.6 m apart, of which one is driven through the other at 1 m/s."""
    points, cells, piece = two_blocks(2)
    points = points + piece[:, None] * [1.6, 0.04]
    meshio.write(folder / "two.msh", meshio.Mesh(points, [("triangle", cells)]), file_format="gmsh", binary=False)
    return PAIR | {"mesh": {"file": str(folder / "two.msh")}}


def test_pieces_pass_through_each_other(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """They touch at 0.6 s, and are in each other in the next frame: said once, with its time."""
    (note,) = notes(two_bodies(tmp_path), tmp_path / "out", capsys)
    assert "pieces 0 and 1 pass through each other, first seen at t = 0.75 s near (" in note
    assert note.endswith("; a [contact] table keeps them apart")
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    seen = summary["passed_through"]
    assert seen["time"] == pytest.approx(0.75) and seen["pieces"] == [0, 1] and 0.85 < seen["place"][0] < 1
    assert summary["pieces"] == 2


def test_pieces_are_told_of_after_a_restart(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Stopped once it was seen: not looked for again, and told at the end all the same."""
    tables = two_bodies(tmp_path)
    stopped = begun(tables, tmp_path / "out")
    stopped.interrupt.stop_reason = lambda: "the test" if stopped.state.t > 0.7 else ""  # type: ignore[method-assign]
    with pytest.raises(Stopped):
        stopped()
    assert "first seen at t = 0.75 s" in capsys.readouterr().err
    begun(tables, tmp_path / "out", restart=True)()
    assert "first seen at t = 0.75 s" in capsys.readouterr().err


def test_one_piece_is_not_looked_at(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def never(*_: object) -> None:
        raise AssertionError

    monkeypatch.setattr("fracsim.mesh.interpenetration.find_interpenetration", never)
    one = begun(STRIP, tmp_path)
    assert one.monitors.interpenetration is not None
    one()


def test_nothing_is_looked_for_where_it_is_not_wanted(tmp_path: Path) -> None:
    monitors = begun(two_bodies(tmp_path) | {"output": PAIR["output"] | {"surface": False}}, tmp_path / "out").monitors
    assert monitors.interpenetration is None and monitors.intersections is None


def test_pieces_that_contact_fails_to_keep_apart(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Without collision detection contact lets bodies into each other: both monitors tell, and summary.json."""
    monkeypatch.setattr("fracsim.contact.ipc_pairs.IpcPairs.free_fraction", lambda *_: 1.0)
    deep, facets = notes(two_bodies(tmp_path) | {"contact": {"distance": 1e-3}}, tmp_path / "out", capsys)
    assert "pieces 0 and 1 pass through each other in spite of [contact], first seen at t = 0.75 s" in deep
    assert deep.endswith("; a shorter time.step may help")
    assert "of facets of the body cut each other, first seen at t = 0.75 s near (" in facets
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    (seen,) = summary["facets_intersect"].values()
    assert seen["time"] == pytest.approx(0.75) and seen["pairs"] > 1 and summary["passed_through"]["pieces"] == [0, 1]


def test_pieces_that_a_penalty_does_not_keep_apart(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Explicit steps, in which nothing holds up a prescribed motion."""
    tables = two_bodies(tmp_path) | {"contact": {}, "time": {"scheme": "explicit", "step": 0.05, "end": 1.0}}
    tables["output"] = PAIR["output"] | {"every": 5}
    (deep,) = (note for note in notes(tables, tmp_path / "out", capsys) if "pass through" in note)
    assert "pieces 0 and 1 pass through each other in spite of [contact], first seen at t = 0." in deep


@pytest.mark.parametrize("itself", [True, "pieces"])
def test_pieces_that_contact_keeps_apart_need_no_word(
    itself: bool | str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The second block is held at its far end alone, and gives way."""
    tables = two_bodies(tmp_path) | {"contact": {"itself": itself}}
    tables["boundary"] = [PAIR["boundary"][0], PAIR["boundary"][1] | {"on": {"box": [[2.55, -0.1], [2.7, 1.1]]}}]
    run = begun(tables | {"time": PAIR["time"] | {"end": 0.75}}, tmp_path / "out")
    run()
    assert run.monitors.interpenetration is not None and run.monitors.intersections is not None
    assert not run.monitors.interpenetration.first_overlap and not run.monitors.intersections.first_seen
    told = capsys.readouterr().err
    assert "pass through" not in told and "cut each other" not in told


@pytest.mark.parametrize("dim", [2, 3])
def test_boxes_that_overlap(dim: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Those of all pairs whose boxes overlap on each axis: boxes that touch, slabs, points and several batches."""
    monkeypatch.setattr(interpenetration, "PAIRS_AT_A_TIME", 64)
    random = np.random.default_rng(3)
    lower = random.integers(0, 6, (90, dim)).astype(float)
    upper = lower + random.integers(0, 4, (90, dim))
    lower[:3, 0], upper[:3, 0] = 0.0, 20.0
    count = random.integers(1, 5, 90)
    small, large = interpenetration._overlapping_boxes(lower, upper, count)
    expected = {
        (i, j) if count[i] <= count[j] else (j, i)
        for i in range(90)
        for j in range(i + 1, 90)
        if np.all((lower[i] < upper[j]) & (lower[j] < upper[i]))
    }
    assert len(small) == len(expected) > 90
    assert set(zip(small.tolist(), large.tolist(), strict=True)) == expected
