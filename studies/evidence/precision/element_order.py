"""Linear and quadratic elements in one case: stress of quadratic cells, and cost of an error of 1 %."""

from __future__ import annotations

from statistics import median
from typing import Any

import numpy as np

from ..report_section import Claim
from ..run_results import Values
from .case_section import Records

MAX_TIME_SHARE = 0.2  # of the time of linear cells that quadratic ones may take
ERROR_LIMIT = 0.01

CORNERS = np.eye(3)
EDGE_MIDPOINTS = np.array([[0.5, 0.0, 0.5], [0.5, 0.5, 0.0], [0.0, 0.5, 0.5]])  # of the edges 20, 01, 12
_EDGE_ENDS = [(0, 1), (1, 2), (2, 0)]  # of the middles of a cell, as files have them


def plane_stress(frame: dict[str, Any], young: float, poisson: float, at: Values) -> Values:
    """Plane stress (cells, n, 3) sigma_xx, sigma_yy, sigma_xy in Pa at barycentric points (n, 3) of cells of 6 nodes.

    From the displacement of a frame by Hooke's law.
    """
    cells = frame["cells"]
    slopes = np.stack([_shape_derivatives(point) for point in at])  # (n, 6, 2)
    X, u = (frame[name][cells][:, :, :2] for name in ("points", "displacement"))
    jacobian = np.einsum("cai,naj->cnij", X, slopes)
    gradient = np.einsum("cai,naj->cnij", u, slopes) @ np.linalg.inv(jacobian)
    xx, yy, xy = gradient[..., 0, 0], gradient[..., 1, 1], (gradient[..., 0, 1] + gradient[..., 1, 0]) / 2
    stiff = young / (1 - poisson**2)
    return np.stack([stiff * (xx + poisson * yy), stiff * (yy + poisson * xx), stiff * (1 - poisson) * xy], axis=-1)


def _shape_derivatives(point: Values) -> Values:
    """Derivatives (6, 2) of the shape functions l_i (2 l_i - 1) and 4 l_i l_j by l_1 and l_2."""
    of_corners = (4 * point - 1)[:, None] * CORNERS
    of_middles = [4 * (point[i] * CORNERS[j] + point[j] * CORNERS[i]) for i, j in _EDGE_ENDS]
    with_all = np.vstack([of_corners, of_middles])
    return np.asarray(with_all[:, 1:] - with_all[:, :1])


def order_claim(records: Records, errors: dict[str, dict[str, float]], key: str) -> Claim:
    """Claim that order 2 reaches an error of 1 % in a fifth of the processor seconds of order 1."""
    text = f"order 2 takes at most {MAX_TIME_SHARE:g} of order 1's core-seconds for {ERROR_LIMIT:.0%} of {key}"
    cheapest: dict[int, tuple[float, str]] = {}
    for record in records:
        order, error = record["settings"].get("order"), errors.get(record["name"], {}).get(key)
        if order is None or error is None or error > ERROR_LIMIT or not record["cpu"] or record["ranks"] != 1:
            continue
        cost = median(record["cpu"]), str(record["name"])
        cheapest[order] = min(cheapest.get(order, cost), cost)
    if len(cheapest) < 2:
        return Claim(text, "no run of one of them is that good", None)
    (linear, first), (quadratic, second) = cheapest[1], cheapest[2]
    measured = f"{quadratic / linear:.2g} ({second}: {quadratic:.3g} s; {first}: {linear:.3g} s)"
    return Claim(text, measured, quadratic <= MAX_TIME_SHARE * linear)
