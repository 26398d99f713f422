"""Nodes that would lose their last whole cell keep one: which one, and when not."""

from __future__ import annotations

from typing import Any, cast

import numpy as np
import numpy.typing as npt
import pytest
from mpi4py import MPI

from fracsim.cli import _single_node_text
from fracsim.deformable_run import Run
from fracsim.fracture.criterion import OverloadedEdges
from fracsim.fracture.node_retention import RETENTION, CellRetention
from fracsim.mesh.edge_graph import EdgeGraph
from fracsim.scene import Scene, build_scene
from fracsim.study.check import check_study
from support.failing import Failing
from support.scenes import make_scene, make_study

Values = npt.NDArray[np.float64]
MATERIAL = {"young": 1.0, "poisson": 0.3, "density": 1.0}
MESH = {"builder": "box", "size": [1.0, 1.0], "h": 0.25, "pattern": "unstructured"}


@pytest.fixture(scope="module")
def scene() -> Scene:
    return make_scene(mesh=MESH)[0]


def inner_node(graph: EdgeGraph) -> int:
    """The node nearest to the middle: it is on no boundary."""
    return int(np.argmin(np.linalg.norm(graph.domain.nodes - 0.5, axis=1)))


def kept(scene: Scene, own: Values) -> tuple[EdgeGraph, int, npt.NDArray[np.int64]]:
    """All edges of a node fail, cells feel own (cells,) in all directions; which cells of it have no broken edge."""
    graph = EdgeGraph(scene.domain)
    node = inner_node(graph)
    failing = Failing(np.flatnonzero((graph.edge_nodes == node).any(axis=1)))
    stress = np.stack([own, own, 0 * own], axis=1)
    holding = CellRetention(cast(OverloadedEdges, failing), scene.balance.stress, graph)
    edges, _ = holding(stress, own)
    flags = np.zeros(len(graph.broken), bool)
    flags[edges] = True
    graph.break_edges(flags)
    around = np.flatnonzero((graph.cell_nodes == node).any(axis=1))
    return graph, node, around[graph.pattern[around] == 0]


def test_the_cell_that_is_loaded_least_stays(scene: Scene) -> None:
    """Exactly one, with both its edges at the node; all the others of the node are broken."""
    own = np.linspace(1.0, 2.0, scene.domain.cell_count)[::-1]
    graph, node, whole = kept(scene, own)
    around = np.flatnonzero((graph.cell_nodes == node).any(axis=1))
    assert whole.tolist() == [around[np.argmin(own[around])]]
    at = (graph.edge_nodes == node).any(axis=1)
    assert np.count_nonzero(at & ~graph.broken) == 2 and graph.pattern[whole[0]] == 0


def test_what_feels_too_much_itself_does_not_hold(scene: Scene) -> None:
    """Beyond the limit none is spared; where one cell is below it, that one, however many hold the node less."""
    count = scene.domain.cell_count
    assert not len(kept(scene, np.full(count, 1.01 * RETENTION.max_cell_load))[2])
    graph = EdgeGraph(scene.domain)
    one = np.flatnonzero((graph.cell_nodes == inner_node(graph)).any(axis=1))[2]
    assert kept(scene, np.where(np.arange(count) == one, 0.99, 1.01) * RETENTION.max_cell_load)[2].tolist() == [one]


def test_what_leaves_every_node_a_cell_is_not_touched(scene: Scene) -> None:
    """A straight cut between two rows of cells."""
    graph = EdgeGraph(scene.domain)
    ends = scene.domain.nodes[graph.edge_nodes, 0]
    crossing = np.flatnonzero((ends.min(axis=1) < 0.4) & (ends.max(axis=1) > 0.4))
    around = np.zeros(len(scene.domain.nodes), bool)
    flags = np.isin(graph.cell_edges, crossing).sum(axis=1) == 0
    around[graph.cell_nodes[flags]] = True
    crossing = crossing[around[graph.edge_nodes[crossing]].all(axis=1)]
    load = np.ones(scene.domain.cell_count)
    holding = CellRetention(cast(OverloadedEdges, Failing(crossing)), scene.balance.stress, graph)
    assert len(crossing) and np.array_equal(holding(np.stack([load] * 3, axis=1), load)[0], crossing)


def test_dust_is_counted_with_its_mass(tmp_path: Any) -> None:
    """A corner of the square cut off: one node, whose lumped mass is a third of its cells'."""
    tables = {"mesh": MESH, "fracture": {"strength": 1e9}, "output": {"picture": False, "surface": True}}
    run = Run(build_scene(MPI.COMM_SELF, make_study(**tables)), tmp_path)
    assert run.breaks.count_single_nodes(run.scene.domain.volumes) == (0, 0.0)
    domain = run.scene.domain
    corner = int(np.argmin(domain.nodes.sum(axis=1)))
    graph = run.scene.fracture.graph  # type: ignore[union-attr]
    graph.break_edges((graph.edge_nodes == corner).any(axis=1))
    run.record_breaks()
    wanted = domain.volumes[(graph.cell_nodes == corner).any(axis=1)].sum() / 3
    count, mass = run.breaks.count_single_nodes(domain.volumes)
    assert count == 1 and mass == pytest.approx(wanted, rel=1e-12)
    assert "1 of them dust (single nodes; [fracture] crumbs = false leaves none)" in _single_node_text({"dust": count})
    assert not _single_node_text({"dust": 0}) and not _single_node_text({})
    run.write_frame()
    rows = [line.split(",") for line in (tmp_path / "pieces.csv").read_text().splitlines()]
    assert rows[0][-1] == "dust" and sorted((row[2], row[-1]) for row in rows[1:])[0] == ("1", "1")


@pytest.mark.parametrize(("energy", "approach", "said"), [("corotated", "edge", True), ("linear", "edge", False)])
def test_check_says_where_nodes_come_off_all_the_same(energy: str, approach: str, said: bool) -> None:
    tables = {
        "material": MATERIAL | {"energy": energy},
        "fracture": {"strength": 1.0, "approach": approach, "crumbs": False},
    }
    assert any("crumbs = false" in line for line in check_study(make_study(mesh=MESH, **tables))) == said
