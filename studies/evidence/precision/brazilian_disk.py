"""Brazilian disk of granite (M22: E 45 GPa, nu 0.33, rho 2750 kg/m^3, strength 9.56 MPa), plane stress.

Elastic: uniform pressure on two arcs of 10 degrees; mean stresses of cells around the centre against the closed form
over the same cells. Peak: two rigid, smooth platens of the same arcs approach each other; the force at which the crack
follows the diameter is compared with pi D t sigma_t / 2.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from ....output.fields_file import TENSOR_COMPONENTS
from ..closed_forms import brazilian_peak, disk_stress, hondros
from ..run_results import Values, history, last_frame
from ..trial import Trial
from .case_section import AccuracyCase, ExpectedOrder, Records, measured_errors
from .element_order import EDGE_MIDPOINTS, order_claim, plane_stress
from .precision_trials import MINIMAL_OUTPUT, Study, akantu_trials, study_trial

RADIUS, ARC = 0.025, 10.0  # m, degrees
GRANITE = {"energy": "linear", "plane": "stress", "young": 4.5e10, "poisson": 0.33, "density": 2750.0}
STRENGTH, PRESSURE, CLOSING = 9.56e6, 1e7, 1e-4  # Pa, Pa, m
CELLS_PER_RADIUS = (5, 8, 12, 16, 20, 32, 40, 64, 80)  # cells along the radius
QUADRATIC_CELLS_PER_RADIUS = (4, 6, 8, 12, 16, 20)  # with quadratic displacement
PEAK_PARTS = (8, 16, 24, 32)
AVERAGED = (16, 32)  # with an average over a tenth of the radius too
STEPS = 100


def _fixed_rim_nodes(*at: tuple[float, float, str]) -> list[dict[str, Any]]:
    """Conditions that fix single nodes on the rim, at multiples of the radius."""
    small = 1e-6 * RADIUS

    def around(x: float, y: float) -> dict[str, Any]:
        return {"box": [[RADIUS * x - small, RADIUS * y - small], [RADIUS * x + small, RADIUS * y + small]]}

    return [{"on": around(x, y), "fix": axes} for x, y, axes in at]


def _disk_mesh(parts: int, order: int = 1) -> dict[str, Any]:
    """Table [mesh] of the disk."""
    return {"builder": "disk", "radius": RADIUS, "h": RADIUS / parts, "arc": ARC, "order": order}


def pressed_disk(parts: int, order: int = 1) -> Study:
    """Study with pressure on both arcs; ends of the diameters are fixed as symmetry requires."""
    return {
        "title": "A disk between two pressures",
        "mesh": _disk_mesh(parts, order),
        "material": GRANITE,
        "boundary": [
            {"on": "top", "pressure": PRESSURE},
            {"on": "bottom", "pressure": PRESSURE},
            *_fixed_rim_nodes((0, 1, "x"), (0, -1, "x"), (1, 0, "y"), (-1, 0, "y")),
        ],
        "time": {"scheme": "quasi-static", "step": 1.0, "end": 1.0},
        "output": MINIMAL_OUTPUT | {"fields": ["stress"]},
    }


def split_disk(parts: int, radius: float) -> Study:
    """Study with approaching platens; `radius` of the non-local average in m, 0 for none."""
    closing = {"time": [0.0, 1.0], "value": [["free", 0.0], ["free", -CLOSING]]}
    return {
        "title": "A Brazilian disk split",
        "mesh": _disk_mesh(parts),
        "material": GRANITE,
        "fracture": {"strength": STRENGTH, "radius": radius, "passes": 5},
        "boundary": [
            {"on": "top", "displacement": closing},
            {"on": "bottom", "fix": "y"},
            *_fixed_rim_nodes((0, 1, "x"), (0, -1, "x")),
        ],
        "time": {"scheme": "quasi-static", "step": 1 / STEPS, "end": 1.0},
        "probe": [{"name": "platen", "on": "top"}],
        "output": MINIMAL_OUTPUT | {"fields": ["damage"], "surface": False},
    }


def trials() -> list[Trial]:
    """Trials over h for both studies; the peak with and without an average."""
    results = [
        study_trial(
            "disk",
            f"parts-{parts}",
            pressed_disk(parts),
            "brazilian_disk:measure_centre",
            {"h": RADIUS / parts, "order": 1},
        )
        for parts in CELLS_PER_RADIUS
    ]
    results += [
        study_trial("disk", f"order-2-parts-{parts}", pressed_disk(parts, 2), "brazilian_disk:measure_centre",
              {"h": RADIUS / parts, "order": 2})
        for parts in QUADRATIC_CELLS_PER_RADIUS
    ]  # fmt: skip
    for order, all_parts in ((1, CELLS_PER_RADIUS), (2, QUADRATIC_CELLS_PER_RADIUS)):
        for parts in all_parts:
            results += akantu_trials("disk", RADIUS / parts, order)
    runs = [(parts, 0.0) for parts in PEAK_PARTS] + [(parts, RADIUS / 10) for parts in AVERAGED]
    results += [
        study_trial("disk-peak", f"parts-{parts}-radius-{radius:g}", split_disk(parts, radius),
                    "brazilian_disk:measure_peak",
              {"h": RADIUS / parts, "radius": radius})
        for parts, radius in runs
    ]  # fmt: skip
    return results


def measure_centre(run: Path) -> dict[str, float]:
    """Relative errors of the mean stress near the centre, and of the stress in L2."""
    return centre_errors(last_frame(run))


def centre_errors(frame: dict[str, Any]) -> dict[str, float]:
    """Errors of `measure_centre` from a frame: points, cells, displacement, and the stress of linear cells."""
    corners = frame["points"][frame["cells"]][:, :3, :2]  # of 3 or 6 nodes
    if frame["cells"].shape[1] == 3:
        stress = frame["stress"][:, None, [TENSOR_COMPONENTS.index(name) for name in ("xx", "yy", "xy")]]
    else:
        stress = plane_stress(frame, GRANITE["young"], GRANITE["poisson"], EDGE_MIDPOINTS)  # type: ignore[arg-type]
    fourth, half = (_compare_near_centre(corners, stress, RADIUS * fraction) for fraction in (1 / 4, 1 / 2))
    (results, exact), (wide, wide_exact) = fourth[:2], half[:2]
    return {
        "sigma_x": abs(float(results[0] / exact[0]) - 1),
        "sigma_y": abs(float(results[1] / exact[1]) - 1),
        "centre": float(np.linalg.norm(results - exact) / np.linalg.norm(exact)),
        "mean stress": float(np.linalg.norm(wide - wide_exact) / np.linalg.norm(wide_exact)),
        "stress": half[2],
    }


def _compare_near_centre(corners: Values, stress: Values, radius: float) -> tuple[Values, Values, float]:
    """(mean stress, mean of the closed form, relative L2 error) of the cells within `radius` of the centre.

    `stress`: (cells, 1 or 3, 3) Pa, of the cell or at its edge midpoints. The rule with three points is exact for
    quadratic polynomials.
    """
    near = np.linalg.norm(corners.mean(axis=1), axis=1) < radius
    corners, stress = corners[near], stress[near]
    area = np.abs(np.linalg.det(corners[:, 1:] - corners[:, :1]))
    middles = (corners + np.roll(corners, 1, axis=1)) / 2  # of edges: exact for quadratics
    exact = disk_stress(
        middles[..., 0].ravel(), middles[..., 1].ravel(), RADIUS, np.radians(ARC / 2), PRESSURE
    ).reshape(-1, 3, 3)
    square = (((exact - stress) ** 2).sum(axis=1) @ [1, 1, 2], (exact**2).sum(axis=1) @ [1, 1, 2])
    weights = area / area.sum()
    return (
        weights @ stress.mean(axis=1),
        weights @ exact.mean(axis=1),
        float(np.sqrt(area @ square[0] / (area @ square[1]))),
    )


def measure_peak(run: Path) -> dict[str, float]:
    """Forces over pi D sigma_t / 2: at the first break, at the largest break, maximum, and fall from a maximum."""
    rows = history(run)
    force = np.abs(rows["reaction_platen_y"]) / brazilian_peak(2 * RADIUS, STRENGTH)
    burst = np.diff(rows["broken_edges"], prepend=0.0)
    if not burst.any():
        raise ValueError("nothing broke")
    crack = float(_force_at_break(force, int(burst.argmax())))
    return {
        "first break": float(_force_at_break(force, int(np.flatnonzero(burst)[0]))),
        "crack": crack,
        "crack load": abs(crack - 1),
        "burst": float(burst.max()),
        "greatest": float(force.max()),
        "fall": float((np.maximum.accumulate(force) - force).max()),
        "pieces": float(rows["pieces"][-1]),
    }


def _force_at_break(force: Values, step: int) -> float:
    """Larger of the forces at the end of a step and before it, since the break lowers the force."""
    return max(float(force[step]), float(force[step - 1]))


def _text(records: Records) -> str:
    """Text of the section on the stress."""
    x, y = hondros(np.zeros(1), RADIUS, np.radians(ARC / 2), 1.0)
    return (
        f"Hondros (1959) at the centre: sigma_x = {float(x[0]):.5f} p, sigma_y = {float(y[0]):.5f} p. Compared is the "
        "mean over the cells within a fourth of the radius (centre: both together). Theory: order 2 for a mean (fitted "
        "over the cells within half the radius, where there are enough of them), 1 for the stress itself in L2 there."
    )


def _peak_text(records: Records) -> str:
    """Text of the section on the peak."""
    forces = "; ".join(_forces(record) for record in records if record["figures"])
    return (
        f"Forces over pi D t sigma_t / 2: {forces}.\n\nNo theory gives an order: an edge feels all of the tension only "
        "where it lies along it, and the threefold compression across counts against it (10 degrees off: a tenth of "
        "the load more), so that a coarse mesh breaks late. The crack load is that of the step in which most edges "
        "broke. It is not a peak: a torn cell still carries the compression along the crack, and so the force goes on "
        "rising where a real disk falls apart. Where the greatest force is that of the last step, the disk did not "
        "split: a limit of the approach chi under tension with compression across."
    )


def _forces(record: dict[str, Any]) -> str:
    """Forces of a record as text."""
    figures = record["figures"]
    parts = ", ".join(f"{name} {figures[name]:.3f}" for name in ("first break", "crack", "greatest", "fall"))
    return f"{record['name']}: {parts}, {figures['pieces']:.0f} piece(s)"


FITTED_QUADRATIC_TRIALS = tuple(f"order-2-parts-{parts}" for parts in QUADRATIC_CELLS_PER_RADIUS)
_ERRORS = measured_errors("stress")
FITTED_TRIALS = tuple(f"parts-{parts}" for parts in CELLS_PER_RADIUS)
CASES = [
    AccuracyCase("disk", "Brazilian disk: stress at the centre", _text, ("h", "order"),
         measured_errors("centre", "sigma_x", "sigma_y", "mean stress", "stress"),
         ("centre", "sigma_x", "sigma_y", "mean stress", "stress"),
         (ExpectedOrder("mean stress", "h", 2.0, FITTED_TRIALS), ExpectedOrder("stress", "h", 1.0, FITTED_TRIALS, "L2"),
          ExpectedOrder("stress", "h", 2.0, FITTED_QUADRATIC_TRIALS, "L2, quadratic cells:")),
         split="order", claims=lambda records: (order_claim(records, _ERRORS(records), "stress"),)),
    AccuracyCase("disk-peak", "Brazilian disk: peak load", _peak_text, ("h", "radius"), measured_errors("crack load"),
         ("crack load",),
         split="radius"),
]  # fmt: skip
