"""Questions where figures of a study look like those of another system of units; a study is in SI units throughout.

Users bring meshes in mm, moduli in MPa or GPa, densities in g/cm^3 or t/mm^3, strengths in MPa and fracture energies in
N/mm. What no solid has, or hardly any, is asked about: all limits are far from the materials of `materials`.
"""

from __future__ import annotations

from collections.abc import Iterator
from math import inf, sqrt

from . import Study
from .body import RegionSettings
from .energy_checks import plane_modulus

LONG, SHORT = 20.0, 1e-6  # m, sides of bodies that are seldom broken as one, or are no continuum
SOFT, DENSE = 1e6, 1600.0  # Pa and kg/m^3: rubber and gels are softer, and not as dense as this; stone and metals are
LIGHT, HEAVY = 12.0, 3e4  # kg/m^3: lighter than foams, heavier than all metals
OF_METALS, STIFF = 25.0, 1e8  # kg/m^3 and Pa: what is as light as foam is not as stiff as this; metals in g/cm^3 are
SLOW, FAST = 1.0, 2e4  # m/s, of sound: in gels it is a few m/s, in diamond 1.8e4
WEAK = 1e-6  # of Young's modulus: strengths of concrete and stone are 1e-4 of it
NEAR = 1e-9  # m, of Irwin's length: a few atoms
GRAVITY = 1000.0  # m/s^2


def unit_questions(study: Study, side: float) -> Iterator[str]:
    """Lines that begin with "question:", or go on; `side`: the body's longest, m."""
    if side > LONG:
        yield f"question: the body is {side:.4g} m long: is the mesh in mm? {_in_metres(study)}"
    if side < SHORT:
        yield f"question: the body is {side:.4g} m long: {_in_metres(study)} (lengths are in m)"
    for where, region in [
        ("", RegionSettings()),
        *((f"{name}.", each) for name, each in study.material.regions.items()),
    ]:
        if not where or (region.young or region.density or region.strength or region.fracture_energy):
            yield from _of_material(study, f"material.{where}", region)
    gravity = study.load.gravity if study.load is not None else None
    if gravity is not None and (most := max(map(abs, gravity))) > GRAVITY:
        yield f"question: gravity is {most:g} m/s^2: is it in mm/s^2? On Earth it is 9.81 m/s^2"


def _in_metres(study: Study) -> str:
    if study.mesh.builder is not None:
        return "Give mesh.h and the sizes of the builder in m"
    return "Give mesh.scale, metres for each unit of length of the file (a file in mm: mesh.scale = 1e-3)"


def _of_material(study: Study, key: str, region: RegionSettings) -> Iterator[str]:
    material = study.material
    young, density = region.young or material.young, region.density or material.density
    dense = _dense(density, young)
    if dense != density:
        unit = "t/mm^3" if density < 1e-3 else "g/cm^3"
        yield f"question: {key}density = {density:g} kg/m^3: is it in {unit}? Then it is {dense:.4g} kg/m^3"
    elif density > HEAVY:
        yield f"question: {key}density = {density:g} kg/m^3 is more than that of any metal: it is in kg/m^3"
    speed = sqrt(young / dense)
    soft = young < SOFT and (dense > DENSE or speed < SLOW)
    if soft:
        unit, factor = ("GPa", 1e9) if young < 1000 else ("MPa", 1e6)
        yield f"question: {key}young = {young:g} Pa with a density of {dense:.4g} kg/m^3 is softer than rubber:"
        yield f"is it in {unit}? Then it is {young * factor:.4g} Pa"
    elif speed > FAST:
        yield f"question: {key}young = {young:g} Pa with a density of {dense:.4g} kg/m^3: sound would run at"
        yield f"{speed:.2g} m/s, faster than in diamond; young is in Pa"
    table = study.fracture
    if table is None:
        return
    strength, energy = region.strength or table.strength, region.fracture_energy or table.energy
    if strength < WEAK * young:
        yield f"question: strength = {strength:g} Pa is {strength / young:.1g} of young: is it in MPa?"
        yield f"Then it is {strength * 1e6:.3g} Pa"
        return
    if soft or energy is None or not strength < inf:
        return
    if plane_modulus(study, region) * energy < NEAR * strength**2:
        yield f"question: energy = {energy:g} J/m^2: l_ch is shorter than an atom is wide: is it in N/mm or kJ/m^2?"
        yield f"Then it is {energy * 1e3:.3g} J/m^2"


def _dense(density: float, young: float) -> float:
    """The density in kg/m^3, where the figure given looks like one in t/mm^3 or g/cm^3."""
    if density < 1e-3:
        return density * 1e12
    light = density < LIGHT or (density < OF_METALS and young > STIFF)
    return density * 1e3 if light else density
