"""Products with blocks where DOLFINx has summed them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from fracsim.mechanics.inertia import MassBlocks
from fracsim.mechanics.matrix_assembly import TangentAssembler
from support.ranks import run_on_ranks
from test_dead_cells import damaged


@pytest.mark.parametrize("dim", (2, 3))
def test_products_are_those_of_the_dense_matrix(dim: int) -> None:
    """Of a body that is deformed at random, a third of whose cells are dead, which DOLFINx writes out."""
    balance = damaged("damped", dim)[0].balance
    balance.damage_changed()
    assembly = TangentAssembler(balance.tangent.form)
    products = assembly.switch_to_blocks()
    assert products is not None and assembly.switch_to_blocks() is products
    mass = np.linspace(1.0, 2.0, balance.owned_dof_count) * 1e4
    assembly([], None, MassBlocks(assembly.diagonal_blocks, mass.reshape(-1, dim)))
    x, y = assembly.matrix.createVecs()
    x.setRandom()
    products.mult(x, y)
    dense = assembly._sum.to_dense()
    np.testing.assert_allclose(y.array_r, dense @ x.array_r, rtol=0, atol=1e-14 * np.abs(dense).sum(1).max())


def test_without_a_compiler_single_entries_stay(monkeypatch: pytest.MonkeyPatch) -> None:
    """What is there serves on."""
    assembly = TangentAssembler(damaged("damped", 3)[0].balance.tangent.form)
    matrix = assembly.matrix
    monkeypatch.setenv("CC", "no-such-compiler")
    assert assembly.switch_to_blocks() is assembly.blocks is None
    assembly([])
    assert assembly.matrix is matrix and matrix.norm() > 0


@pytest.mark.fast_solver_only("plain matrices have single entries")
@pytest.mark.parametrize("ranks", [1, *(pytest.param(count, marks=pytest.mark.ranks) for count in (2, 3))])
def test_contact_beside_blocks_is_that_of_single_entries(ranks: int, tmp_path: Path) -> None:
    """A block between a driven ball with friction and a free one: products, rows and diagonals, and the same motion.

    Entries stay those of their last update where blocks alone are assembled."""
    found = run_on_ranks("support.coupled", ranks, tmp_path)
    assert found["coupled"] >= 3
    assert max(found["product"], found["rows"], found["diagonal"]) < 1e-12
    assert found["displacement"] < 1e-6 and found["entries"] < 1e-12
