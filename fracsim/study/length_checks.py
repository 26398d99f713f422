"""Whether strength, mesh and body fit together: what `fracsim check` says of them beside cracks that take an energy
(energy_checks).

How far pieces that come off may turn until the end of a study, roughly: with a linear energy they swell by 1/cos.

A piece leaves at the speed that breaking gives it, f_t / sqrt(Y rho), at that of what drives or strikes the body, or at
what gravity has given it by the end, whichever is most; as large as the body's least side L it turns by

    theta = v T / L.

Stiff bodies in short studies hardly turn: a disk of granite by a tenth of a degree before it has split.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from . import Study
from .body import RegionSettings
from .conditions import boundary_conditions, initial_motion, obstacle_placements, volume_loads
from .energy_checks import plane_modulus
from .material_library import MATERIALS

TIP_CLEARANCE = 6.0  # h that a tip needs around it
MAX_ENERGY_RATIO = 3.0  # times that an energy may be off without a word
MAX_SMALL_STRAIN = 0.005  # strain at the strength, below which stretches do not matter
MAX_LINEAR_ROTATION = 0.1  # rad: half a percent larger


def length_scale_notes(study: Study, h: float, least: float) -> Iterator[str]:
    """Notes on what does not fit together; `h`: size of the cells, infinite where it is not known, and `least`: the
    body's least side, m."""
    table = study.fracture
    if table is None or study.brittle is not None:
        return
    if table.strength > 0.1 * study.material.young and table.strength < float("inf"):
        yield f"note: strength is {table.strength / study.material.young:.2g} of young: only rubber is that strong"
    if table.energy is None:
        yield from _spent(study, plane_modulus(study, RegionSettings()), table.radius or h)
        return
    if table.law == "griffith" and least < 2 * TIP_CLEARANCE * h < float("inf"):
        most = least / 2 / TIP_CLEARANCE
        yield (
            f"note: tips need {TIP_CLEARANCE:g} h on every side, the body is {least / h:.3g} h across: "
            f"h below {most:.2g} m"
        )


def small_strain_notes(study: Study) -> Iterator[str]:
    """A note where slow steps pay for large strains that a brittle material does not reach."""
    material, table, like = study.material, study.fracture, study.material.like
    strength = table.strength if table is not None else MATERIALS[like].strength if like is not None else None
    if material.energy == "linear" or study.time.scheme != "quasi-static" or strength is None or study.plasticity:
        return
    share = strength / material.young
    if share < MAX_SMALL_STRAIN and not any(each.young or each.strength for each in material.regions.values()):
        yield f"note: strains stay below strength / young = {100 * share:.2g} %, and energy = {material.energy} is one"
        yield 'of large strains: energy = "linear" gives the same loads in less time, unless thin parts bend far'


def _spent(study: Study, stiff: float, cell: float) -> Iterator[str]:
    """What single edges take: the energy of a row of cells at their strength, f_t^2 h / 2 E', whatever G_c is."""
    table, like = study.fracture, study.material.like
    assert table is not None
    if not (cell < float("inf") and table.strength < float("inf")):
        return
    spent = table.strength**2 * cell / (2 * stiff)
    of = MATERIALS[like].energy if like is not None else None
    word = "radius" if table.radius else "h"
    yield f"edges break one by one: a crack takes some f_t^2 {word} / 2 E' = {spent:.2g} J/m^2, as much as h has it"
    if of is not None and not of / MAX_ENERGY_RATIO < spent < of * MAX_ENERGY_RATIO:
        yield (
            f"note: {like} takes {of:g} J/m^2: give fracture.energy = true (2D), or {word} = "
            f"{2 * stiff * of / table.strength**2:.2g} m"
        )


def estimated_rotation(study: Study, dim: int, least: float) -> float:
    """rad; `least`: the body's least side, m. 0 where nothing breaks or there is no inertia."""
    if study.fracture is None or not study.time.scheme_class.inertia or not study.fracture.strength < np.inf:
        return 0.0
    end, material = study.time.end, study.material
    ways = [study.fracture.strength / np.sqrt(material.young * material.density) * end]
    ways += [_way(each.function, end) for each in boundary_conditions(study, dim) if each.prescribes_motion]
    for each in obstacle_placements(study, dim):
        if each.displacement is not None:
            ways.append(_way(each.displacement, end))
        if each.free_motion is not None:
            ways.append(float(np.abs(each.free_motion.initial_rate).max(initial=0.0)) * end)
    if (load := volume_loads(study, dim)) and "gravity" in load:
        ways.append(float(np.linalg.norm(load["gravity"](end))) * end**2 / 2)
    velocity, spin = initial_motion(study, dim) or (None, None)
    ways.append(float(np.linalg.norm(velocity)) * end if velocity is not None else 0.0)
    return max(max(ways) / least, float(np.linalg.norm(spin)) * end if spin is not None else 0.0)


def _way(function: object, end: float) -> float:
    """m, the greatest distance of a motion from its start, at 20 times until `end`; what is free does not count."""
    assert callable(function)
    return max(float(np.linalg.norm(np.nan_to_num(function(t)))) for t in np.linspace(0.0, end, 20))
