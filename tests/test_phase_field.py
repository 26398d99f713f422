"""PhaseFieldX beside us: the slit that it gets, and what the page says where it is not installed."""

from __future__ import annotations

import numpy as np
import pytest

from fracsim.meshes import BUILDERS
from fracsim.meshes.topology import boundary_facets, signed_measures
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
    assert phase_field.trials() == []
    (section,) = phase_field.sections([])
    assert "not installed" in section.text and phase_field.VARIABLE in section.text


def test_the_table_has_both_programs() -> None:
    one = {"peak": 645.0, "at": 5e-6, "turn": 0.0, "seconds": 1.0, "solves": 9.0}
    figures = {"ours": one, "theirs": one, "cells": 8, "pull": "tension"}
    record = {"case": "notched-plate", "figures": figures, "message": ""}
    (section,) = phase_field.sections([record])
    (table,) = section.tables
    assert [row[1:4] for row in table.rows] == [(8, "PhaseFieldX", 645.0), (8, "fracsim", 645.0)]
    assert all(len(row) == len(phase_field.COLUMNS) for row in table.rows)


def test_the_direction_of_a_crack() -> None:
    """Of points along a line at 60 degrees below straight ahead, and of none behind the notch or near it."""
    along = np.linspace(0, 0.5e-3, 60)[:, None] * [0.5, -np.sqrt(3) / 2]
    behind = np.linspace(-0.5e-3, 0, 60)[:, None] * [1.0, 0.0]
    assert phase_field.crack_direction(np.concatenate([along, behind])) == pytest.approx(60.0)
    assert np.isnan(phase_field.crack_direction(behind))


def test_the_plate_is_pulled_as_it_is_said() -> None:
    """The last place of the grip's course is where the study moves it."""
    for name, pull in phase_field.GRIP_MOTIONS.items():
        moved = phase_field.plate_study(8, pull)["boundary"][1]["displacement"]["value"][1]
        assert moved[{"tension": 1, "shear": 0}[name]] == pytest.approx(pull.course[-1])
        assert np.count_nonzero(moved) == 1
