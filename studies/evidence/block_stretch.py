"""Exact force and stress of a block that is pulled along x with free (uniaxial) or fixed (confined) lateral sides.

With principal stretches l1 (given) and lt (both lateral), J = l1 lt^2 and I = l1^2 + 2 lt^2:

    neo-hookean  P_i = m (1 - 1 / (I + 1)) l_i + l (J - alpha) J / l_i      (M22 eq. 25)
    stvk         P_i = l_i (2 mu E_i + lambda tr E),  E_i = (l_i^2 - 1) / 2
    corotated    P_i = 2 mu (l_i - 1) + lambda tr(U - I);   linear: the same without rotation

Uniaxial: P_t = 0 gives lt. The formulas are written from the principal stretches and share no code with the program.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.optimize import brentq

Values = npt.NDArray[np.float64]


def principal_stress(material: dict[str, Any], l1: float, lt: float) -> tuple[float, float]:
    """Principal stresses (P_1, P_t) in Pa."""
    young, nu = material["young"], material["poisson"]
    mu, lmbda = young / (2 * (1 + nu)), young * nu / ((1 + nu) * (1 - 2 * nu))
    stretches = np.array([l1, lt, lt])
    if material["energy"] == "neo-hookean":
        m, volumetric = 4 / 3 * mu, lmbda + 5 / 6 * mu
        alpha, trace = 1 + 3 / 4 * m / volumetric, float(stretches @ stretches)
        cofactors = np.array([lt * lt, l1 * lt, l1 * lt])
        P = m * (1 - 1 / (trace + 1)) * stretches + volumetric * (l1 * lt * lt - alpha) * cofactors
    elif material["energy"] == "stvk":
        E = (stretches**2 - 1) / 2
        P = stretches * (2 * mu * E + lmbda * E.sum())
    else:
        P = 2 * mu * (stretches - 1) + lmbda * (stretches - 1).sum()
    return float(P[0]), float(P[1])


def lateral_stretch(material: dict[str, Any], l1: float) -> float:
    """Lateral stretch lt of the uniaxial state, P_t = 0.

    Raises:
        ValueError: no positive solution exists.
    """
    least = 1e-6 * min(1.0, l1**-0.5)
    most = 2 * max(1.0, l1**-0.5)
    return float(brentq(lambda lt: principal_stress(material, l1, lt)[1], least, most, xtol=1e-15, rtol=1e-14))


def stretch_error(study: dict[str, Any], rows: dict[str, Values]) -> dict[str, float]:
    """Relative error of the pulling force before the first break, and error of the break in steps.

    The force error is divided by the largest force. The study is one of `stability_studies.stretched_block`. Empty if
    no lateral stretch solves P_t = 0.
    """
    sides, material, right = study["mesh"]["size"], study["material"], study["boundary"][-1]["displacement"]
    free = all(entry["on"] != "top" for entry in study["boundary"])
    shift = np.interp(rows["time"], right["time"], [value[0] for value in right["value"]])
    stretches = 1 + shift / sides[0]
    try:
        lateral = np.array([lateral_stretch(material, l1) if free else 1.0 for l1 in stretches])
    except ValueError:
        return {}  # no such body: there is nothing to be near to
    P = np.array([principal_stress(material, *pair)[0] for pair in zip(stretches, lateral, strict=True)])
    true = P if material["energy"] == "linear" else P / lateral**2
    strength = study.get("fracture", {}).get("strength", np.inf)
    breaks = int(np.argmax(true >= strength)) if (true >= strength).any() else len(true)
    broke = int(np.argmax(rows["broken_edges"] > 0)) if rows["broken_edges"].any() else len(true)
    whole = slice(0, min(breaks, broke) + 1)
    difference = rows["reaction_pull_x"][whole] - (P * sides[1] * sides[2])[whole]
    largest = np.abs(P[whole]).max() * sides[1] * sides[2]
    error = float(np.abs(difference[: max(1, breaks)]).max() / largest) if breaks else 0.0
    return {"error": error, "break_off_by": abs(broke - breaks) if np.isfinite(strength) else 0}
