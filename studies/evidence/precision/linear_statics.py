"""Linear statics: a cantilever under a force at its end, and a pulled plate with a hole.

Reference: quadratic elements with separate forms (quadratic_reference.py). Their difference between two meshes
measures convergence. Beam theory and Howland's series are shown for comparison: they solve other equations.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from ..closed_forms import howland_factor, timoshenko_deflection
from ..run_results import history, last_frame
from ..trial import Trial
from .case_section import AccuracyCase, ExpectedOrder, Records, relative_error
from .element_order import CORNERS, order_claim, plane_stress
from .precision_trials import MINIMAL_OUTPUT, Study, akantu_trials, script_trial, study_trial

LENGTH, DEPTH, YOUNG, POISSON, TRACTION = 1.0, 0.1, 210e9, 0.3, 1e5  # m, m, Pa, -, Pa
SIDE, RADIUS, PULL = 0.05, 0.01, 1e6  # m, m, Pa: quarter plate
STEEL = {"young": YOUNG, "poisson": POISSON, "density": 7850.0}
ONE_STEP = {"scheme": "quasi-static", "step": 1.0, "end": 1.0}

REFERENCE_SIZES = {"cantilever": (0.05, 0.025, 0.0125), "plate": (0.002, 0.001, 0.0005)}  # last: long report
SIZES = {
    "cantilever": (0.025, 0.0125, 0.01, 0.00625, 0.0045, 0.004),
    "plate": (0.008, 0.006, 0.004, 0.003, 0.002, 0.0015, 0.001, 0.00075),
}
# with quadratic displacement
QUADRATIC_SIZES = {"cantilever": (0.1, 0.05, 0.033), "plate": (0.012, 0.01, 0.008, 0.006, 0.004, 0.003, 0.002)}
LONG_REPORT_SIZES = {"cantilever": 0.004, "plate": 0.00075}  # this size is for the long report


def cantilever(h: float, energy: str = "linear", order: int = 1) -> Study:
    """Study of 1 x 0.1 x 0.1 m of steel, clamped at x = 0, with a shear traction on its end."""
    return {
        "title": "A cantilever under a force at its end",
        "mesh": {"builder": "box", "size": [LENGTH, DEPTH, DEPTH], "h": h, "order": order},
        "material": STEEL | {"energy": energy},
        "boundary": [{"on": "left", "fix": "xyz"}, {"on": "right", "traction": [0.0, 0.0, -TRACTION]}],
        "time": ONE_STEP,
        "output": MINIMAL_OUTPUT,
    }


def plate(h: float, order: int = 1) -> Study:
    """Study of a quarter of a 0.1 x 0.1 m plate with a hole of 0.02 m in plane stress, pulled along x."""
    return {
        "title": "A plate with a hole",
        "mesh": {"builder": "plate-hole", "length": SIDE, "height": SIDE, "radius": RADIUS, "h": h, "order": order},
        "material": STEEL | {"energy": "linear", "plane": "stress"},
        "boundary": [
            {"on": "left", "fix": "x"},
            {"on": "bottom", "fix": "y"},
            {"on": "right", "traction": [PULL, 0.0]},
        ],
        "time": ONE_STEP,
        "output": MINIMAL_OUTPUT | {"fields": ["stress"]},
    }


STUDIES: dict[str, Callable[..., Study]] = {"cantilever": cantilever, "plate": plate}


def trials() -> list[Trial]:
    """Trials of both cases over h; the cantilever also with all energies and on two ranks."""
    results = [
        study_trial(
            case,
            f"h-{h:g}",
            STUDIES[case](h),
            f"linear_statics:measure_{case}",
            _settings(h),
            full=h == LONG_REPORT_SIZES[case],
        )
        for case, sizes in SIZES.items()
        for h in sizes
    ]
    results += [
        study_trial(
            case, f"order-2-h-{h:g}", STUDIES[case](h, order=2), f"linear_statics:measure_{case}", _settings(h, order=2)
        )
        for case, sizes in QUADRATIC_SIZES.items()
        for h in sizes
    ]
    results += [
        study_trial("cantilever", f"{energy}-h-0.0125", cantilever(0.0125, energy), "linear_statics:measure_cantilever",
              _settings(0.0125, energy))
        for energy in ("corotated", "stvk", "neo-hookean")
    ]  # fmt: skip
    results.append(
        study_trial("cantilever", "h-0.00625-ranks-2", cantilever(0.00625), "linear_statics:measure_cantilever",
              _settings(0.00625), ranks=2)
    )  # fmt: skip
    results += [
        script_trial(case, f"quadratic-h-{h:g}", "quadratic_reference", {"case": case, "h": h},
               {"h": h, "elements": "quadratic"}, full=h == sizes[-1])
        for case, sizes in REFERENCE_SIZES.items()
        for h in sizes
    ]  # fmt: skip
    for order, of_cases in ((1, SIZES), (2, QUADRATIC_SIZES)):
        for case, sizes in of_cases.items():
            for h in sizes:
                results += akantu_trials(case, h, order, full=order == 1 and case == "cantilever" and h < 0.01)
    return results


def _settings(h: float, energy: str = "linear", order: int = 1) -> dict[str, str | float | int | bool]:
    """Settings of a trial."""
    return {"h": h, "energy": energy, "order": order}


def measure_cantilever(run: Path) -> dict[str, float]:
    """Deflection of the end, m, from the work of a force that grows from 0: half of force times deflection."""
    return {"deflection": float(2 * history(run)["external_work"][-1] / (TRACTION * DEPTH**2))}


def measure_plate(run: Path) -> dict[str, float]:
    """Mean displacement of the pulled edge, m, and largest sigma_xx over the traction."""
    frame = last_frame(run)
    stress = frame["stress"][:, 0]
    if frame["cells"].shape[1] == 6:  # the field has means over cells, which are larger
        stress = plane_stress(frame, YOUNG, POISSON, CORNERS)[..., 0]
    work = 2 * history(run)["external_work"][-1]  # of a load that is put on from nothing
    return {"deflection": float(work / (PULL * SIDE)), "peak": float(stress.max() / PULL)}


def _references(records: Records, key: str) -> list[tuple[float, float]]:
    """(h, figure) of the runs with quadratic elements, the finest last."""
    results = [
        record for record in records if record["settings"].get("elements") == "quadratic" and key in record["figures"]
    ]
    if len(results) < 2:
        raise KeyError(f"{key} with quadratic elements on two meshes")
    return sorted(((record["settings"]["h"], record["figures"][key]) for record in results), reverse=True)


def _converged_value(records: Records, key: str) -> float:
    """Figure of the finest reference."""
    return _references(records, key)[-1][1]


def _convergence_text(records: Records, key: str) -> str:
    """Reference and its change over the last refinement, as text."""
    (coarse, before), (fine, value) = _references(records, key)[-2:]
    return (
        f"{value:.6g}, which moves by {relative_error(before, value):.1e} of itself from h = {coarse:g} to {fine:g} m"
    )


def _cantilever_errors(records: Records) -> dict[str, dict[str, float]]:
    """Relative error of the deflection by trial."""
    exact = _converged_value(records, "deflection")
    measured = {record["name"]: record["figures"]["deflection"] for record in records if record["figures"]}
    return {name: {"deflection": relative_error(value, exact)} for name, value in measured.items()}


def _plate_errors(records: Records) -> dict[str, dict[str, float]]:
    """Errors by trial; the squared energy-norm error of the stress is a(u, u) - a(u_h, u_h)."""
    exact, peak = (_converged_value(records, key) for key in ("deflection", "peak"))
    results = {}
    for record in records:
        if figures := record["figures"]:
            missing = relative_error(figures["deflection"], exact)
            results[record["name"]] = {"stress": missing**0.5, "edge displacement": missing}
            if "peak" in figures:
                results[record["name"]]["peak stress"] = relative_error(figures["peak"], peak)
    return results


def _cantilever_text(records: Records) -> str:
    """Text of the section on the cantilever."""
    beam = timoshenko_deflection(TRACTION * DEPTH**2, LENGTH, DEPTH, DEPTH, YOUNG, POISSON)
    return (
        f"Reference: quadratic elements, {_convergence_text(records, 'deflection')}. Timoshenko's beam, "
        f"{beam:.6g} m, lies "
        f"{relative_error(beam, _converged_value(records, 'deflection')):.2%} from it: its clamp lets the "
        f"section contract and "
        "warp. Theory: order 2 (the energy of linear elements; the singular edges of the clamp, order 1.4 for "
        "nu = 0.3, take over only later)."
    )


def _plate_text(records: Records) -> str:
    """Text of the section on the plate."""
    strip, peak = howland_factor(RADIUS / SIDE), _converged_value(records, "peak")
    return (
        f"Reference: quadratic elements, peak stress over traction {_convergence_text(records, 'peak')}; "
        f"Howland's long strip has "
        f"{strip:.4f}, {relative_error(strip, peak):.1%} off: the plate is square. Stress: in the energy norm, "
        f"which the "
        "missing work of the load tells. Theory: order 1 for the stress, 2 for the displacement; with quadratic cells "
        "2 and 4. h is the size away from the hole, a fourth of it at the hole."
    )


FITTED_TRIALS = {
    case: tuple(f"h-{h:g}" for h in sizes[1:]) for case, sizes in SIZES.items()
}  # fitted: all but the coarsest
FITTED_QUADRATIC_TRIALS = tuple(
    f"order-2-h-{h:g}" for h in QUADRATIC_SIZES["plate"][2:]
)  # coarser ones do not shrink with h
CASES = [
    AccuracyCase(
        "cantilever", "Static cantilever", _cantilever_text, ("h", "energy", "order"), _cantilever_errors,
        ("deflection",), (ExpectedOrder("deflection", "h", 2.0, FITTED_TRIALS["cantilever"]),), split="order",
        claims=lambda records: (order_claim(records, _cantilever_errors(records), "deflection"),),
    ),
    AccuracyCase(
        "plate", "Plate with a hole", _plate_text, ("h", "order"), _plate_errors,
        ("stress", "edge displacement", "peak stress"),
        (
            ExpectedOrder("edge displacement", "h", 2.0, FITTED_TRIALS["plate"]),
            ExpectedOrder("stress", "h", 1.0, FITTED_TRIALS["plate"]),
            ExpectedOrder("stress", "h", 2.0, FITTED_QUADRATIC_TRIALS, "quadratic cells:"),
        ),
        split="order", claims=lambda records: (order_claim(records, _plate_errors(records), "stress"),),
    ),
]  # fmt: skip
