"""A criterion by which given edges fail: a stand-in for OverloadedEdges."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

Values = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]


class Failing:
    """Edges that fail, whatever the stress; of strength 1."""

    def __init__(self, edges: Ints) -> None:
        self.edges = edges

    def strength(self, cells: Ints, edges: Ints) -> Values:
        return np.ones(edges.shape)

    def __call__(self, stress: Values, psi: Values) -> tuple[Ints, Values]:
        return self.edges, np.full(len(self.edges), 1.5)
