"""A loaf of bread: a block with a flat bottom, round edges and a domed top."""

from __future__ import annotations

from dataclasses import dataclass
from math import pi
from typing import Any, ClassVar

import numpy as np

from ..data import MeshData, Points
from ..gmsh_session import mesh_with_gmsh
from ..parameters import is_length, require, require_affordable, require_positive
from ..sizing import SizeField, estimate_cells_in_box
from ..topology import boundary_facets, exclude_facets, facet_groups_on_planes, facets_on_nodes


@dataclass(frozen=True)
class Loaf:
    """A loaf along x, its middle over the origin, its flat bottom at z = 0.

    A box with rounded edges is meshed; then heights are multiplied by
    1 + dome (1 - (2 x / length)^4) (1 - (2 y / width)^2), and widths by 1 + flare z / height.

    Attributes:
        size: length, width and height of the whole loaf [m].
        h: cell size [m].
        rounding: radius of the upright and the upper edges [m], before doming.
        bottom_rounding: radius of the lower edges [m], not more than `rounding`.
        dome: rise of the top's middle over its rim, as a share of the rim's height.
        flare: widening from bottom to top, as a share of the width.
        grip: length of the patches at both ends by which the loaf is pulled [m].

    Groups: left, right (all facets within `grip` of the least and of the greatest x), bottom (the flat of it), crust
    (all but the bottom). The ends are part of the crust as well.

    Raises:
        MeshError: a parameter is out of range, or the loaf is too small for its rounding.
    """

    name: ClassVar[str] = "loaf"
    groups: ClassVar[tuple[str, ...]] = ("left", "right", "bottom", "crust")
    regions: ClassVar[tuple[str, ...]] = ()

    size: tuple[float, float, float] = (0.25, 0.11, 0.10)
    h: float = 0.008
    rounding: float = 0.028
    bottom_rounding: float = 0.008
    dome: float = 0.25
    flare: float = 0.10
    grip: float = 0.03

    def __post_init__(self) -> None:
        require(len(self.size) == 3, f"loaf: size = {list(self.size)} must be length, width and height.")
        require_positive("loaf", h=self.h, rounding=self.rounding, bottom_rounding=self.bottom_rounding, grip=self.grip)
        require_positive("loaf", **{f"size[{i}]": length for i, length in enumerate(self.size)})
        for name, share in (("dome", self.dome), ("flare", self.flare)):
            require(is_length(share) and 0 <= share <= 1, f"loaf: {name} = {share!r} must lie between 0 and 1.")
        length, width, height = self._block
        require(
            self.bottom_rounding <= self.rounding
            and 2 * self.rounding < min(length, width)
            and self.rounding + self.bottom_rounding < height,
            f"loaf: rounding = {self.rounding!r} and bottom_rounding = {self.bottom_rounding!r} do not fit a block of "
            f"{length:.3g} x {width:.3g} x {height:.3g} m (the size before doming), bottom_rounding being the lesser.",
        )
        require(
            2 * self.grip < length,
            f"loaf: grip = {self.grip!r} must be less than half of the length {length!r}.",
        )
        require_affordable("loaf", self.h, self.cells_estimate())

    def bounds(self) -> tuple[tuple[float, ...], tuple[float, ...]]:
        """Lower and upper corner of the bounding box [m]."""
        length, width, height = self.size
        return (-length / 2, -width / 2, 0.0), (length / 2, width / 2, height)

    def cells_estimate(self) -> int:
        """Approximate number of cells."""
        length, width, height = self._block
        lost = (4 - pi) * self.rounding**2 * (height + length + width) / (length * width * height)
        growth = (1 + self.flare / 2) * (1 + self.dome * 4 / 5 * 2 / 3)  # means of the factors on width and height
        return estimate_cells_in_box(SizeField(self.h), (0.0,) * 3, self._block, filled=max(0.5, 1 - lost) * growth)

    def build(self) -> MeshData:
        """The mesh."""
        points, cells = mesh_with_gmsh(self._draw, 3, SizeField(self.h), self._domed)
        boundary = boundary_facets(cells)
        bottom = facet_groups_on_planes(points, boundary, {"bottom": (2, 0.0)})
        inner_end = self.size[0] / 2 - self.grip * (1 - 1e-9)  # nodes at the end count in spite of round-off
        ends = {
            "left": facets_on_nodes(boundary, points[:, 0] <= -inner_end),
            "right": facets_on_nodes(boundary, points[:, 0] >= inner_end),
        }
        for name, facets in ends.items():
            require(len(facets) > 0, f"loaf: no facet lies within grip = {self.grip!r} of the {name} end; enlarge it.")
        return MeshData(points, cells, ends | bottom | {"crust": exclude_facets(boundary, bottom["bottom"])})

    @property
    def _block(self) -> tuple[float, float, float]:
        """The box before doming and flaring [m]."""
        length, width, height = self.size
        return length, width / (1 + self.flare), height / (1 + self.dome)

    def _draw(self, gmsh: Any) -> None:
        """The block with rounded edges."""
        length, width, height = self._block
        occ = gmsh.model.occ
        block = occ.addBox(-length / 2, -width / 2, 0.0, length, width, height)
        edges = [tag for _, tag in occ.getEntities(1)]
        lower = [occ.getCenterOfMass(1, edge)[2] < 1e-6 * height for edge in edges]
        occ.fillet([block], edges, [self.bottom_rounding if low else self.rounding for low in lower])

    def _domed(self, points: Points) -> Points:
        """Surface points of the block with dome and flare, scaled so that they fill the bounds exactly."""
        length, width, height = self._block
        x, y, z = points.T
        rise = self.dome * (1 - (2 * x / length) ** 4) * (1 - (2 * y / width) ** 2)
        raised = np.stack([x, y * (1 + self.flare * z / height), z * (1 + rise)], axis=1)
        low, high = (np.array(corner) for corner in self.bounds())
        minimum, maximum = raised.min(axis=0), raised.max(axis=0)
        return low + (raised - minimum) / (maximum - minimum) * (high - low)
