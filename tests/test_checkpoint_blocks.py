"""Checkpoints are written and read a block of rows at a time: the same file on any number of ranks."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from pathlib import Path

import h5py
import numpy as np
import pytest

from fracsim.meshes.topology import edges_of
from fracsim.study.mesh_source import build_mesh
from support import written_checkpoint as written
from support.ranks import Arrays, run_on_ranks
from support.scenes import make_study

RANKS = (1, pytest.param(2, marks=pytest.mark.ranks), pytest.param(3, marks=pytest.mark.ranks))
KINDS = ("whole", "blocks")
Results = Callable[[int], Arrays]


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> Results:
    """Arrays of support/written_checkpoint.py on a rank count, run once."""
    folder = tmp_path_factory.mktemp("written")
    return cache(lambda ranks: run_on_ranks("support.written_checkpoint", ranks, folder, seconds=300))


@pytest.mark.parametrize("ranks", RANKS)
@pytest.mark.parametrize("name", written.CASES)
def test_the_file_is_the_same(results: Results, name: str, ranks: int) -> None:
    """To the last byte, in one block and in many."""
    for kind in KINDS:
        np.testing.assert_array_equal(results(ranks)[f"{name}-{kind}-file"], results(1)[f"{name}-whole-file"])


@pytest.mark.parametrize("ranks", RANKS)
@pytest.mark.parametrize("name", written.CASES)
def test_every_rank_reads_its_rows(results: Results, name: str, ranks: int) -> None:
    for kind in KINDS:
        assert results(ranks)[f"{name}-{kind}-different"].tolist() == []


@pytest.mark.parametrize("ranks", RANKS)
@pytest.mark.parametrize("name", written.CASES)
def test_rank_0_holds_one_block(results: Results, name: str, ranks: int) -> None:
    """Of edges as many more as have their lower end at one node."""
    edges = edges_of(build_mesh(make_study(**written.CASES[name]).mesh).cells)
    at_node = int(np.bincount(edges[:, 0]).max()) if name == "block" else 0
    assert results(ranks)[f"{name}-blocks-rows"] <= written.FEW + at_node < results(ranks)[f"{name}-whole-rows"] / 5


def test_the_file_has_what_the_numbers_say(results: Results, tmp_path: Path) -> None:
    """Rows of nodes and cells in the order of the input mesh, those of weakened edges by their ends."""
    mesh = build_mesh(make_study(**written.CASES["block"]).mesh)
    (tmp_path / "state.h5").write_bytes(results(1)["block-blocks-file"].tobytes())
    edges = edges_of(mesh.cells)
    weakened = edges[written.edge_integrity(edges) < 1]
    weakened = weakened[np.lexsort(weakened.T[::-1])]
    nodes, cells = np.arange(len(mesh.points)), np.arange(len(mesh.cells))
    with h5py.File(tmp_path / "state.h5") as file:
        for name in written.NODAL:
            np.testing.assert_array_equal(file[name], written.nodal_values(name, nodes, 3))
        np.testing.assert_array_equal(file["chi"], written.chi_values(cells))
        np.testing.assert_array_equal(file["plastic"], written.plastic_values(cells, file["plastic"].shape[1]))
        for keys in ("weakened", "broken"):
            np.testing.assert_array_equal(file[keys], weakened)
        np.testing.assert_array_equal(file["integrity"][:, 0], written.edge_integrity(weakened))
        np.testing.assert_array_equal(file["breaks"], written.edge_history(weakened))
