"""Integrity of edges is a number in [0, 1] that never rises: of laws that soften, over ranks, and in checkpoints."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from mpi4py import MPI

from fracsim.deformable_run import Run
from fracsim.fracture.fracture_pass import BrittleEdgeLaw, FracturePass
from fracsim.scene import build_scene
from support.ranks import OnRanks
from support.scenes import Values, make_scene, make_study, march


class Softening:
    """1 at the strength, falling linearly to 0 at twice the strength."""

    all_or_nothing = False

    def __call__(self, load: Values) -> Values:
        """(n,) integrity."""
        return np.clip(2 - load, 0.0, 1.0)


PULL = {
    "mesh": {"builder": "box", "size": [1.0, 0.5], "h": 0.25},
    "boundary": [
        {"on": "left", "fix": "xy"},
        {"on": "right", "displacement": {"time": [0.0, 1.0], "value": [[0.0, "free"], [1.0, "free"]]}},
    ],
    "fracture": {"strength": 0.05, "tie_break": 0.0, "passes": 1},
    "time": {"scheme": "quasi-static", "step": 0.0125, "end": 0.2},
}


def test_brittle_is_all_or_nothing() -> None:
    """Whole below the strength, gone at it."""
    np.testing.assert_array_equal(BrittleEdgeLaw()(np.array([0.0, 0.999, 1.0, 7.0])), [1, 1, 0, 0])


def test_a_law_that_softens_weakens_cells_by_degrees() -> None:
    """A bar at s / strength = 1.25: edges along the load keep 3/4 of themselves and none is broken; chi of a triangle
    is (3/4 + 1/2) / (1 + 1/2) = 5/6, as the diagonals carry half of the stress along the load (test_fracture)."""
    scene, state = make_scene(**PULL)
    part = scene.fracture
    scene.stepper.inelastic.fracture = FracturePass(part.stress, part.graph, part.criterion, Softening(), max_passes=1)
    march(scene, state, 5)
    graph = part.graph
    aligned = np.ptp(scene.domain.nodes[graph.edge_nodes][:, :, 1], axis=1) < 1e-9
    np.testing.assert_allclose(graph.integrity[aligned], 0.75, atol=1e-9)
    assert np.all(graph.integrity[~aligned] == 1) and not graph.broken.any()
    np.testing.assert_allclose(scene.balance.stress.chi.x.array, 5 / 6, atol=1e-9)
    march(scene, state, 8)
    assert graph.broken[aligned].all() and np.all(graph.integrity[aligned] == 0)


@pytest.mark.ranks
@pytest.mark.parametrize("ranks", (2, 3))
def test_the_least_of_all_ranks_counts(on_ranks: OnRanks, ranks: int) -> None:
    """What an edge keeps is the least that any cell says, on whichever rank it is."""
    alone, found = (on_ranks(count)[0] for count in (1, ranks))
    integrity = found["weakened-integrity"]
    np.testing.assert_array_equal(integrity, alone["weakened-integrity"])
    assert found["weakened-count"] == alone["weakened-count"] > 0 and len(np.unique(integrity[:, 2])) == 4


def test_a_checkpoint_holds_the_numbers(tmp_path: Path) -> None:
    """Integrities between 0 and 1 are those of the run that goes on."""
    tables = PULL | {"output": {"picture": False}}
    going = Run(build_scene(MPI.COMM_SELF, make_study(**tables)), tmp_path)
    graph = going.scene.fracture.graph
    graph.weaken(np.random.default_rng(3).choice([0.0, 0.25, 0.5, 1.0], len(graph.integrity)))
    going.scene.fracture.damage_restored()
    going.state = going.scene.stepper.inelastic.with_snapshot(going.state)
    going.checkpoint()
    again = Run(build_scene(MPI.COMM_SELF, make_study(**tables)), tmp_path, restart=True)
    np.testing.assert_array_equal(again.scene.fracture.graph.integrity, graph.integrity)
    np.testing.assert_array_equal(again.scene.fracture.graph.pattern, graph.pattern)
    assert again.state.history["damage"].integrity.min() == 0
