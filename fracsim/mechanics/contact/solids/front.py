"""The split surface of a body before solids: walls that come to light inside one are drawn in, or left out (crowd)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from ....errors import InputError
from ....mesh.split.skeleton import Skeleton
from ..crowd import Law, Surface
from .facing import Facings, Standing
from .inside import depth

Values = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]


class Front(Surface):
    """The surface, and its pairs with solids where these are. Walls of cracks do not recede from each other: they feel
    solids alone."""

    gap = 0.0
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
        self._solids = solids
        super().__init__(skeleton, pattern, law, u, before)

    def _check_apart(self) -> None:
        """InputError where a solid cuts the body at rest, or one is in the other."""
        made = self.made
        for each in self.pairs.each:
            solid, cut = each.solid, len(each.cut(made.points)) > 0
            deep = depth((made.points, made.elements), (solid.here, solid.triangles), cut=cut)
            if cut or deep is not None:
                how = "cuts" if deep is None else "overlaps"
                by = "" if deep is None else f", by {deep:.4g} m"
                raise InputError(f"{solid.name} {how} the body at the start{by}; move it away or make it smaller")

    def _pairs_of(self, elements: Ints) -> Facings:  # type: ignore[override]
        how = {name: self._how[name] for name in ("distance", "stiffness")}  # friction is each solid's own
        return Facings(self._rest, elements, self._solids, **how)
