"""The figures of cracks follow the edges that break: as when all cells are looked at."""

from __future__ import annotations

import numpy as np
import pytest

from fracsim.fracture.record import EdgeRecord
from fracsim.output.crack_front import CrackFront
from support.scenes import make_scene


@pytest.mark.parametrize("dim", (2, 3))
def test_what_changes_is_enough(dim: int) -> None:
    """Edges break a few at a time, anywhere. The size is that of a front that has just been made, and the tip in a cell
    that holds together whose first broken edge went last, found cell by cell."""
    scene, _ = make_scene(mesh={"builder": "box", "size": [1] * dim, "h": 0.25}, fracture={"strength": 1.0})
    graph, record = scene.fracture.graph, EdgeRecord(scene.fracture.graph)
    front, found, sizes = CrackFront(record), 0, []
    order = np.random.default_rng(2).permutation(len(graph.broken))
    for t, edges in enumerate(np.array_split(order, 40)):
        graph.break_edges(np.isin(np.arange(len(order)), edges))
        record.note(float(t))
        front.look()
        sizes.append(front()[0])
        np.testing.assert_allclose(front()[0], CrackFront(record)()[0], rtol=1e-12)
        entries = [
            cell[graph.broken[cell]][0]
            for cell, split in zip(graph.cell_edges, graph.split, strict=True)
            if graph.broken[cell].any() and not split
        ]
        if entries:
            found += 1
            last = [edge for edge in entries if record.at[edge] == record.at[entries].max()]
            middles = graph.domain.nodes[graph.edge_nodes[last]].mean(axis=1)
            assert np.abs(middles - front()[1:]).sum(axis=1).min() < 1e-12
    assert found > 10 and max(sizes) > 0
