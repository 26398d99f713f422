"""Peak loads of specimens that are loaded slowly, beside sharp cracks, a critical distance, a handbook and springs."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from ..cohesive_beam import beam_study, springs_peak
from ..fracture_specimens import (
    PLATE_COURSES,
    V_BEAM_COURSE,
    Course,
    compact_tension,
    compact_tension_load,
    notched_beam,
    notched_plate,
)
from ..peers import phase_field
from ..run_results import history
from .fracture_case import SEEDS, Figures, FractureCase, run_in, worst_of
from .precision_trials import Settings, Study

ERROR = "peak load"
BEAM_STRENGTH = 2e8  # Pa


@dataclass(frozen=True)
class PeakLoad:
    """Peak load of a specimen on random meshes.

    Attributes:
        study: settings, seed, folder -> study.
        column: of history.csv; "onset" is the load before edges break in a step.
        reference: N.
        turns: the crack kinks, and its direction is measured.
    """

    study: Callable[[Settings, int, Path], Study]
    column: str
    reference: Callable[[], float]
    turns: bool = False

    def __call__(self, settings: Settings, folder: Path) -> Figures:
        """Largest error of the peak load over the meshes, its range (N), and the median time of the steps (s)."""
        seeds = SEEDS[:1] if settings.get("mesh") == "lattice" else SEEDS
        runs = []
        for seed in seeds:
            out, seconds = run_in(self.study(settings, seed, folder), folder)
            rows = history(out)
            load = np.abs(rows[self.column])
            if load[-1] == load[0]:
                raise ValueError("the load does not change: nothing was loaded")
            peak = float(load.max())
            runs.append({ERROR: abs(peak / self.reference() - 1), "peak": peak, "seconds": seconds})
            if self.turns:
                tip = np.column_stack([rows["tip_x"], rows["tip_y"]])
                runs[-1]["direction"] = phase_field.crack_direction(tip - tip[0])
        peaks = [figures["peak"] for figures in runs]
        return worst_of(runs, (ERROR,)) | {"least": min(peaks), "largest": max(peaks)}


def _plate(load: str) -> Callable[[Settings, int, Path], Study]:
    """Study of the notched plate under a load, by settings and seed."""
    _, usual = PLATE_COURSES[load]

    def study(settings: Settings, seed: int, folder: Path) -> Study:
        course = replace(usual, step=float(settings["step"]))
        lattice = settings.get("mesh") == "lattice"
        points: Study = {"pattern": "structured"} if lattice else {"seed": seed}
        return notched_plate(load, {"h": settings["h"], "order": settings["order"]} | points, course)

    return study


def _v_beam(settings: Settings, seed: int, folder: Path) -> Study:
    """Study of the beam with a V notch."""
    course = replace(V_BEAM_COURSE, step=float(settings["step"]))
    study = notched_beam(folder, float(settings["h"]), seed, BEAM_STRENGTH, order=int(settings["order"]))
    return study | {"time": course.time_table}


def _compact(settings: Settings, seed: int, folder: Path) -> Study:
    """Study of the compact tension specimen."""
    course = Course(2e-4, 0.35, float(settings["step"]), 0.2)
    return compact_tension(folder, float(settings["h"]), seed, course, order=int(settings["order"]))


def _concrete(settings: Settings, seed: int, folder: Path) -> Study:
    """Study of the half-notched beam of concrete, up to its peak."""
    study = beam_study(folder, float(settings["cells"]), seed, 3e-4, round(1 / float(settings["step"])), notch=True)
    time = study["time"] | {"until": {"drop": 0.05}}
    return study | {"time": time}


def _meshes(sizes: dict[int, tuple[float, ...]], step: float, **others: float | str) -> tuple[Settings, ...]:
    """Settings of some sizes by order."""
    return tuple({"h": h, "order": order, "step": step, **others} for order, all_h in sizes.items() for h in all_h)


PLATE_TEXT = (
    "Steel plate of 1 x 1 mm, notched to its centre (Miehe et al. 2010), 2.7 kJ/m2, plane strain, 1 mm thick. "
    "Reference: {load} N of a sharp crack on quadratic elements with quarter points, whose K is within 0.3 % of closed "
    "forms. {how} Steps are shares of the last displacement; the first one leads to {start:.0%} of it. Errors are the "
    "largest of three random meshes, or that of the lattice. PhaseFieldX (AT2, {split}length scale of two cells) has "
    "the same plate, load and steps on the lattice with a slit along a row of nodes, and ends at the same loss of load."
)


def _plate_case(load: str, title: str, reference: float, how: str, split: str) -> FractureCase:
    """Case of the notched plate under a load."""
    lattice = _meshes({1: (2.5e-5, 1.25e-5)}, 0.01, mesh="lattice")
    others = (*_meshes({2: (4e-5,)}, 0.01, mesh="random"), *_meshes({1: (3e-5,)}, 0.005, mesh="random"))
    text = PLATE_TEXT.format(load=reference, how=how, start=PLATE_COURSES[load][1].start, split=split)
    return FractureCase(
        f"notched-{load}", title, text, PeakLoad(_plate(load), f"onset_grip_{'y' if load == 'tension' else 'x'}",
                                                 lambda: reference, load != "tension"), (ERROR,),
        short=(*_meshes({1: (4e-5, 3e-5)}, 0.01, mesh="random"), *lattice, *(others if load == "tension" else ())),
        full=_meshes({1: (2e-5, 1.25e-5), 2: (3e-5, 2e-5)}, 0.01, mesh="random"),
        peers=partial(phase_field.trials, f"notched-{load}", load, reference, {2.5e-5: False, 1.25e-5: True}),
        figures=("peak", "least", "largest", *(("direction",) if load != "tension" else ())), limit=600.0,
    )  # fmt: skip


CASES = (
    _plate_case("tension", "Notched plate in tension: peak load", 644.9, "The grip does not move sideways.", ""),
    _plate_case("shear", "Notched plate in shear, sides free: peak load", 388.7,
                "The crack kinks by 75.8 degrees; its direction 0.08 to 0.25 mm from the notch is 70 degrees.",
                "energy split by principal strains, hybrid, "),
    _plate_case("held-shear", "Notched plate in shear, sides held: peak load", 490.0,
                "The sides keep their height. The crack starts at 487.8 N.",
                "energy split by principal strains, hybrid, "),
    FractureCase(
        "notched-beam", "Beam with a V notch: peak load",
        "Beam of 8 x 2 mm with a V notch of 0.4 x 0.4 mm cut out of it, bent in plane strain (E 20.8 GPa, 500 J/m2, "
        "strength 200 MPa). Reference: 35.5 N by the critical distance (line method) on quadratic elements; by the "
        "mean over a half disc it is 35.1 N. Errors are the largest of three random meshes. PhaseFieldX (AT2, energy "
        "split by principal strains, hybrid, length scale of two cells) has the first mesh, the same load and "
        "steps; its phase is held at 0 around the supports and the load.",
        PeakLoad(_v_beam, "onset_load_y", lambda: 35.5), (ERROR,),
        short=(*_meshes({1: (1e-4, 7e-5, 5e-5)}, 0.005),),
        full=_meshes({1: (3e-5,), 2: (1e-4, 7e-5, 5e-5)}, 0.005), figures=("peak", "least", "largest"),
        peers=partial(phase_field.trials, "notched-beam", "beam", 35.5, {7e-5: False, 5e-5: True}),
    ),
    FractureCase(
        "compact-tension", "Compact tension: load at which the crack starts",
        f"Steel specimen of W = 50 mm, B = 25 mm, a = W / 2, with holes, pulled at two points, 2.7 kJ/m2. Reference: "
        f"{compact_tension_load():.0f} N by the stress intensity of ASTM E399 (Srawley 1976), within 0.5 %. Errors "
        "are the largest of three random meshes.",
        PeakLoad(_compact, "onset_pin_y", compact_tension_load), (ERROR,),
        short=(*_meshes({1: (2.5e-3, 1.67e-3, 1.25e-3), 2: (2.5e-3, 1.67e-3)}, 0.005),),
        full=_meshes({1: (8e-4,), 2: (1.25e-3,)}, 0.005), figures=("peak", "least", "largest"),
    ),
    FractureCase(
        "concrete-beam", "Half-notched beam of concrete, cohesive: peak load",
        "Beam of 50 mm depth and 125 mm span, notched to its middle (E 37 GPa, strength 3.9 MPa, 143.2 J/m2, "
        "exponential softening). Reference: the same law on springs along the ligament of an elastic beam of 80 rows "
        "of squares (NumPy and SciPy alone). Another solution by elements and springs gives 1236 to 1247 N. `cells`: "
        "ligament over h. Errors are the largest of three random meshes.",
        PeakLoad(_concrete, "reaction_load_y", springs_peak), (ERROR,),
        short=tuple({"cells": cells, "step": step} for cells, step in ((5.0, 0.01), (8.0, 0.01))),
        full=({"cells": 12.5, "step": 0.01}, {"cells": 8.0, "step": 0.005}, {"cells": 20.0, "step": 0.01}),
        split="step", figures=("peak", "least", "largest"), limit=600.0,
    ),
)  # fmt: skip
