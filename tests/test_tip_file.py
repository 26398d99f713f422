"""File tips.csv: release rates and stress intensities against handbooks, tips that are followed, restarts and ranks."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest
from mpi4py import MPI

from fracsim.deformable_run import Run
from fracsim.output.tip_file import pair_nearest_first
from fracsim.scene import build_scene
from fracsim.studies.evidence.run_results import columns
from support.ranks import OnRanks, Results, starting
from support.tip_rows import LENGTH, edge_crack_intensity, strip, wedged


def test_stress_intensities_are_those_of_the_handbook(tmp_path: Path) -> None:
    """Of a crack that ends at the tip of the row, which lies in the cell where the segment ends."""
    run = Run(build_scene(MPI.COMM_SELF, strip()), tmp_path / "out")
    run.step()
    rows = columns(tmp_path / "out" / "tips.csv")
    K = edge_crack_intensity(rows["x"][0])
    assert rows["K_I"] == pytest.approx([K], rel=0.03) and abs(rows["K_II"][0]) < 0.05 * K
    assert rows["G"] == pytest.approx([K**2 * (1 - 0.3**2) / 1e3], rel=0.05)
    assert rows["length"] == pytest.approx([LENGTH], abs=1e-3) and rows["tip"] == [1]


def test_two_tips_keep_their_numbers_and_a_restart_goes_on(tmp_path: Path) -> None:
    whole, parts = tmp_path / "whole", tmp_path / "parts"
    run = Run(build_scene(MPI.COMM_SELF, wedged()), whole)
    run()
    rows = columns(whole / "tips.csv")
    for tip in (1, 2):
        x = rows["x"][rows["tip"] == tip]
        assert len(x) == 25 and 0.1 < abs(x[-1] - x[0]) < 0.6
        # A tip goes one way.
        assert np.all(np.diff(np.abs(x - 1.5)) < 1e-9)
    assert rows["length"][:2] == pytest.approx(0.8, abs=2e-3)
    # Before a crack grows G does with the square of the displacement; a tip that moved had reached G_c.
    G, t, x = (rows[name].reshape(25, 2) for name in ("G", "time", "x"))
    moved = np.diff(x, axis=0) != 0
    rest = int(np.argmax(moved.any(axis=1))) + 1
    assert rest > 10
    np.testing.assert_allclose(G[:rest] / t[:rest] ** 2, np.tile(G[:1], (rest, 1)), rtol=1e-6)
    assert np.all(moved.sum(axis=0) > 1) and G[:-1][moved].min() >= 1e-4
    assert np.all(G[: rest - 1] < 1e-4)
    run = Run(build_scene(MPI.COMM_SELF, wedged()), parts)
    half = int(rows["step"][-1]) // 2
    while run.state.step < half:
        run.step()
    run.checkpoint()
    run.step()
    run.history.close()
    run = Run(build_scene(MPI.COMM_SELF, wedged()), parts, restart=True)
    run()
    assert (parts / "tips.csv").read_bytes() == (whole / "tips.csv").read_bytes()


def test_a_file_with_other_columns_is_kept_beside(tmp_path: Path) -> None:
    run = Run(build_scene(MPI.COMM_SELF, wedged()), tmp_path / "out")
    run.step()
    run.checkpoint()
    run.history.close()
    shutil.copy(tmp_path / "out" / "history.csv", tmp_path / "out" / "tips.csv")
    run = Run(build_scene(MPI.COMM_SELF, wedged()), tmp_path / "out", restart=True)
    run.step()
    assert (tmp_path / "out" / "tips.csv.unreadable").exists()
    assert columns(tmp_path / "out" / "tips.csv")["step"].tolist() == [2, 2]


def test_phases_account_for_the_time_of_a_run(tmp_path: Path) -> None:
    """Of a crack that runs with inertia, which takes several passes in a step; rows of files are output."""
    study = strip(
        fracture={"strength": 1e3, "energy": 1e-4},
        time={"scheme": "backward-euler", "step": 2e-3, "end": 0.06},
    )
    summary = Run(build_scene(MPI.COMM_SELF, study), tmp_path / "out")()
    seconds = summary["seconds"]
    assert summary["broken_edges"] > 30 and seconds["fracture"] > 0.2 * seconds["solve"]
    assert sum(seconds.values()) == pytest.approx(summary["wall"], rel=0.1)


@pytest.mark.parametrize("count", [0, 1, 40, 300])
def test_tips_are_paired_nearest_first(count: int) -> None:
    """As by sorting all pairs of points of the same crack, where some have no partner left."""
    rng = np.random.default_rng(count)
    last, points = rng.random((count, 3)), rng.random((count + count // 3, 3))
    last_crack, crack = rng.integers(4, size=len(last)), rng.integers(5, size=len(points))
    distance = np.linalg.norm(points[:, None] - last, axis=2)
    expected, taken = np.full(len(points), -1), set[int]()
    for k, row in sorted(np.ndindex(distance.shape), key=lambda pair: float(distance[pair])):
        if crack[k] == last_crack[row] and expected[k] < 0 and row not in taken:
            expected[k] = row
            taken.add(row)
    np.testing.assert_array_equal(pair_nearest_first(last, last_crack, points, crack), expected)
    assert len(taken) < len(points) or not count


@pytest.fixture(scope="module")
def results(on_ranks: OnRanks) -> Results:
    """Arrays of a rank count."""
    return starting("tips-", on_ranks)


@pytest.mark.ranks
@pytest.mark.parametrize("ranks", (2, 3))
def test_rows_are_the_same_on_any_number_of_ranks(results: Results, ranks: int) -> None:
    found, serial = results(ranks)["rows"], results(1)["rows"]
    np.testing.assert_allclose(found, serial, rtol=1e-6, atol=1e-12)
