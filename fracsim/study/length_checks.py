"""Checks of strength, fracture energy, cell size and body against each other, for `fracsim check`.

The length that decides is Irwin's, l_ch = E' G_c / f_t^2 (docs/theory.md#fracture-energy). The rotation of fragments is
estimated by theta = v T / L, with the duration T and the least side L of the body. Its speed v is the largest of the
speed that fracture gives a fragment, f_t / sqrt(Y rho), the speed of prescribed motions and obstacles, and that of free
fall.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from ..errors import InputError
from ..mechanics.stability_limit import rayleigh_wave_speed
from . import FractureSettings, Study
from .body import RegionSettings
from .check_limits import LIMITS
from .conditions import boundary_conditions, initial_motion, obstacle_placements, volume_loads
from .material_library import MATERIALS


def length_scale_notes(study: Study, h: float, min_side: float, max_side: float) -> Iterator[str]:
    """Yield notes on strength, energy and cell size that do not fit together.

    Args:
        study: with any table.
        h: cell size, m; infinite if it is not known.
        min_side: least side of the body, m.
        max_side: longest side of the body, m.
    """
    table = study.fracture
    if table is None:
        return
    if table.radius and table.radius > max_side:
        yield f"question: radius is {table.radius:g} m, the body is {max_side:.4g} m long: is the radius in mm? With a"
        yield "stress that is averaged over the whole body no place breaks before another"
    if table.radius and table.radius < LIMITS.min_radius_share * h < float("inf"):
        yield f"note: radius is {table.radius / h:.2g} h: the stress is not averaged, and cracks depend on the mesh;"
        yield 'take a radius of several h, or kernel = "neighbours"'
    if study.brittle is not None:
        return
    if table.strength > LIMITS.max_strength_share * study.material.young and table.strength < float("inf"):
        yield f"note: strength is {table.strength / study.material.young:.2g} of young: only rubber is that strong"
    if table.energy is None:
        if (scatter := table.heterogeneity) is not None:
            plane, space = (2 ** (-dim / scatter.modulus) for dim in (2, 3))
            yield f"note: strength scatters by edge: half h lowers the weakest to {plane:.2g} in 2D, {space:.2g} in 3D"
        yield from _edge_energy_notes(study, plane_modulus(study, RegionSettings()), table.radius or h)
        return
    clearance = LIMITS.tip_clearance
    if table.law == "griffith" and min_side < 2 * clearance * h < float("inf"):
        yield (
            f"note: tips need {clearance:g} h on every side, the body is {min_side / h:.3g} h across: "
            f"h below {min_side / 2 / clearance:.2g} m"
        )


def _edge_energy_notes(study: Study, modulus: float, h: float) -> Iterator[str]:
    """Yield the energy of a crack by single edges, f_t^2 h / 2 E' for each area, beside that of the material.

    It is the elastic energy of a row of cells at the strength, whatever the fracture energy is.
    """
    table, like = study.fracture, study.material.like
    assert table is not None
    if not (h < float("inf") and table.strength < float("inf")):
        return
    energy = table.strength**2 * h / (2 * modulus)
    material_energy = MATERIALS[like].energy if like is not None else None
    word = "radius" if table.radius else "h"
    yield f"edges break one by one: a crack takes about f_t^2 {word} / 2 E' = {energy:.2g} J/m^2"
    ratio = LIMITS.max_energy_ratio
    if material_energy is not None and not material_energy / ratio < energy < material_energy * ratio:
        yield (
            f"note: {like} takes {material_energy:g} J/m^2: give fracture.energy = true (2D), or "
            f"{word} = {2 * modulus * material_energy / table.strength**2:.2g} m"
        )


def small_strain_notes(study: Study) -> Iterator[str]:
    """Yield a note if a slow energy of large strains is chosen for a brittle material."""
    material, table, like = study.material, study.fracture, study.material.like
    strength = table.strength if table is not None else MATERIALS[like].strength if like is not None else None
    if material.energy == "linear" or study.time.scheme != "quasi-static" or strength is None or study.plasticity:
        return
    strain = strength / material.young
    # regions with values of their own are left to the user
    uniform = not any(region.young or region.strength for region in material.regions.values())
    if strain < LIMITS.max_small_strain and uniform:
        yield f"note: strains stay below strength / young = {100 * strain:.2g} %, and energy = {material.energy} is one"
        yield 'of large strains: energy = "linear" gives the same loads in less time, unless thin parts bend far'


def energy_criterion_notes(study: Study, h: float, max_side: float) -> Iterator[str]:
    """Yield fracture energy, strength and Irwin's length of each region, with notes on what does not fit.

    Args:
        study: with `fracture.energy`.
        h: size of the finest cells, m.
        max_side: longest side of the body, m.
    """
    table = study.fracture
    assert table is not None
    for name, region in _fracture_regions(study):
        energy, strength = region.fracture_energy or table.energy, region.strength or table.strength
        assert energy is not None
        length = plane_modulus(study, region) * energy / strength**2
        prefix = f"in {name}: " if name else ""
        yield f"{prefix}cracks with fracture energy {energy:g} J/m^2 and strength {strength:g} Pa; law {table.law}"
        yield f"{prefix}l_ch = E' G_c / f_t^2 = {length:.3g} m = {length / h:.3g} h"
        if table.law == "cohesive":
            yield from _cohesive_notes(length, h)
            continue
        yield _start_note(length / np.pi, h)
        if study.plasticity is not None:
            yield from _elastic_zone_notes(length / np.pi, h)
        yield from _process_zone_notes(length, strength, h, max_side)
        if length >= LIMITS.min_zone_cells * h and study.time.scheme == "quasi-static":
            yield 'cells resolve the process zone: with law = "cohesive" cracks soften as they open, as in concrete'
    if table.branching:
        yield from _branching_notes(study, h)


def _fracture_regions(study: Study) -> list[tuple[str, RegionSettings]]:
    """The body without regions, named "", and the regions with elastic constants, strength or energy of their own."""
    keys = ("young", "poisson", "strength", "fracture_energy")
    regions = study.material.regions.items()
    differing = [entry for entry in regions if any(getattr(entry[1], name) is not None for name in keys)]
    return [("", RegionSettings()), *differing]


def check_branching_dimension(study: Study, dim: int) -> None:
    """Raises InputError if cracks are to branch in 3D."""
    if dim == 3 and study.fracture is not None and study.fracture.branching:
        raise InputError("fracture.branching: cracks branch in the plane only; remove it, or take a 2D mesh")


def _branching_notes(study: Study, h: float) -> Iterator[str]:
    """Yield whether steps are short enough for the branching of tips."""
    yield "cracks run at up to half of the Rayleigh speed; a tip that receives 2 G_c branches"
    material, step = study.material, study.time.breaking_step or study.time.max_step
    # tips branch by the mean energy over the time of a Rayleigh wave through their domain
    shear = (material.young / (2 * (1 + material.poisson) * material.density)) ** 0.5
    wave = LIMITS.tip_radius * h / rayleigh_wave_speed(shear, material.poisson)
    if step > wave:
        yield f"note: no tip branches in steps of {step:.2g} s: a Rayleigh wave leaves its disc in {wave:.2g} s;"
        yield f"breaking_step = {wave / 2:.1g} s is sufficient"


def plane_modulus(study: Study, region: RegionSettings) -> float:
    """Returns E' = E / (1 - nu^2) of a region in Pa; E in plane stress."""
    young, poisson, _ = study.material.elastic_constants(region)
    return young / (1 - poisson**2 if study.material.plane == "strain" else 1.0)


