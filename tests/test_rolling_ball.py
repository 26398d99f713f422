"""A free ball with friction on a block: equal on any number of ranks."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from fracsim.contact.rigid_body import RigidSystem
from support.ranks import run_on_ranks
from support.rolling import COLUMNS
from support.scenes import make_scene

Values = npt.NDArray[np.float64]


@pytest.mark.ranks
@pytest.mark.parametrize("ranks", (2, 3))
def test_a_ball_begins_to_roll_alike_on_any_number_of_ranks(ranks: int, tmp_path: Path) -> None:
    """Facets of several ranks share the points at which the ball rubs. On three ranks the velocity was off by 1e-4 of
    itself: friction took the mean direction of a rank's own facets."""
    alone, together = (run_on_ranks("support.rolling", count, tmp_path, 60)["rows"] for count in (1, ranks))
    assert alone[-1, COLUMNS.index("spin_ball_y")] > 1.0
    scale = np.abs(alone).max(axis=0)
    np.testing.assert_allclose(together / scale, alone / scale, atol=1e-8)


def test_a_ball_that_begins_to_roll_takes_few_iterations() -> None:
    """Points that slip come to stick, and slip again: 12 iterations in a step with exact tangents of friction alone,
    where the line search took steps of a hundredth."""
    from mpi4py import MPI

    from fracsim.scene import build_scene
    from fracsim.studies.cross_file_calls import BALL
    from fracsim.study.reader import validate

    scene = build_scene(MPI.COMM_SELF, validate(BALL, "ball"))
    state, iterations = scene.start(), []
    for _ in range(12):
        state, report = scene.stepper.advance(state)
        iterations.append(report.solve.newton_iterations)
    scene.destroy()
    assert max(iterations) <= 8 and sum(iterations) <= 60  # 6 and 53


def test_a_ball_far_from_the_origin_falls_alike(monkeypatch: pytest.MonkeyPatch) -> None:
    """At 1 km positions are rounded by 1e-13 m, and the energy of contact by that times its forces. Without that error
    the line search of the ball's pose refused solutions, for 1,300 evaluations at a time."""
    count, evaluate = [0], RigidSystem.system

    def counted(self: RigidSystem, *arguments: Any, exact: bool) -> tuple[Values, Values]:
        count[0] += 1
        assert count[0] < 300
        return evaluate(self, *arguments, exact=exact)

    monkeypatch.setattr(RigidSystem, "system", counted)
    lost = []
    for far in (0.0, 1000.0):
        count[0] = 0
        state = make_scene(
            mesh={"builder": "box", "size": [0.4, 0.2, 0.1], "h": 0.05, "origin": [far] * 3},
            material={"energy": "neo-hookean", "young": 1e5, "poisson": 0.3, "density": 1e3},
            obstacle=[{"name": "ball", "shape": "sphere", "radius": 0.06, "at": [far + 0.2, far + 0.1, far + 0.165],
                       "velocity": [0.1, 0.0, -1.0], "mass": 0.5, "friction": 0.3}],
            boundary=[{"on": "left", "fix": "xyz"}, {"on": "right", "fix": "xyz"}],
            time={"scheme": "newmark", "step": 0.002, "end": 0.1}, solver={},
        )[1]  # fmt: skip
        for _ in range(12):
            state.advance()
        lost.append(state.state.dissipated)
    assert lost[0] > 1e-3 and lost[1] == pytest.approx(lost[0], rel=1e-6)
