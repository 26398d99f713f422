"""A vase: a body of revolution, solid or with a wall."""

from __future__ import annotations

from dataclasses import dataclass
from math import comb, pi
from typing import Any, ClassVar

import numpy as np
from numpy.polynomial import Polynomial

from ..data import MeshData
from ..gmsh_session import mesh_with_gmsh
from ..parameters import require, require_affordable, require_not_negative, require_positive
from ..sizing import SizeField, estimate_cells_in_body
from ..topology import boundary_facets, exclude_facets, facet_groups_on_planes, facets_on_nodes

# Radii of the control polygon of the profile from foot to lip, in units of the radius of the belly. Their heights are
# equally spaced, so that r is a polynomial in z.
CONTROL = (0.50, 1.05, 1.50, 0.90, 0.05, 0.35, 0.55)


@dataclass(frozen=True)
class Vase:
    """A vase around the z axis with its base at z = 0, open at its rim, or solid.

    The profile is a Bezier curve, r(z) a polynomial of degree 6 with its greatest value at the belly.

    Attributes:
        height: [m].
        radius: of the belly [m].
        wall: thickness of the wall measured across the axis, and of the floor [m]; 0: solid.
        h: cell size [m].

    Groups: base (z = 0), rim (z = height), side (outside), and inside where there is a wall.

    Raises:
        MeshError: a parameter is out of range, or the wall closes the neck.
    """

    name: ClassVar[str] = "vase"
    regions: ClassVar[tuple[str, ...]] = ()

    height: float = 0.25
    radius: float = 0.08
    wall: float = 0.008
    h: float = 0.006

    def __post_init__(self) -> None:
        require_positive("vase", height=self.height, radius=self.radius, h=self.h)
        require_not_negative("vase", wall=self.wall)
        neck = float(self.outline()(np.linspace(0, self.height, 400)).min())
        require(
            self.wall < neck and self.wall < self.height,
            f"vase: wall = {self.wall!r} must be less than the radius of the neck, {neck:.4g} m; 0 makes it solid.",
        )
        require_affordable("vase", self.h, self.cells_estimate())

    @property
    def groups(self) -> tuple[str, ...]:
        """Names of the facet groups."""
        return ("base", "rim", "side", "inside") if self.wall else ("base", "rim", "side")

    def outline(self) -> Polynomial:
        """Outer radius over height, r(z) [m]."""
        degree = len(CONTROL) - 1
        unit = Polynomial([0.0, 1.0])
        terms = [c * comb(degree, i) * unit**i * (1 - unit) ** (degree - i) for i, c in enumerate(CONTROL)]
        share = sum(terms, Polynomial([0.0]))
        return self.radius / _maximum(share) * share(Polynomial([0.0, 1 / self.height]))

    def volume(self) -> float:
        """Volume [m^3]: pi (integral of r^2 over the height, less that of (r - wall)^2 above the floor)."""
        outer = (self.outline() ** 2).integ()
        whole = outer(self.height) - outer(0.0)
        if not self.wall:
            return float(pi * whole)
        inner = ((self.outline() - self.wall) ** 2).integ()
        return float(pi * (whole - inner(self.height) + inner(self.wall)))

    def bounds(self) -> tuple[tuple[float, ...], tuple[float, ...]]:
        """Lower and upper corner of the bounding box [m]."""
        return (-self.radius, -self.radius, 0.0), (self.radius, self.radius, self.height)

    def cells_estimate(self) -> int:
        """Approximate number of cells."""
        return estimate_cells_in_body(self.volume(), self.wall, self.h)

    def build(self) -> MeshData:
        """The mesh."""
        from ..surfaces.fill import remove_boundary_slivers

        points, cells = mesh_with_gmsh(self._draw, 3, SizeField(self.h))
        # gmsh sometimes leaves flat cells between two faces of the side: volume over longest edge cubed up to 2e-3
        cells = remove_boundary_slivers(points, cells, 2e-3)
        boundary = boundary_facets(cells)
        groups = facet_groups_on_planes(points, boundary, {"base": (2, 0.0), "rim": (2, self.height)})
        if self.wall:
            within = np.hypot(points[:, 0], points[:, 1]) < self.outline()(points[:, 2]) - self.wall / 2
            inside = facets_on_nodes(boundary, within & (points[:, 2] > self.wall / 2))
            groups["inside"] = exclude_facets(inside, groups["rim"])
        return MeshData(points, cells, groups | {"side": exclude_facets(boundary, *groups.values())})

    def _draw(self, gmsh: Any) -> None:
        """The half section, revolved around the axis."""
        occ = gmsh.model.occ
        top = float(self.outline()(self.height))
        outer = _bezier(self.outline(), 0.0, self.height)
        if self.wall:
            corners = _bezier(self.outline() - self.wall, self.height, self.wall)
            inner = [*corners, (0.0, self.wall)]
        else:
            inner = [(top, self.height), (0.0, self.height)]
        occ.revolve([(2, _section(occ, outer, inner, curved=bool(self.wall)))], 0, 0, 0, 0, 0, 1, 2 * pi)


def _section(occ: Any, outer: list[tuple[float, float]], inner: list[tuple[float, float]], *, curved: bool) -> int:
    """The plane face between the axis, the outer curve upwards and the inner one downwards, in the x-z plane."""
    axis = occ.addPoint(0.0, 0.0, 0.0)
    up = [occ.addPoint(r, 0.0, z) for r, z in outer]
    curves = [occ.addLine(axis, up[0]), occ.addBezier(up)]
    if curved:
        down = [occ.addPoint(r, 0.0, z) for r, z in inner[:-1]]
        curves += [occ.addLine(up[-1], down[0]), occ.addBezier(down)]
        start = down[-1]
    else:
        start = up[-1]
    middle = occ.addPoint(0.0, 0.0, inner[-1][1])
    curves += [occ.addLine(start, middle), occ.addLine(middle, axis)]
    return int(occ.addPlaneSurface([occ.addCurveLoop(curves)]))


def _bezier(radius: Polynomial, start: float, end: float) -> list[tuple[float, float]]:
    """Control points (r, z) [m] of the curve r(z) from one height to the other.

    With r(start + t (end - start)) = sum_j a_j t^j the control radii are b_i = sum_j C(i, j) / C(n, j) a_j, and the
    control heights are equally spaced.
    """
    n = radius.degree()
    a = radius(Polynomial([start, end - start])).coef
    radii = [sum(comb(i, j) / comb(n, j) * a[j] for j in range(i + 1)) for i in range(n + 1)]
    return [(float(r), start + i / n * (end - start)) for i, r in enumerate(radii)]


def _maximum(share: Polynomial) -> float:
    """The maximum over [0, 1]: at an end, or where the slope is zero."""
    flat = share.deriv().roots()
    inner = flat.real[(np.abs(flat.imag) < 1e-12) & (flat.real > 0) & (flat.real < 1)]
    return float(share(np.concatenate([[0.0, 1.0], inner])).max())