def _cohesive_notes(length: float, h: float) -> Iterator[str]:
    """Yield a note if cells of size h do not resolve a process zone of that length, both in m."""
    cells = LIMITS.min_zone_cells
    if length < cells * h:
        yield f'note: that is less than {cells:g} h: cells are too coarse for law = "cohesive";'
        yield f'h = {length / cells:.2g} m is sufficient, or law = "griffith"'


def _start_note(length: float, h: float) -> str:
    """Return by what a crack starts at a notch; `length` is L of the critical distance, `h` the size of cells, m."""
    start = f"cracks start by strength and energy: L = E' G_c / (pi f_t^2) = {length:.3g} m = {length / h:.3g} h;"
    if length >= LIMITS.min_start_cells * h:
        return f"{start} cells resolve the stress ahead of a notch"
    return f"{start} at a notch the energy decides, elsewhere the strength"


def _elastic_zone_notes(length: float, h: float) -> Iterator[str]:
    """Yield the radius of the elastic zone around tips; `length` is L of the critical distance, both in m."""
    disc = LIMITS.tip_radius * h
    yield f"the body stays elastic within {max(length / 2, disc):.3g} m of a crack tip"
    if length / 2 < disc:
        yield f"note: that is {LIMITS.tip_radius:g} h, since L / 2 is less: the toughness depends on h;"
        yield f"h = {length / 2 / LIMITS.tip_radius:.2g} m is sufficient"


