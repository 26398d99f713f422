"""Questions about values that look like those of another system of units; a study is in SI units.

Users have meshes in mm, moduli in MPa or GPa, densities in g/cm^3 or t/mm^3, strengths in MPa and fracture energies in
N/mm. The thresholds are far from all materials of `material_library`.
"""

from __future__ import annotations

from collections.abc import Iterator
from math import inf, sqrt

from . import Study
from .body import RegionSettings
from .check_limits import LIMITS
from .length_checks import plane_modulus


def unit_questions(study: Study, max_side: float) -> Iterator[str]:
    """Yield lines that begin with "question:", or continue such a line.

    Args:
        study: with any table.
        max_side: longest side of the body, m.
    """
    if max_side > LIMITS.max_side:
        yield f"question: the body is {max_side:.4g} m long: is the mesh in mm? {_length_remedy(study)}"
    if max_side < LIMITS.min_side:
        yield f"question: the body is {max_side:.4g} m long: {_length_remedy(study)} (lengths are in m)"
    yield from _material_questions(study, "material.", RegionSettings())
    for name, region in study.material.regions.items():
        if region.young or region.density or region.strength or region.fracture_energy:
            yield from _material_questions(study, f"material.{name}.", region)
    gravity = study.load.gravity if study.load is not None else None
    if gravity is not None and (magnitude := max(map(abs, gravity))) > LIMITS.max_gravity:
        yield f"question: gravity is {magnitude:g} m/s^2: is it in mm/s^2? On Earth it is 9.81 m/s^2"


def _length_remedy(study: Study) -> str:
    if study.mesh.builder is not None:
        return "Give mesh.h and the sizes of the builder in m"
    return "Give mesh.scale, metres for each unit of length of the file (a file in mm: mesh.scale = 1e-3)"


def _material_questions(study: Study, prefix: str, region: RegionSettings) -> Iterator[str]:
    """Yield questions on a region whose keys begin with `prefix`."""
    young, _, density = study.material.elastic_constants(region)
    si_density = _guess_density(density, young)
    if si_density != density:
        unit = "t/mm^3" if density < 1e-3 else "g/cm^3"
        yield f"question: {prefix}density = {density:g} kg/m^3: is it in {unit}? Then it is {si_density:.4g} kg/m^3"
    elif density > LIMITS.max_density:
        yield f"question: {prefix}density = {density:g} kg/m^3 is more than that of any metal: it is in kg/m^3"
    # the speed of sound tells moduli in GPa or MPa from those in Pa
    speed = sqrt(young / si_density)
    soft = young < LIMITS.soft_young and (si_density > LIMITS.soft_density or speed < LIMITS.min_sound_speed)
    if soft:
        unit, factor = ("GPa", 1e9) if young < 1000 else ("MPa", 1e6)
        yield f"question: {prefix}young = {young:g} Pa with a density of {si_density:.4g} kg/m^3 is softer than rubber:"
        yield f"is it in {unit}? Then it is {young * factor:.4g} Pa"
    elif speed > LIMITS.max_sound_speed:
        yield f"question: {prefix}young = {young:g} Pa with a density of {si_density:.4g} kg/m^3: sound would run at"
        yield f"{speed:.2g} m/s, faster than in diamond; young is in Pa"
    table = study.fracture
    if table is None:
        return
    strength, energy = region.strength or table.strength, region.fracture_energy or table.energy
    if strength < LIMITS.min_strength_share * young:
        yield f"question: strength = {strength:g} Pa is {strength / young:.1g} of young: is it in MPa?"
        yield f"Then it is {strength * 1e6:.3g} Pa"
        return
    if soft or energy is None or not strength < inf:
        return
    if plane_modulus(study, region) * energy < LIMITS.min_irwin_length * strength**2:
        yield f"question: energy = {energy:g} J/m^2: l_ch is shorter than an atom is wide: is it in N/mm or kJ/m^2?"
        yield f"Then it is {energy * 1e3:.3g} J/m^2"


def _guess_density(density: float, young: float) -> float:
    """Returns the density in kg/m^3, converted if the value looks like one in t/mm^3 or g/cm^3; `young` in Pa."""
    if density < 1e-3:
        return density * 1e12
    # foams are as light as metals in g/cm^3, but not as stiff
    light = density < LIMITS.min_density or (density < LIMITS.metal_density and young > LIMITS.metal_young)
    return density * 1e3 if light else density
