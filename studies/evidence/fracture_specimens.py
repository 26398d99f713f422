"""Specimens that are loaded slowly until they break: notched plate, notched beam, compact tension, concrete beam.

Each function returns the study of a specimen without a law of its own for the report: tests use them, too. Outlines are
written into a folder that the caller names. The first step leads to a share of the load at which the specimen breaks,
up to which it is linear; the other steps are equal.
"""

from __future__ import annotations

import tomllib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from .. import folder as packaged

Study = dict[str, Any]
LOAD_OUTPUT: dict[str, Any] = {"every": 1_000_000, "fields": [], "surface": False, "picture": False}


@dataclass(frozen=True)
class Course:
    """Displacement of the load over the time of a study, from 0 to 1.

    Attributes:
        travel: displacement at the end, m.
        start: displacement after the first step, over `travel`.
        step: of the further steps, over `travel`.
        drop: share of the peak load at whose loss the run ends.
    """

    travel: float
    start: float
    step: float
    drop: float = 0.5

    @property
    def time_table(self) -> dict[str, Any]:
        """Table [time] of a quasi-static study."""
        steps = {"time": [0.0, self.start], "value": [self.start, self.step]}
        return {"scheme": "quasi-static", "step": steps, "end": 1.0, "until": {"drop": self.drop}}

    def displacement(self, *direction: float | str) -> dict[str, Any]:
        """Prescribed displacement along a direction; "free" components stay free."""
        end = [part if isinstance(part, str) else part * self.travel for part in direction]
        start = [part if isinstance(part, str) else 0.0 for part in direction]
        return {"time": [0.0, 1.0], "value": [start, end]}


def node_box(x: float, y: float, size: float = 1e-7) -> dict[str, Any]:
    """Selector of the node at a point, m."""
    return {"box": [[x - size, y - size], [x + size, y + size]]}


def write_outline(path: Path, *polygons: list[tuple[float, float, str]]) -> str:
    """Write polygons of corners (x, y, group of the side that begins there) as an outline file; return its path."""
    blocks = ("\n".join(f"{x!r}, {y!r}, {group}".rstrip(", ") for x, y, group in polygon) for polygon in polygons)
    path.write_text("\n\n".join(blocks) + "\n", encoding="utf-8")
    return str(path)


# --- notched plate ---------------------------------------------------------------------------------------------------

PLATE_SIDE = 1e-3  # m
PLATE_COURSES = {  # by load: direction of the grip, and its course
    "tension": ((0.0, 1.0), Course(6.5e-6, 0.55, 0.01)),
    "shear": ((1.0, 0.0), Course(1.5e-5, 0.42, 0.01)),
    "held-shear": ((1.0, 0.0), Course(1.5e-5, 0.42, 0.01)),
}


def notched_plate(load: str, mesh: Study, course: Course | None = None) -> Study:
    """Single-edge notched plate (Miehe et al. 2010), from the packaged study of the plate in shear.

    Args:
        load: "tension", "shear" (the sides are free), or "held-shear" (the sides keep their height).
        mesh: keys of [mesh] that change: h, order, seed, pattern.
        course: of the grip; None for that of PLATE_COURSES.
    """
    study = tomllib.loads((packaged() / "notched-shear.toml").read_text(encoding="utf-8"))
    direction, usual = PLATE_COURSES[load]
    course = course or usual
    study["mesh"] |= mesh
    if study["mesh"]["pattern"] == "structured":  # above the row of nodes in the middle: a node at a tip is a hinge
        middle = PLATE_SIDE / 2 + study["mesh"]["h"] / 2
        study["crack"] = [{"segment": [[-PLATE_SIDE / 10, middle], [PLATE_SIDE / 2, middle]]}]
    study["boundary"][1]["displacement"] = course.displacement(*direction)
    if load == "held-shear":
        study["boundary"] += [{"on": side, "fix": "y"} for side in ("left", "right")]
    return study | {"time": course.time_table, "output": LOAD_OUTPUT}


# --- notched beam ----------------------------------------------------------------------------------------------------

V_BEAM_MATERIAL = {
    "energy": "linear", "plane": "strain", "thickness": 1e-3, "young": 20.8e9, "poisson": 0.3, "density": 2400.0,
}  # fmt: skip
V_BEAM_ENERGY = 500.0  # J/m^2
V_BEAM_COURSE = Course(1e-4, 0.38, 0.005, 0.3)


