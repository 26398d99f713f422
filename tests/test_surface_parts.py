"""The split surface of which each rank has the part of its cells: one closed surface, the same on 1, 2 and 3 ranks."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np
import pytest
import pyvista

from support.ranks import Arrays, OnRanks, run_on_ranks
from support.surface_parts import BODIES, FRAMES, RANK_KINDS
from test_surface_output import rows_of

RANKS = (1, 2, 3)


@pytest.fixture(scope="module")
def surfaces(tmp_path_factory: pytest.TempPathFactory) -> OnRanks:
    """What support/surface_parts.py saves on a rank count, and the folder of its runs."""
    folder = tmp_path_factory.mktemp("surfaces")

    @cache
    def run(ranks: int) -> tuple[Arrays, Path]:
        return run_on_ranks("support.surface_parts", ranks, folder), folder / f"surface_parts-{ranks}"

    return run


def of_body(found: Arrays, name: str) -> Arrays:
    return {key.removeprefix(f"{name}:"): values for key, values in found.items() if key.startswith(f"{name}:")}


@pytest.mark.ranks
@pytest.mark.parametrize("ranks", RANKS)
@pytest.mark.parametrize("name", BODIES)
def test_the_surface_is_that_of_the_whole_mesh_on_one_rank(surfaces: OnRanks, name: str, ranks: int) -> None:
    """Topology, reference places, parents, pieces and names, to the last bit, on any number of ranks; smooth ones too.

    Broken edges cross borders between ranks; the square has two cells, so that of three ranks one has none.
    """
    (serial, _), (found, _) = surfaces(1), surfaces(ranks)
    expected, expected_smooth, surface, restarted, smooth = (of_body(*each) for each in (
        (serial, f"{name}-whole"), (serial, f"{name}-whole-smooth"),
        (found, name), (found, f"{name}-restarted"), (found, f"{name}-smooth")))  # fmt: skip
    assert np.array_equal(surface["graph-piece"], surface["piece"])
    for key, values in expected.items():
        assert np.array_equal(surface[key], values), key
        assert key == "overlap" or np.array_equal(restarted[key], values), key
        assert np.array_equal(smooth[key], expected_smooth[key]), key
    if name != "square":
        assert not np.array_equal(smooth["points"], surface["points"])
        assert surface["nodes"].max() > 1 == surface["nodes"].min()
        # nodes are split: several points follow one node alone
        single = surface["parents"][np.count_nonzero(surface["parents"] >= 0, axis=1) == 1, 0]
        assert np.bincount(single).max() > 2


@pytest.mark.ranks
@pytest.mark.parametrize("ranks", RANKS)
@pytest.mark.parametrize("name", BODIES)
def test_the_files_are_those_of_one_rank(surfaces: OnRanks, name: str, ranks: int) -> None:
    """Those of a restarted run too; on one rank they have the bytes of the files of the whole mesh."""
    (_, one), (_, several) = surfaces(1), surfaces(ranks)
    files = [f"surface/surface_{number:06d}.vtu" for number in range(FRAMES)]
    for kind in RANK_KINDS:
        of_whole = f"{name}-whole" + "-smooth" * (kind == "-smooth")
        for file in files:
            path, twin = several / f"{name}{kind}" / file, one / of_whole / file
            assert ranks > 1 or path.read_bytes() == twin.read_bytes()
            expected, read = pyvista.read(twin), pyvista.read(path)
            assert np.array_equal(read.cells, expected.cells)
            assert np.array_equal(read.celltypes, expected.celltypes)
            assert read.field_data["origins"].tolist() == expected.field_data["origins"].tolist()
            assert read.point_data.keys() == expected.point_data.keys() == ["displacement", "velocity", "piece"]
            assert set(read.cell_data.keys()) == {"piece", "origin", "cell", "dust", "age", "stress", "region"}
            for key in expected.cell_data:
                assert np.array_equal(read.cell_data[key], expected.cell_data[key]), key
            # sums over the cells around a node have another order on several ranks
            for key in expected.point_data:
                assert np.allclose(read.point_data[key], expected.point_data[key], rtol=1e-6, atol=1e-6), key
            assert np.allclose(read.points, expected.points, rtol=1e-6, atol=1e-6)
        rows, expected_rows = rows_of(several / f"{name}{kind}"), rows_of(one / of_whole)
        assert len(rows) == len(expected_rows) >= FRAMES
        for row, expected_row in zip(rows, expected_rows, strict=True):
            assert row.keys() == expected_row.keys()
            assert np.allclose([*map(float, row.values())], [*map(float, expected_row.values())], atol=1e-9)


@pytest.mark.ranks
@pytest.mark.parametrize("ranks", RANKS)
@pytest.mark.parametrize("name", [name for name, (mesh, _, _) in BODIES.items() if mesh.dim == 3])
def test_the_surface_is_closed_around_every_piece(surfaces: OnRanks, name: str, ranks: int) -> None:
    """No open edge in any frame; the volumes of all pieces are those inside it, and sum up to that of the body."""
    folder = surfaces(ranks)[1] / name
    mesh = BODIES[name][0]
    volume = float(np.prod(np.ptp(mesh.points, axis=0)))
    rows = rows_of(folder)
    for number in range(FRAMES):
        grid = pyvista.read(folder / "surface" / f"surface_{number:06d}.vtu")
        grid.points -= grid.point_data["displacement"]
        volumes = {int(row["piece"]): float(row["volume"]) for row in rows if float(row["time"]) == number}
        assert sum(volumes.values()) == pytest.approx(volume, rel=1e-9)
        assert set(volumes) == set(grid.cell_data["piece"])
        skin = grid.extract_surface()
        assert skin.n_open_edges == 0
        for piece, expected in volumes.items():
            part = grid.extract_cells(grid.cell_data["piece"] == piece).extract_surface()
            assert part.n_open_edges == 0
            assert part.volume == pytest.approx(expected, rel=1e-4)


@pytest.mark.ranks
@pytest.mark.parametrize("ranks", RANKS)
def test_an_overlap_is_found_across_ranks(surfaces: OnRanks, ranks: int) -> None:
    """The same node of the same pieces at the same time, whichever rank has the cell."""
    (serial, _), (found, _) = surfaces(1), surfaces(ranks)
    for name in ("solid", "plate", "curved"):
        (overlap,) = found[f"{name}:overlap"].tolist()
        assert overlap == serial[f"{name}-whole:overlap"].tolist()[0] and "'pieces'" in overlap
