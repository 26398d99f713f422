"""Cracks with a fracture energy in bodies that yield: the elastic zone around tips, and the toughness that follows."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from fracsim.scene import Scene
from fracsim.study.check import check_study
from support.scenes import Walk, each_step, make_scene, make_study
from support.tearing import RUNS
from support.tips import criterion_of, tips


def torn(**tables: Any) -> tuple[Scene, Walk]:
    """The plate at its end, pulled open at one side."""
    scene, state = make_scene(**RUNS["yielding"] | tables)
    for _ in each_step(scene, state):
        pass
    return scene, state


def test_a_high_yield_stress_is_elastic() -> None:
    """With a yield stress far above all stress the crack is that of a body without [plasticity]."""
    elastic = {name: table for name, table in RUNS["yielding"].items() if name != "plasticity"}
    scene, state = make_scene(**elastic)
    for _ in each_step(scene, state):
        pass
    high, end = torn(plasticity={"yield_stress": 1e5, "update": "implicit"})
    assert scene.fracture.graph.broken.sum() > 20
    np.testing.assert_array_equal(high.fracture.graph.broken, scene.fracture.graph.broken)
    np.testing.assert_allclose(end.u, state.u, atol=1e-8 * np.abs(state.u).max())


@pytest.mark.parametrize("update", ("implicit", "extrapolated", "staggered"))
def test_nothing_flows_around_a_tip(update: str) -> None:
    """Cells within D of a tip keep their plastic strain, and others flow."""
    tables = RUNS["yielding"] | {"plasticity": RUNS["yielding"]["plasticity"] | {"update": update}}
    scene, state = make_scene(**tables)
    centres, plastic = criterion_of(scene).field_evaluator.centres, scene.balance.stress.material.plastic
    flowed = 0
    for _ in range(8):
        point, before = tips(scene)[0], plastic.accumulated_strain.copy()
        radius = criterion_of(scene).elastic_radius[criterion_of(scene).find_tips().cell[0]]
        state.advance()
        near = np.linalg.norm(centres - point, axis=1) < 0.999 * radius
        moved = np.linalg.norm(tips(scene)[0] - point)
        if not moved:
            np.testing.assert_array_equal(plastic.accumulated_strain[near], before[near])
        flowed += np.count_nonzero(plastic.accumulated_strain[~near] > before[~near])
    assert flowed > 50 and scene.fracture.graph.split.sum() > 8


def test_the_body_takes_more_than_its_cracks() -> None:
    """The crack of a body that yields is shorter than that of an elastic one under the same displacement."""
    scene, state = torn()
    elastic, _ = torn(plasticity={"yield_stress": 1e5, "update": "implicit"})
    assert tips(scene)[:, 0].max() < tips(elastic)[:, 0].max() - 0.05
    assert state.dissipated > 0


def test_work_is_stored_or_dissipated() -> None:
    """To 0.2 % of the work in 50 steps: also where cells leave the zone beyond their yield stress."""
    scene, state = make_scene(**RUNS["yielding"] | {"time": {"scheme": "quasi-static", "step": 0.1, "end": 5.0}})
    elastic = [report.elastic for report in each_step(scene, state)][-1]
    assert abs(state.work - elastic - state.dissipated) < 2e-3 * state.work
    assert scene.fracture.graph.split.sum() > 20


def test_check_says_how_large_the_zone_is() -> None:
    """max(L / 2, 5 h), and a note where cells do not resolve L / 2."""
    lines = list(check_study(make_study(**RUNS["yielding"])))
    assert any("the body stays elastic within 0.312 m of a crack tip" in line for line in lines)
    assert any("note: that is 5 h, since L / 2 is less" in line for line in lines)