def notched_beam(folder: Path, h: float, seed: int, strength: float, *, order: int = 1) -> Study:
    """Beam of 8 x 2 mm with a V notch of 0.4 x 0.4 mm cut out of it, bent in plane strain over three points.

    The load moves by 1e-4 m in 1 s. The study has no [time]: the caller gives it.
    """
    sides = [(-4.0, 0.0, ""), (-0.2, 0.0, ""), (0.0, 0.4, ""), (0.2, 0.0, ""), (4.0, 0.0, ""), (4.0, 2.0, ""),
             (0.05, 2.0, "load"), (-0.05, 2.0, ""), (-4.0, 2.0, "")]  # fmt: skip
    return {
        "title": "A beam with a V notch cut out of it, bent",
        "mesh": {"outline": write_outline(folder / "beam.csv", sides), "scale": 1e-3, "h": h, "seed": seed,
                 "order": order},
        "material": V_BEAM_MATERIAL,
        "fracture": {"strength": strength, "energy": V_BEAM_ENERGY},
        "boundary": [{"on": node_box(-4e-3, 0.0), "fix": "xy"}, {"on": node_box(4e-3, 0.0), "fix": "y"},
                     {"on": "load", "displacement": V_BEAM_COURSE.displacement("free", -1.0)}],
        "probe": [{"name": "load", "on": "load"}],
        "output": LOAD_OUTPUT,
    }  # fmt: skip


# --- compact tension -------------------------------------------------------------------------------------------------

COMPACT_WIDTH, COMPACT_THICKNESS, COMPACT_CRACK = 0.05, 0.025, 0.5  # W and B, m; a / W
STEEL = {"young": 210e9, "poisson": 0.3, "density": 7850.0}
STEEL_ENERGY = 2700.0  # J/m^2
HOLE_SIDES = 24


def compact_tension(folder: Path, h: float, seed: int, course: Course, *, order: int = 1) -> Study:
    """Compact tension specimen (ASTM E399): 1.25 W by 1.2 W, holes of 0.25 W at 0.275 W from the crack, plane strain.

    A pin pulls at the outermost point of either hole. The load line is x = 0.
    """
    W = COMPACT_WIDTH
    outer = [(-0.25 * W, -0.6 * W, ""), (W, -0.6 * W, ""), (W, 0.6 * W, ""), (-0.25 * W, 0.6 * W, "")]
    angle = 2 * np.pi * np.arange(HOLE_SIDES) / HOLE_SIDES + np.pi / 2
    holes = [
        [(float(x), float(y), "") for x, y in zip(0.125 * W * np.cos(angle), at + 0.125 * W * np.sin(angle),
                                                  strict=True)]
        for at in (0.275 * W, -0.275 * W)
    ]  # fmt: skip
    upper, lower = (node_box(0.0, side * 0.4 * W, 1e-5 * W) for side in (1, -1))
    return {
        "title": "A compact tension specimen",
        "mesh": {"outline": write_outline(folder / "compact.csv", outer, *holes), "h": h, "seed": seed, "order": order},
        "material": {"energy": "linear", "plane": "strain", "thickness": COMPACT_THICKNESS} | STEEL,
        "fracture": {"strength": 2e10, "energy": STEEL_ENERGY},
        "crack": [{"segment": [[-0.3 * W, 0.0], [COMPACT_CRACK * W, 0.0]]}],
        "boundary": [{"on": lower, "fix": "xy"}, {"on": upper, "displacement": course.displacement(0.0, 1.0)}],
        "probe": [{"name": "pin", "on": upper}],
        "time": course.time_table,
        "output": LOAD_OUTPUT,
    }


def compact_tension_load() -> float:
    """Load (N) at which the crack starts: P = K_c B sqrt(W) / f(a / W), K_c = sqrt(E G_c / (1 - nu^2)) (ASTM E399).

    f is Srawley's (1976) polynomial, within 0.5 % for a / W from 0.2 to 1.
    """
    a = COMPACT_CRACK
    shape = (2 + a) * (0.886 + 4.64 * a - 13.32 * a**2 + 14.72 * a**3 - 5.6 * a**4) / (1 - a) ** 1.5
    toughness = np.sqrt(STEEL["young"] * STEEL_ENERGY / (1 - STEEL["poisson"] ** 2))
    return float(toughness * COMPACT_THICKNESS * np.sqrt(COMPACT_WIDTH) / shape)
