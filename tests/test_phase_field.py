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
    points, cells = phase_field.slit(mesh.points, np.asarray(mesh.cells, np.int64))
    assert len(points) == len(mesh.points) + n // 2
    assert len(boundary_facets(cells)) == len(boundary_facets(mesh.cells)) + n
    np.testing.assert_array_equal(points[cells], mesh.points[mesh.cells])
    assert signed_measures(points, cells).sum() == pytest.approx(1.0)


def test_the_page_says_where_it_is_not_installed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv(phase_field.VARIABLE, raising=False)
    phase_field.interpreter.cache_clear()
    assert phase_field.trials() == []
    (section,) = phase_field.sections([])
    assert "not installed" in section.text and phase_field.VARIABLE in section.text


def test_the_table_has_both_programs() -> None:
    figures = {name: {"peak": 645.0, "at": 5e-6, "seconds": 1.0, "solves": 9.0} for name in ("ours", "theirs")}
    record = {"case": "notched-plate", "figures": figures | {"cells": 8}, "message": ""}
    (section,) = phase_field.sections([record])
    (table,) = section.tables
    assert [row[:3] for row in table.rows] == [(8, "PhaseFieldX", 645.0), (8, "fracsim", 645.0)]
    assert all(len(row) == len(phase_field.COLUMNS) for row in table.rows)
