"""Quadratic displacement: [mesh] order = 2."""

from __future__ import annotations

import numpy as np
import pytest

from support.manufactured import errors, solved


def orders(energy: str, order: int, dim: int, cells: tuple[int, int], monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """Of the displacement and of its gradient, between two meshes."""
    coarse, fine = (errors(solved(energy, order, dim, n, monkeypatch)) for n in cells)
    found: list[float] = (np.log(coarse / fine) / np.log(cells[1] / cells[0])).tolist()
    return found


@pytest.mark.parametrize("energy", ["linear", "corotated", "stvk", "neo-hookean"])
def test_orders_of_convergence(energy: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """3 in the displacement and 2 in its gradient, and so in the energy norm; one less of each with linear cells."""
    assert orders(energy, 2, 2, (6, 12), monkeypatch) == pytest.approx([3, 2], abs=0.2)
    assert orders(energy, 1, 2, (6, 12), monkeypatch) == pytest.approx([2, 1], abs=0.2)


def test_orders_of_convergence_in_space(monkeypatch: pytest.MonkeyPatch) -> None:
    assert orders("neo-hookean", 2, 3, (3, 6), monkeypatch) == pytest.approx([3, 2], abs=0.2)
