"""How far pieces that come off may turn until the end of a study, roughly: with a linear energy they swell by 1/cos.

A piece leaves at the speed that breaking gives it, f_t / sqrt(Y rho), at that of what drives or strikes the body, or at
what gravity has given it by the end, whichever is most; as large as the body's least side L it turns by

    theta = v T / L.

Stiff bodies in short studies hardly turn: a disk of granite by a tenth of a degree before it has split.
"""

from __future__ import annotations

import numpy as np

from . import Study
from .conditions import conditions, initial_motion, obstacles, volume_loads

MUCH = 0.1  # rad: half a percent larger


def turned(study: Study, dim: int, least: float) -> float:
    """rad; `least`: the body's least side, m. 0 where nothing breaks or there is no inertia."""
    if study.fracture is None or not study.time.kind.inertia or not study.fracture.strength < np.inf:
        return 0.0
    end, material = study.time.end, study.material
    ways = [study.fracture.strength / np.sqrt(material.young * material.density) * end]
    ways += [_way(each.function, end) for each in conditions(study, dim) if each.moves]
    for each in obstacles(study, dim):
        if each.moved is not None:
            ways.append(_way(each.moved, end))
        if each.loose is not None:
            ways.append(float(np.abs(each.loose.rate).max(initial=0.0)) * end)
    if (load := volume_loads(study, dim)) and "gravity" in load:
        ways.append(float(np.linalg.norm(load["gravity"](end))) * end**2 / 2)
    velocity, spin = initial_motion(study, dim) or (None, None)
    ways.append(float(np.linalg.norm(velocity)) * end if velocity is not None else 0.0)
    return max(max(ways) / least, float(np.linalg.norm(spin)) * end if spin is not None else 0.0)


def _way(function: object, end: float) -> float:
    """m, the greatest distance of a motion from its start, at 20 times until `end`; what is free does not count."""
    assert callable(function)
    return max(float(np.linalg.norm(np.nan_to_num(function(t)))) for t in np.linspace(0.0, end, 20))
