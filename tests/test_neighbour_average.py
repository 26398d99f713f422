"""The average over neighbouring cells against a sum written out cell by cell, and the study that asks for it."""

from __future__ import annotations

from collections import Counter

import numpy as np
import pytest
from mpi4py import MPI

from fracsim.fracture.nonlocal_average import NeighbourAverage
from fracsim.mesh.domain import distribute
from support.scenes import make_scene
from support.solids import copies, lattice


@pytest.mark.parametrize("numbers", [(3, 4), (2, 2, 3)])
def test_each_neighbour_counts_with_its_volume_for_every_node_it_shares(numbers: tuple[int, ...]) -> None:
    """Cells of different volumes, some of which enter no average."""
    mesh = lattice(*numbers)
    mesh.points[:] += 0.2 * np.random.default_rng(0).random(mesh.points.shape)
    domain = distribute(MPI.COMM_SELF, mesh)
    rng = np.random.default_rng(1)
    values, active = rng.normal(size=(domain.cell_count, 3)), rng.random(domain.cell_count) < 0.7
    around: dict[int, list[int]] = {}
    for cell, nodes in enumerate(domain.cell_nodes.tolist()):
        for node in nodes:
            around.setdefault(node, []).append(cell)
    expected = np.zeros_like(values)
    for cell, nodes in enumerate(domain.cell_nodes.tolist()):
        shared = Counter(other for node in nodes for other in around[node] if active[other])
        weight = {other: times * domain.volumes[other] for other, times in shared.items()}
        if weight:
            expected[cell] = sum(w * values[other] for other, w in weight.items()) / sum(weight.values())
    average = NeighbourAverage(domain)
    assert np.allclose(average(values, active), expected, atol=1e-13)
    bound = 0.5 * float(np.linalg.norm(expected, axis=1).max())
    cells, found = average.find_averages_above(values, np.linalg.norm(values, axis=1), bound, active)
    assert np.allclose(found, expected[cells], atol=1e-13)
    assert set(np.flatnonzero(np.linalg.norm(expected, axis=1) >= bound)) <= set(cells.tolist())
    some = np.flatnonzero(rng.random(domain.cell_count) < 0.6)
    active &= np.isin(np.arange(domain.cell_count), some)
    cells, found = average.find_averages_above_in(some, values, np.linalg.norm(values, axis=1), bound, active)
    whole = average.find_averages_above(values, np.linalg.norm(values, axis=1), bound, active)
    assert np.array_equal(cells, np.intersect1d(whole[0], some)) and len(cells)
    assert np.allclose(found, average(values, active)[cells], atol=1e-13)


def test_bodies_side_by_side_do_not_know_of_one_another() -> None:
    """Two bodies in one place: each keeps its own constant."""
    domain = distribute(MPI.COMM_SELF, copies(lattice(2, 2), 2))
    which = (domain.input_numbering.cells >= domain.cell_count // 2).astype(float)[:, None]
    assert np.allclose(NeighbourAverage(domain)(which), which, atol=1e-15)


def test_a_study_may_ask_for_it_without_a_radius() -> None:
    """The criterion has this average; with a radius beside it the study is refused."""
    scene, _ = make_scene(fracture={"strength": 1.0, "kernel": "neighbours"})
    assert isinstance(scene.fracture.criterion._carried._average, NeighbourAverage)  # type: ignore[union-attr, attr-defined]
    with pytest.raises(ValueError, match="remove radius"):
        make_scene(fracture={"strength": 1.0, "kernel": "neighbours", "radius": 0.1})
