"""What `fracsim check` says of time steps: how many there are, and where they are long. No DOLFINx here."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import numpy.typing as npt

from ..mechanics.stability_limit import SAFETY, frequency_bounds, stable_step
from ..meshes.data import MeshData
from . import Study
from .body import RegionSettings

Values = npt.NDArray[np.float64]

RINGS = 2.0  # times that a wave passes an edge in a step, from which on Newmark's method may gain energy
MANY = 1e6  # steps
# stable step over the time of a wave through the finest cells of size h, of meshes that are not built: 0.36 to 0.39 and
# 0.12 to 0.14 of random points, 0.63 and 0.48 of lattices
OF_POINTS, OF_LATTICES = {2: 0.37, 3: 0.13}, {2: 0.63, 3: 0.48}
# of quadratic displacement, in place of d + 1 (timestepping.stable_time_step.gain, whose imports are dear)
QUADRATIC = {2: 20.06, 3: 25.75}


def time_step_lines(study: Study, dim: int, h: float, mesh: MeshData | None) -> Iterator[str]:
    """The lines on [time]; `h`: of the finest cells, m; `mesh`: where it was read or built."""
    timing = study.time
    steps = f"{timing.end / timing.max_step:.0f} steps of {timing.max_step:g} s"
    if timing.min_step < timing.max_step:
        steps = f"steps of {timing.min_step:g} to {timing.max_step:g} s"
    if timing.scheme_class.implicit:
        yield f"time        {timing.scheme}, {steps}, {'halved where a step fails' if timing.adapt else 'fixed'}"
    else:
        yield from _explicit(study, steps, estimated_explicit_step(study, dim, h, mesh))
    if timing.breaking_step is not None:
        yield f"            steps in which edges break are {timing.breaking_step:g} s at most"
    if _may_ring(study, h):
        yield "            note: in steps this long Newmark's method may gain energy at large strains;"
        yield '            scheme = "generalized-alpha" does not'


def _explicit(study: Study, steps: str, stable: float) -> Iterator[str]:
    timing = study.time
    if stable >= timing.max_step:
        yield f"time        {timing.scheme}, {steps}, which are stable (up to some {stable:.2g} s)"
        return
    count = timing.end / stable
    yield f"time        {timing.scheme}, some {count:,.0f} steps of {stable:.2g} s, the longest that are stable;"
    yield f"            time.step = {timing.max_step:g} s is a bound that they do not reach"
    if count > MANY:
        yield "            note: that is more than a million steps: take larger cells or a shorter end, or an implicit"
        yield "            scheme, which has no such bound"


def estimated_explicit_step(study: Study, dim: int, h: float, mesh: MeshData | None) -> float:
    """The longest explicit step of the intact body at rest, s: of its fastest cell, or estimated from the size h of the
    finest cells, m, where there is no mesh. Infinite where neither is known."""
    table = study.damping
    a, b = (table.mass, table.stiffness) if table is not None else (0.0, 0.0)
    factor = dim + 1.0 if study.mesh.order == 1 else QUADRATIC[dim]
    if mesh is not None:
        squares = [_fastest(study, dim, factor, mesh.points[mesh.cells[cells]], region)
                   for region, cells in _parts(study, mesh) if len(cells)]  # fmt: skip
        highest = float(np.sqrt(max(squares)))
    elif np.isfinite(h):
        lattice = study.mesh.builder == "box" and study.mesh.parameters.get("pattern", "structured") == "structured"
        share = (OF_LATTICES if lattice else OF_POINTS)[dim] * np.sqrt((dim + 1) / factor)
        regions = [RegionSettings(), *study.material.regions.values()]
        highest = 2 * max(_wave_speed(study, dim, region) for region in regions) / (share * h)
    else:
        return float("inf")
    return SAFETY * stable_step(highest, a, b)


def _parts(study: Study, mesh: MeshData) -> Iterator[tuple[RegionSettings, npt.NDArray[np.int64]]]:
    """Regions of the material and their cells, and the cells of no region."""
    plain = np.ones(len(mesh.cells), bool)
    for name, region in study.material.regions.items():
        plain[mesh.regions[name]] = False
        yield region, mesh.regions[name]
    yield RegionSettings(), np.flatnonzero(plain)


def _fastest(study: Study, dim: int, factor: float, corners: Values, region: RegionSettings) -> float:
    mu, lmbda, density = _moduli(study, dim, region)
    return float(frequency_bounds(corners, mu, lmbda, density, factor).max())


def _wave_speed(study: Study, dim: int, region: RegionSettings) -> float:
    mu, lmbda, density = _moduli(study, dim, region)
    return float(np.sqrt((lmbda + 2 * mu) / density))


def _moduli(study: Study, dim: int, region: RegionSettings) -> tuple[float, float, float]:
    """Lame's parameters (in plane stress with the reduced lambda), Pa, and the density, kg/m^3, of a region."""
    material = study.material
    young, density = region.young or material.young, region.density or material.density
    poisson = material.poisson if region.poisson is None else region.poisson
    mu, lmbda = young / (2 * (1 + poisson)), young * poisson / ((1 + poisson) * (1 - 2 * poisson))
    if dim == 2 and material.plane == "stress":
        lmbda = 2 * lmbda * mu / (lmbda + 2 * mu)
    return mu, lmbda, density


def _may_ring(study: Study, h: float) -> bool:
    """Whether steps of Newmark's method are long for the waves in a body of finite strains, whose edges are known: its
    energy is kept where forces are linear (mechanics.contact_time_weights)."""
    material = study.material
    if study.time.scheme != "newmark" or material.energy == "linear":
        return False
    return study.time.max_step * float(np.sqrt(material.young / material.density)) > RINGS * h
