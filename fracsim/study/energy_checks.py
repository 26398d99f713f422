"""What `fracsim check` says of cracks that take an energy: whether cells and body suit Irwin's length
(docs/theory.md#fracture-energy)."""

from __future__ import annotations

from collections.abc import Iterator

from ..errors import InputError
from ..forms.waves import rayleigh_speed
from . import Study
from .body import RegionSettings

RADIUS = 5.0  # h: of the disc of a tip (fracture.energy.tip_criterion, which is dear to import)
RESOLVED = 8.0  # h that Irwin's length has where cells follow a crack as it opens
PART = 5.0  # times that Irwin's length goes into the body, from which on a crack has room for its tip


def energy_criterion_notes(study: Study, h: float, side: float) -> Iterator[str]:
    """What cracks take and where they begin, of each region that differs, and what to change.

    l_ch = E' G_c / f_t^2 (Irwin) against the finest cells `h` and the body's longest `side`, m.
    """
    table = study.fracture
    assert table is not None
    regions = study.material.regions.items()
    differ = ("young", "poisson", "strength", "fracture_energy")
    every = [("", RegionSettings())] + [
        each for each in regions if any(getattr(each[1], key) is not None for key in differ)
    ]
    for name, region in every:
        energy, strength = region.fracture_energy or table.energy, region.strength or table.strength
        assert energy is not None
        length = plane_modulus(study, region) * energy / strength**2
        where = f"in {name}: " if name else ""
        yield f"{where}cracks that take {energy:g} J/m^2, and begin at {strength:g} Pa; law {table.law}"
        yield f"{where}l_ch = E' G_c / f_t^2 = {length:.3g} m = {length / h:.3g} h"
        if table.law == "cohesive":
            yield from _too_coarse(length, h)
            continue
        yield from _unfit(length, strength, h, side)
        if length >= RESOLVED * h and study.time.scheme == "quasi-static":
            yield 'cells resolve that: with law = "cohesive" cracks hold on while they open, as concrete does'
    if table.branching:
        yield from _branching(study, h)


def check_branching_dimension(study: Study, dim: int) -> None:
    """InputError where cracks in space are to branch."""
    if dim == 3 and study.fracture is not None and study.fracture.branching:
        raise InputError("fracture.branching: cracks branch in the plane only; remove it, or take a 2D mesh")


def _branching(study: Study, h: float) -> Iterator[str]:
    """When tips branch, and whether steps are short enough for it."""
    yield "cracks run at up to half of the Rayleigh speed; tips branch to which 2 G_c flows"
    material, step = study.material, study.time.breaking_step or study.time.max_step
    shear = (material.young / (2 * (1 + material.poisson) * material.density)) ** 0.5
    wave = RADIUS * h / rayleigh_speed(shear, material.poisson)
    if step > wave:
        yield f"note: in steps of {step:.2g} s none does: a Rayleigh wave leaves the disc of a tip in {wave:.2g} s;"
        yield f"breaking_step = {wave / 2:.1g} s would do"


def plane_modulus(study: Study, region: RegionSettings) -> float:
    """E' of a region, or of the rest of the body, Pa."""
    material = study.material
    young, poisson = region.young or material.young, material.poisson if region.poisson is None else region.poisson
    return young / (1 - poisson**2 if material.plane == "strain" else 1.0)


def _too_coarse(length: float, h: float) -> Iterator[str]:
    """Whether cells follow a crack as it opens."""
    if length < RESOLVED * h:
        yield f'note: that is less than {RESOLVED:g} h: cells are too coarse for law = "cohesive";'
        yield f'h = {length / RESOLVED:.2g} m would do, or law = "griffith"'


def _unfit(length: float, strength: float, h: float, side: float) -> Iterator[str]:
    """What is wrong with it."""
    if 0 < length < h:
        yield f"note: that is less than h = {h:.3g} m: in smooth places cracks begin late and take more than G_c;"
        yield f"h = {length:.2g} m would do, or a strength of {strength * (length / h) ** 0.5:.2g} Pa"
    elif length * PART > side:
        yield "note: that is over a fifth of the body: a crack's process zone has no room, and loads are too high"
