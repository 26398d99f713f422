"""Elastic zone around the crack tips of a body that yields (docs/theory.md#elastic-zone)."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from ...mechanics.plasticity import PlasticHistory
from ...mesh.edge_graph import EdgeGraph
from ...mesh.parallel import concatenate_over_ranks
from .tip_criterion import TipCriterion


class ElasticZone:
    """Cells that do not flow: those around crack tips, and those that cracks have cut.

    The zone of a tip has the radius D = max(L / 2, R), L = E' G_c / (pi f_t^2) the critical distance and R the radius
    of the disc over which the force on the tip is summed. At D ahead of a tip with G = G_c the elastic stress is f_t.
    The force on a tip is that of an elastic body, and the plastic work around the zone is the body's.
    Source: Suo, Shih and Varias (1993).
    """

    def __init__(self, tips: TipCriterion, graph: EdgeGraph, plastic: PlasticHistory) -> None:
        """Build the zone of the present tips (collective)."""
        self._tips, self._graph, self._plastic = tips, graph, plastic
        self._centres = cKDTree(tips.field_evaluator.centres)
        self.update()

    def update(self) -> None:
        """Move the zone to the present tips (collective)."""
        tips, dim = self._tips.find_tips(), self._graph.domain.dim
        radius = self._tips.elastic_radius[tips.cell]
        rows = concatenate_over_ranks(self._graph.domain.comm, np.column_stack([tips.point, radius]))
        elastic = self._graph.split.copy()
        for cells in self._centres.query_ball_point(rows[:, :dim], rows[:, dim]):
            elastic[cells] = True
        self._plastic.set_elastic(elastic)
