"""Tips in space that wait: what bounds their G, and that cracks are those of looking at every pass."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from mpi4py import MPI

from fracsim.fracture.energy.release_rate_bound import Waiting
from fracsim.fracture.energy.tip_criterion import CrackTips
from fracsim.scene import Scene, build_scene
from support.scenes import make_study
from support.tips import criterion_of, seen

YOUNG, POISSON, N = 1e4, 0.3, 8
SHEAR = float(np.sqrt(YOUNG / 2 / (1 + POISSON)))


def strip(ratio: float, end: float, order: int = 1) -> Scene:
    """Of 2 x 0.25 x 1 m, its lower edge held, its upper one pulled until it stores `ratio` G_c ahead of a crack."""
    constrained = YOUNG * (1 - POISSON) / ((1 + POISSON) * (1 - 2 * POISSON))
    s, top = np.linspace(0, 1, 30), np.sqrt(2 * ratio / constrained)
    ramp = {"time": (6 / SHEAR * s).tolist(), "value": [[0, 0, x] for x in top * s**3 * (10 - 15 * s + 6 * s**2)]}
    return build_scene(MPI.COMM_SELF, make_study(
        mesh={"builder": "box", "size": [2.0, 0.25, 1.0], "h": 1 / N, "pattern": "unstructured", "order": order},
        solver={},
        crack=[{"polygon": [[-1, -1, 0.52], [1, -1, 0.52], [1, 2, 0.52], [-1, 2, 0.52]]}],
        material={"energy": "linear", "young": YOUNG, "poisson": POISSON, "density": 1.0},
        fracture={"strength": 1e9, "energy": 1.0},
        boundary=[*({"on": side, "fix": "y"} for side in ("front", "back")), {"on": "bottom", "fix": "xyz"},
                  {"on": "top", "displacement": ramp}], damping={"mass": 4 * SHEAR},
        time={"scheme": "explicit", "step": 0.2 / N / SHEAR, "end": end / SHEAR},
    ))  # fmt: skip


@pytest.mark.parametrize("order", (1, 2))
def test_no_motion_gives_more_than_the_bound(order: int) -> None:
    """A look in any motion, and another after any other: the force has not changed by more than the bound, which is
    none too large where the body goes on as it did; where what is cut has let go there is none."""
    scene, rng = strip(1.0, 1.0, order), np.random.default_rng(5)
    criterion, stress, size = criterion_of(scene), scene.balance.stress, scene.balance.owned_dof_count
    x = scene.domain.nodes[: size // 3]
    opening = np.sign(x[:, 2] - 0.52) * np.sqrt(np.maximum(1.05 - x[:, 0], 0.0))
    shape = np.column_stack([0 * opening, 0 * opening, opening]).ravel()
    motion = [1e-2 * shape, 0.3 * shape, 20.0 * np.sin(3 * np.arange(size))]
    waiting, close = Waiting(criterion.sight, stress), []

    def moved(u: Any, v: Any, a: Any, now: float) -> Any:
        stress.u.x.array[:] = u
        criterion.moving(v, a, now, 1.0)
        look = seen(scene)
        return look.around.forces(look.sigma, look.inertia)

    for steady in (True, False):
        for _ in range(15):
            u, v, a = (each * rng.uniform(0.5, 1) for each in motion)
            force, time = moved(u, v, a, 1.0), 10.0 ** rng.uniform(-5, -1)
            waiting._rests = 0
            waiting.looked(np.zeros(len(force)), 1.0)
            assert not np.any(waiting.most(1.0))
            aside = time * 10.0 ** rng.uniform(-2, 1) * (not steady) * rng.standard_normal((3, size))
            change = moved(u + time * v + 1e-2 * aside[0], v + aside[1], a + 100 * aside[2], 1.0 + time) - force
            change, most = criterion.sight.around.along.most(np.linalg.norm(change, axis=1)), waiting.most(1.0 + time)
            assert most is not None and (change <= most).all() and change.max() > 0
            if steady:
                close.append((most / change).min())
    assert np.median(close) < 15
    split = np.flatnonzero(scene.fracture.graph.split)
    assert stress.chi is not None
    stress.chi.x.array[split[np.isin(split, criterion.sight.around.asked.own)][0]] = 0.5
    assert waiting.most(1.0) is None


def test_cracks_are_those_of_looking_at_every_pass(monkeypatch: pytest.MonkeyPatch) -> None:
    """A crack that waits and runs: edges, cuts and motion to the last bit. It is looked at in less than two thirds of
    the passes, and one that is pulled with half of what tears it in less than a third."""
    grown, looks = CrackTips._grown, []

    def counted(*given: Any) -> Any:
        looks[-1] += 1
        return grown(*given)

    def run(ratio: float) -> tuple[Any, ...]:
        scene, broken = strip(ratio, 8.0), []
        state = scene.start()
        looks.append(0)
        while not scene.ended(state):
            state, report = scene.stepper.advance(state)
            broken.append(report.broken)
        return broken, criterion_of(scene).cut.copy(), state.u

    monkeypatch.setattr(CrackTips, "_grown", counted)
    found = run(1.6)
    waiting = run(0.25)
    monkeypatch.setattr(Waiting, "holds", lambda *given: False)
    expected = run(1.6)
    for one, other in zip(found, expected, strict=True):
        np.testing.assert_array_equal(one, other)
    assert sum(found[0]) > 50 and not sum(waiting[0])
    assert looks[0] < 2 / 3 * looks[2] and looks[1] < looks[2] / 3
