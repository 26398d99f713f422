"""PhaseFieldX beside us: the problems that it gets are those of our studies, and what the page says without it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from fracsim.meshes import BUILDERS
from fracsim.meshes.topology import boundary_facets, signed_measures
from fracsim.studies.evidence import precision
from fracsim.studies.evidence.fracture_specimens import PLATE_COURSES, PLATE_SIDE, V_BEAM_COURSE
from fracsim.studies.evidence.peers import phase_field


def test_a_slit_parts_the_nodes_of_half_a_row() -> None:
    """From the left side to the middle, where it ends in one node: so much more of a boundary, as much area, and every
    triangle where it was."""
    n = 8
    mesh = BUILDERS["box"](size=(1.0, 1.0), h=1 / n).build()
    points, cells = phase_field.double_slit_nodes(mesh.points, np.asarray(mesh.cells, np.int64))
    assert len(points) == len(mesh.points) + n // 2
    assert len(boundary_facets(cells)) == len(boundary_facets(mesh.cells)) + n
    np.testing.assert_array_equal(points[cells], mesh.points[mesh.cells])
    assert signed_measures(points, cells).sum() == pytest.approx(1.0)


def test_the_page_says_where_it_is_not_installed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv(phase_field.VARIABLE, raising=False)
    phase_field.phasefieldx_python.cache_clear()
    assert phase_field.trials("notched-tension", "tension", 644.9, {1e-4: False}) == []
    record = {"case": "bounce", "name": "a", "settings": {"scheme": "newmark", "dt": 0.1}, "ranks": 1, "wall": [1.0],
              "cpu": [], "outcome": "done", "figures": {"height of the return": 0.1, "seconds": 1.0}}  # fmt: skip
    assert phase_field.VARIABLE in precision.sections([record])[0].text


def test_the_direction_of_a_crack() -> None:
    """Of points along a line at 60 degrees below straight ahead, and of none behind the notch or near it."""
    along = np.linspace(0, 0.5e-3, 60)[:, None] * [0.5, -np.sqrt(3) / 2]
    behind = np.linspace(-0.5e-3, 0, 60)[:, None] * [1.0, 0.0]
    assert phase_field.crack_direction(np.concatenate([along, behind])) == pytest.approx(60.0)
    assert np.isnan(phase_field.crack_direction(behind))


@pytest.mark.parametrize("load", PLATE_COURSES)
def test_plates_are_held_and_moved_as_in_our_studies(load: str) -> None:
    """Both ends of the grip's course, and every node of bottom and top; sides keep their height in one case alone."""
    problem = phase_field.plate_problem(load, PLATE_SIDE / 8)
    (x, _), course = PLATE_COURSES[load]
    assert problem.axis == (0 if x else 1) and problem.split == bool(x)
    assert problem.course[[0, -1]] == pytest.approx([course.start * course.travel, course.travel])
    at = problem.points[:, 1]
    assert problem.driven.sum() == 9 and (at[problem.driven] == PLATE_SIDE).all()
    assert problem.fixed[at == 0].all() and problem.fixed[problem.driven, 1 - problem.axis].all()
    inside = (at > 0) & (at < PLATE_SIDE)
    # seven nodes of a side, one of them doubled by the slit
    assert problem.fixed[inside].sum() == (15 if load == "held-shear" else 0)


def test_the_beam_is_held_and_moved_as_in_our_study(tmp_path: Path) -> None:
    problem = phase_field.beam_problem(2e-4, tmp_path)
    held = problem.points[problem.fixed.any(axis=1)]
    np.testing.assert_allclose(held[np.argsort(held[:, 0])], [[-4e-3, 0.0], [4e-3, 0.0]], atol=1e-12)
    assert problem.fixed.sum() == 3
    np.testing.assert_allclose(problem.points[problem.driven, 1], 2e-3)
    assert problem.course[-1] == pytest.approx(-V_BEAM_COURSE.travel)
    # no damage where single nodes carry the load, and none prevented at the notch
    assert problem.intact[problem.driven].all() and problem.intact[problem.fixed.any(axis=1)].all()
    notch = np.linalg.norm(problem.points - [0.0, 0.4e-3], axis=1) < 4e-4
    assert notch.sum() > 5 and not problem.intact[notch].any()
