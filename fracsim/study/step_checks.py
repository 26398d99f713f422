"""Lines of `fracsim check` on time steps: their number, their stability, and their length against that of waves.

No DOLFINx here.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import numpy.typing as npt

from ..mechanics.stability_limit import SAFETY, frequency_bounds, stable_step
from ..meshes.data import MeshData
from . import Study
from .body import RegionSettings
from .check_limits import LIMITS

Values = npt.NDArray[np.float64]


def time_step_lines(study: Study, dim: int, h: float, mesh: MeshData | None) -> Iterator[str]:
    """Yield the lines on [time].

    Args:
        study: with any table.
        dim: dimension of the mesh.
        h: size of the finest cells, m.
        mesh: if it was read or built.
    """
    timing = study.time
    steps = f"{timing.end / timing.max_step:.0f} steps of {timing.max_step:g} s"
    if timing.min_step < timing.max_step:
        steps = f"steps of {timing.min_step:g} to {timing.max_step:g} s"
    if timing.scheme_class.implicit:
        yield f"time        {timing.scheme}, {steps}, {'halved where a step fails' if timing.adapt else 'fixed'}"
    else:
        yield from _explicit_lines(study, steps, estimated_explicit_step(study, dim, h, mesh))
    if timing.breaking_step is not None:
        yield f"            steps in which edges break are {timing.breaking_step:g} s at most"
    if _may_gain_energy(study, h):
        yield f"            note: in steps this long {timing.scheme} may gain energy at large strains;"
        yield '            scheme = "backward-euler" does not'


def _explicit_lines(study: Study, steps: str, stable: float) -> Iterator[str]:
    """Lines on explicit steps, of which the longest stable one is `stable` s."""
    timing = study.time
    if stable >= timing.max_step:
        yield f"time        {timing.scheme}, {steps}, which are stable (up to some {stable:.2g} s)"
        return
    count = timing.end / stable
    yield f"time        {timing.scheme}, some {count:,.0f} steps of {stable:.2g} s, the longest stable ones;"
    yield f"            time.step = {timing.max_step:g} s is an upper bound that they do not reach"
    if count > LIMITS.max_steps:
        yield "            note: that is more than a million steps: take larger cells or a shorter end, or an implicit"
        yield "            scheme, which has no such limit"


def estimated_explicit_step(study: Study, dim: int, h: float, mesh: MeshData | None) -> float:
    """Returns the longest stable explicit step of the intact body at rest, s (docs/theory.md#stable-time-step).

    It is that of the fastest cell of the mesh. Without a mesh it is estimated from the size h of the finest cells (m).
    It is infinite if h is not known either.
    """
    table = study.damping
    a, b = (table.mass, table.stiffness) if table is not None else (0.0, 0.0)
    factor = dim + 1.0 if study.mesh.order == 1 else LIMITS.quadratic_frequency_factor[dim]
    if mesh is not None:
        # bound of the squared frequency of each cell
        squares = [
            _max_squared_frequency(study, dim, factor, mesh.points[mesh.cells[cells]], region)
            for region, cells in _cells_by_region(study, mesh)
            if len(cells)
        ]
        highest = float(np.sqrt(max(squares)))
    elif np.isfinite(h):
        # no mesh: the fastest wave through a cell of size h
        lattice = study.mesh.builder == "box" and study.mesh.parameters.get("pattern", "structured") == "structured"
        shares = LIMITS.stable_share_lattice if lattice else LIMITS.stable_share_random
        share = shares[dim] * np.sqrt((dim + 1) / factor)
        regions = [RegionSettings(), *study.material.regions.values()]
        highest = 2 * max(_wave_speed(study, dim, region) for region in regions) / (share * h)
    else:
        return float("inf")
    return SAFETY * stable_step(highest, a, b)


def _cells_by_region(study: Study, mesh: MeshData) -> Iterator[tuple[RegionSettings, npt.NDArray[np.int64]]]:
    """Regions of the material with the indices of their cells; last the cells of no region."""
    plain = np.ones(len(mesh.cells), bool)
    for name, region in study.material.regions.items():
        plain[mesh.regions[name]] = False
        yield region, mesh.regions[name]
    yield RegionSettings(), np.flatnonzero(plain)


def _max_squared_frequency(study: Study, dim: int, factor: float, corners: Values, region: RegionSettings) -> float:
    """Largest squared frequency in 1/s^2 of cells with these corners, (cells, d + 1, d) in m."""
    mu, lmbda, density = _lame_parameters(study, dim, region)
    return float(frequency_bounds(corners, mu, lmbda, density, factor).max())


def _wave_speed(study: Study, dim: int, region: RegionSettings) -> float:
    """Speed of longitudinal waves in a region, m/s."""
    mu, lmbda, density = _lame_parameters(study, dim, region)
    return float(np.sqrt((lmbda + 2 * mu) / density))


def _lame_parameters(study: Study, dim: int, region: RegionSettings) -> tuple[float, float, float]:
    """Lame's parameters mu and lambda in Pa, lambda reduced in plane stress, and the density in kg/m^3."""
    young, poisson, density = study.material.elastic_constants(region)
    mu, lmbda = young / (2 * (1 + poisson)), young * poisson / ((1 + poisson) * (1 - 2 * poisson))
    if dim == 2 and study.material.plane == "stress":
        lmbda = 2 * lmbda * mu / (lmbda + 2 * mu)
    return mu, lmbda, density


def _may_gain_energy(study: Study, h: float) -> bool:
    """Returns whether steps are long for waves through cells of size h (m) at finite strains.

    With linear forces no scheme gains energy (mechanics.contact_time_weights). Newmark's method gains it at finite
    strains, generalized-alpha where bodies tear at finite strains.
    """
    material, fracture, scheme = study.material, study.fracture, study.time.scheme
    # The ratio is 0.15 in `bar-2d`, which gains energy, and 0.025 in `doormat`, which gains none.
    is_torn_soft = fracture is not None and LIMITS.max_strength_share < fracture.strength / material.young < np.inf
    if material.energy == "linear" or not (scheme == "newmark" or (scheme == "generalized-alpha" and is_torn_soft)):
        return False
    return study.time.max_step * float(np.sqrt(material.young / material.density)) > LIMITS.max_wave_passes * h