def _process_zone_notes(length: float, strength: float, h: float, max_side: float) -> Iterator[str]:
    """Yield a note if Irwin's length is below a cell or above a fifth of the body; lengths in m."""
    if 0 < length < h:
        yield f"note: that is less than h = {h:.3g} m: without a notch cracks start late and take more than G_c;"
        yield f"h = {length:.2g} m is sufficient, or a strength of {strength * (length / h) ** 0.5:.2g} Pa"
    elif length * LIMITS.min_zone_share > max_side:
        yield "note: that is over a fifth of the body: the process zone of a crack has no space, and loads are too high"


def estimated_rotation(study: Study, dim: int, min_side: float) -> float:
    """Returns an upper estimate of the rotation of fragments until the end of the study, in rad.

    It is 0 if nothing breaks or there is no inertia. With the energy linear a rotated fragment swells by 1/cos.

    Args:
        study: with any table.
        dim: dimension of the mesh.
        min_side: least side of the body, m.
    """
    fracture = study.fracture
    if fracture is None or not study.time.scheme_class.inertia or not fracture.strength < np.inf:
        return 0.0
    distance = max(_travel_distances(study, dim, fracture))
    _, spin = initial_motion(study, dim) or (None, None)
    return max(distance / min_side, float(np.linalg.norm(spin)) * study.time.end if spin is not None else 0.0)


def _travel_distances(study: Study, dim: int, fracture: FractureSettings) -> Iterator[float]:
    """Distances in m that fragments may travel until the end, by each cause of motion."""
    end, material = study.time.end, study.material
    yield fracture.strength / np.sqrt(material.young * material.density) * end
    for condition in boundary_conditions(study, dim):
        if condition.prescribes_motion:
            yield _max_distance(condition.function, end)
    for obstacle in obstacle_placements(study, dim):
        if obstacle.displacement is not None:
            yield _max_distance(obstacle.displacement, end)
        if obstacle.free_motion is not None:
            yield float(np.abs(obstacle.free_motion.initial_rate).max(initial=0.0)) * end
    if (load := volume_loads(study, dim)) and "gravity" in load:
        yield float(np.linalg.norm(load["gravity"](end))) * end**2 / 2
    velocity, _ = initial_motion(study, dim) or (None, None)
    yield float(np.linalg.norm(velocity)) * end if velocity is not None else 0.0


def _max_distance(function: object, end: float) -> float:
    """Greatest distance in m of a motion from its start, at 20 times until `end`; free components are ignored."""
    assert callable(function)
    return max(float(np.linalg.norm(np.nan_to_num(function(t)))) for t in np.linspace(0.0, end, 20))
