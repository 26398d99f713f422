"""The split surface of a body before solids: walls that come to light inside one are drawn in, or left out (crowd)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from ....errors import InputError
from ....mesh.split.build import Split
from ....mesh.split.skeleton import Skeleton
from ..crowd import NEAR_END, Law, Surface
from ..near import longest
from .facing import Facings, Standing
from .inside import depth

Values = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]


class Front(Surface):
    """The surface, and its pairs with solids where these are. Walls of cracks do not recede from each other: they feel
    solids alone."""

    pairs: Facings  # type: ignore[assignment]

    def __init__(
        self,
        skeleton: Skeleton,
        pattern: npt.NDArray[np.uint8],
        solids: Sequence[Standing],
        law: Law,
        u: Values,
        before: Surface | None,
    ) -> None:
        """As for Surface. InputError where a solid overlaps the body at rest."""
        self._solids, self._acts = solids, {"distance": law.distance, "stiffness": law.stiffness}
        self._checked = before is not None
        super().__init__(skeleton, pattern, Law(0.0, law.stiffness, 0.0, law.creep), u, before)

    def _all_pairs(self) -> Facings:  # type: ignore[override]
        pairs = Facings(self._rest, self.made.elements, self._solids, **self._acts)
        if not self._checked:
            _check_apart(pairs, self.made)
            self._checked = True
        return pairs

    def _leave_out(self, elements: Ints) -> None:
        if len(elements):
            kept = np.delete(self.made.elements, elements, axis=0)
            self.pairs = Facings(self._rest, kept, self._solids, **self._acts)
        self._out = elements

    def _settle(self, u: Values, load: Values) -> None:
        super()._settle(u, load)
        while len(cut := self.pairs.overlaps(self.at(u))[:, 0]):  # a side that cuts is told of one of its two elements
            kept = np.delete(np.arange(len(self.made.elements)), self._out)
            self._leave_out(np.union1d(self._out, kept[cut]))

    def is_near(self, x: Values, other: Values | None, *, again: bool) -> bool:
        """As for Surface."""
        return other is not None and longest(x - other) < NEAR_END[again] * self._acts["distance"]


def _check_apart(pairs: Facings, made: Split) -> None:
    """InputError where a solid cuts the body at rest, or one is in the other."""
    for each in pairs.each:
        solid, cut = each.solid, len(each.cut(made.points)) > 0
        deep = depth((made.points, made.elements), (solid.here, solid.triangles), cut=cut)
        if cut or deep is not None:
            how = "cuts the body at the start" if deep is None else f"overlaps the body at the start, by {deep:.4g} m"
            raise InputError(f"{solid.name} {how}; move it away or make it smaller")
