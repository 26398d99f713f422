"""Experiments of papers and handbooks: load, displacement and energy on three meshes, beside reference values."""

from __future__ import annotations

import tomllib
from copy import deepcopy
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from .. import folder as packaged
from . import diametral_cracks, published_results, run_results
from .mesh_dependence import crack_faces, relative_range
from .report_section import Claim, Picture, Plot, ReportTable, Section, Series, TableCell, record_folder
from .trial import Trial

GROUP = "experiments"
BRANCH_LENGTH, BRANCH_DISTANCE = 0.015, 4.0  # m over which branches are measured; their least distance in edges
FIRST_BRANCH_LENGTH = 0.003  # m over which the first branches are seen; the measured ones must start within it
Record = dict[str, Any]
Values = npt.NDArray[np.float64]
Changes = dict[str, Any]

NVE36: Changes = {
    "material": {"like": "steel NVE 36 at 23 C", "energy": "corotated"},
    "fracture": {"energy": False, "radius": 8e-4},
    "plasticity": {"update": "implicit"},
    "time": {"step": 1e-5, "breaking_step": 1e-5},
}


@dataclass(frozen=True)
class Experiment:
    """A packaged study on three meshes.

    Attributes:
        case: name of the case.
        study: name of the packaged study.
        sizes: (key of [mesh], values in m, the coarsest first).
        pushed: obstacle or grip whose force and displacement make the curve.
        axis: axis of that force.
        peak: reference load, N.
        source: origin of the reference.
        changes: tables of the study that change.
        within: admissible relative error; None if no claim is made.
    """

    case: str
    study: str
    sizes: tuple[str, tuple[float, ...]]
    pushed: str
    axis: str
    peak: float
    source: str
    changes: Changes
    within: float | None = None


TENSION: Changes = {
    "boundary": [
        {"on": "bottom", "fix": "xy"},
        {"on": "top", "displacement": {"time": [0.0, 1.0], "value": [[0.0, 0.0], [0.0, 8e-6]]}},
    ],
    "time": {"breaking_step": 0.001},  # a step of 0.01 is 1.8 % of the peak
}
PLATE_SIZES = ("h", (3e-5, 2e-5, 1.25e-5))
BAR_SIZES = ("h_notch", (4e-4, 3e-4, 2.2e-4))
EXPERIMENTS = (
    Experiment(
        "brazilian", "brazilian", ("h", (0.01, 0.008, 0.0065)), "upper", "y", 6.007e5, "pi D t f_t / 2", {}, within=0.1
    ),
    Experiment(
        "granite-cylinder", "granite-cylinder", ("h", (0.0125, 0.011, 0.01)), "upper", "y", 1.502e5, "pi D t f_t / 2",
        {}, within=0.1,
    ),
    Experiment(
        "charpy-A516", "charpy", BAR_SIZES, "striker", "y", 8.51e3, "static, sharp notch, ASTM E399", {}
    ),
    Experiment(
        "charpy-NVE36", "charpy", BAR_SIZES, "striker", "y", 1.93e3,
        "limit load in plane strain without hardening, 1.26 x 1.155 yield b^2 B / S (Green and Hundy 1956)",
        NVE36 | {"time": NVE36["time"] | {"end": 8e-4}},
    ),
    Experiment(
        "izod-A516", "izod", BAR_SIZES, "striker", "y", 3.63e3, "static, sharp notch in bending, K_c (Tada)", {}
    ),
    Experiment(
        "izod-NVE36", "izod", BAR_SIZES, "striker", "y", 8.8e2, "limit load, as of charpy-NVE36",
        NVE36 | {"time": NVE36["time"] | {"end": 1.2e-3, "step": 2e-5, "breaking_step": 2e-5}},
    ),
    Experiment(
        "charpy-klst", "charpy-klst", ("h_notch", (1.6e-4, 1.2e-4, 0.9e-4)), "striker", "y", 2.43e3,
        "measured: SRM 2216, NIST SP 260-180 (1.59 J absorbed)", {},
    ),
    Experiment(
        "notched-tension", "notched-shear", PLATE_SIZES, "grip", "y", 645.0,
        "Griffith, -u^2 k'(a) / 2 = G_c (Miehe et al. 2010's plate)", TENSION, within=0.03,
    ),
    Experiment(
        "notched-shear", "notched-shear", PLATE_SIZES, "grip", "x", 388.7,
        "sharp crack on quadratic elements, kink by 75.8 degrees", {}, within=0.07,
    ),
    Experiment(
        "l-panel", "l-panel", ("h_corner", (0.0125, 0.01, 0.008)), "seat", "y", 7.219e3,
        "measured: Winkler (2001), series A", {}, within=0.1,
    ),
    Experiment(
        "kalthoff", "kalthoff", ("h", (9.5e-4, 8.5e-4, 7.5e-4)), "", "", 0.0, "no load, but the angle below", {}
    ),
    Experiment(
        "branching", "branching", ("h", (5e-4, 4.5e-4, 4e-4)), "", "", 0.0, "no load, but the angles below", {}
    ),
)  # fmt: skip
BY_CASE = {item.case: item for item in EXPERIMENTS}


def trials() -> list[Trial]:
    """Trials of all experiments on their meshes."""
    return [_trial(experiment, h) for experiment in EXPERIMENTS for h in experiment.sizes[1]]


def experiment_study(experiment: Experiment, h: float) -> dict[str, Any]:
    """Packaged study with the changes of an experiment, on one of its meshes."""
    data = tomllib.loads((packaged() / f"{experiment.study}.toml").read_text(encoding="utf-8"))
    for table, values in deepcopy(experiment.changes).items():
        data[table] = values if isinstance(values, list) else data.get(table, {}) | values
    data["mesh"][experiment.sizes[0]] = h
    return data


def _trial(experiment: Experiment, h: float) -> Trial:
    """Trial of an experiment with cells of size h."""
    return Trial(
        GROUP, experiment.case, f"{h * 1e3:g}-mm", study=experiment_study(experiment, h), settings={"h": h},
        limit=600.0,
        measure=f"experiments:measure_{experiment.study.replace('-', '_')}",
    )  # fmt: skip


# --- measures --------------------------------------------------------------------------------------------------------


def measure_brazilian(run: Path) -> Record:
    """Load figures of the disk, and share of the loaded diameter with a crack within a tenth of the radius."""
    rows = run_results.history(run)
    size, centres = crack_faces(run)
    radius = float(run_results.study(run)["mesh"]["radius"])
    near = np.abs(centres[:, 0]) < 0.1 * radius
    bins = np.unique(np.floor(20 * (centres[near, 1] / radius + 1) / 2))
    return load_figures(rows, "upper", "y") | {"along": len(bins) / 20, "crack": float(size.sum() / 2)}


def measure_granite_cylinder(run: Path) -> Record:
    """Load figures of the cylinder, and position of its cracks."""
    rows = run_results.history(run)
    return load_figures(rows, "upper", "y") | diametral_cracks.measure_cracks(
        run, rows["time"], np.abs(rows["contact_upper_y"])
    )


def measure_charpy(run: Path) -> Record:
    """Load and crack figures of the bar."""
    return _measure_bar(run)


def measure_izod(run: Path) -> Record:
    """Load and crack figures of the bar."""
    return _measure_bar(run)


def measure_charpy_klst(run: Path) -> Record:
    """Load and crack figures of the bar."""
    return _measure_bar(run)


def measure_notched_shear(run: Path) -> Record:
    """Load figures of the plate, along the axis with the larger motion of the grip."""
    rows = run_results.history(run)
    displacement = {axis: float(np.abs(rows[f"motion_grip_{axis}"]).max()) for axis in "xy"}
    return load_figures(rows, "grip", max(displacement, key=displacement.__getitem__))


def measure_l_panel(run: Path) -> Record:
    """Load figures of the panel."""
    return load_figures(run_results.history(run), "seat", "y")


def measure_kalthoff(run: Path) -> Record:
    """Angle of the crack over the first 40 mm from its notch, degrees."""
    rows, (x, y) = run_results.history(run), run_results.study(run)["crack"][0]["segment"][1]
    apart = np.column_stack([rows["tip_x"] - x, rows["tip_y"] - y])
    far = np.flatnonzero(np.linalg.norm(apart, axis=1) >= 0.04)
    angle = float(np.degrees(np.arctan2(*apart[far[0], ::-1]))) if len(far) else None
    return {"angle": angle, "pieces": float(rows["pieces"][-1])}


def measure_branching(run: Path) -> Record:
    """Position and time of the final branching, angles of both branches (degrees), and crack speed over c_R.

    Angles are those over BRANCH_LENGTH. `first` is the position of the first branching; its branches may have arrested.
    """
    size, centres = crack_faces(run)
    (x0, y0), rows = run_results.study(run)["crack"][0]["segment"][1], run_results.history(run)
    places, apart = centres[:, :2] - [x0, y0], BRANCH_DISTANCE * float(np.median(size))
    outcome, first = branch_angles(places, apart), branch_angles(places, apart, FIRST_BRANCH_LENGTH)
    if outcome is None or first is None:
        return {"fork": None, "pieces": float(rows["pieces"][-1])}
    x, upper, lower = outcome
    on_its_way = np.flatnonzero(rows["tip_x"] > x0 + 1e-6)
    begun, there = rows["time"][on_its_way[0]], rows["time"][np.argmax(rows["tip_x"] >= x0 + x)]
    rayleigh = 2125.0  # m/s, of the glass in the study
    figures = {"first": x0 + first[0], "fork": x0 + x, "upper": upper, "lower": lower}
    figures |= {"begun": float(begun), "branched": float(there)}
    return figures | {"speed": x / float(there - begun) / rayleigh, "pieces": float(rows["pieces"][-1])}


def branch_angles(places: Values, apart: float, over: float = BRANCH_LENGTH) -> tuple[float, float, float] | None:
    """Position and angles (degrees) of the final branching of crack faces (n, 2) from a notch at 0 along x.

    Args:
        places: centres of crack faces, m.
        apart: distance at which the outermost faces count as branches, m.
        over: length over which that distance must persist, m.

    Returns:
        (x, upper angle, lower angle): least-squares lines through the outermost faces, and their intersection. None
        without branching.
    """
    every = np.arange(0.0, places[:, 0].max(), apart / 2)
    strips = [places[np.abs(places[:, 0] - x) < apart / 2, 1] for x in every]
    top, bottom = (np.array([end(strip) if len(strip) else np.nan for strip in strips]) for end in (np.max, np.min))
    wide = top - bottom > apart
    long = round(over / (apart / 2))
    starts = [k for k in range(len(every) - long) if wide[k : k + long].all()]
    if not starts:
        return None
    rows = slice(starts[0], starts[0] + long)
    (up, high), (down, low) = (np.polyfit(every[rows], side[rows], 1) for side in (top, bottom))
    return float((low - high) / (up - down)), float(np.degrees(np.arctan(up))), float(-np.degrees(np.arctan(down)))


def _measure_bar(run: Path) -> Record:
    """Load figures of a bar, and height of broken edges above the notch, m."""
    mesh = run_results.study(run)["mesh"]
    size, centres = crack_faces(run)
    top = float(centres[:, 1].max()) - float(mesh["notch_depth"]) if len(size) else 0.0
    return load_figures(run_results.history(run), "striker", "y") | {
        "torn": top,
        "ligament": mesh["height"] - mesh["notch_depth"],
    }


def load_figures(rows: dict[str, Values], pushed: str, axis: str) -> Record:
    """Figures of the load-displacement curve: peaks, plateau, final load, absorbed energy and number of fragments.

    `second`: load after the first peak, which is inertia under impact. `plateau`: median over the second half of the
    displacement. `at` and `travel`: displacement since contact at the peak and at the end, m.
    """
    load, displacement, contact_start = load_path(rows, pushed, axis)
    return {
        "peak": float(load.max()),
        "at": float(displacement[load.argmax()]) - contact_start,
        "second": second_peak(load),
        "plateau": float(np.median(load[displacement >= (contact_start + displacement[-1]) / 2])),
        "last": float(load[-1]),
        "absorbed": float(rows[f"work_{pushed}" if f"work_{pushed}" in rows else "external_work"][-1]),
        "travel": float(displacement[-1]) - contact_start,
        "pieces": float(rows["pieces"][-1]),
        "curve": [[float(value) for value in item] for item in downsample(displacement, load)],
    }


def load_path(rows: dict[str, Values], pushed: str, axis: str) -> tuple[Values, Values, float]:
    """Load (N), displacement (m), and displacement at first contact.

    For a grip that displacement is 0. For an obstacle, displacements count from its initial position.
    """
    held, displacement = f"reaction_{pushed}_{axis}", np.abs(rows[f"motion_{pushed}_{axis}"])
    if held in rows:
        return np.abs(rows[held]), displacement, 0.0
    load, displacement = np.abs(rows[f"contact_{pushed}_{axis}"]), displacement - displacement[0]
    return load, displacement, float(displacement[np.flatnonzero(load)[0]]) if load.any() else 0.0


def second_peak(load: Values) -> float:
    """Load at the top of the largest rise after the maximum."""
    after = load[int(load.argmax()) :]
    return float(after[int(np.argmax(after - np.minimum.accumulate(after)))])


def downsample(displacement: Values, load: Values, most: int = 150) -> tuple[Values, Values]:
    """About `most` points of a curve, with its peak and its end."""
    rows = np.unique([*np.arange(0, len(load), max(1, len(load) // most)), int(load.argmax()), len(load) - 1])
    return displacement[rows], load[rows]


# --- the page -------------------------------------------------------------------------------------------------------

COLUMNS = (
    "experiment", "h, m", "outcome", "first peak, N", "second, N", "plateau, N", "last, N", "over reference",
    "absorbed, J", "displacement of the load, m", "pieces",
)  # fmt: skip
RANGE_COLUMNS = ("experiment", "meshes", "peak, N", "spread", "reference, N", "off by", "source")
TEXT = (
    "Each on three meshes, all but one in 2D with the thickness of the specimen. The disk splits along its loaded "
    "diameter at pi D t f_t / 2. Charpy and Izod bars are in plane strain. A516 has a fracture energy and breaks in a "
    "brittle way. Its first peak is the inertia of the bar at impact; the second, at the start of the crack, compares "
    "with the static load. NVE 36 yields and bends at a nearly constant load. Linear triangles lock in plane plastic "
    "flow, so that this load lies above the limit load. KLST is of hardened steel with yield stress and toughness from "
    "a handbook, not fitted. The notched plate in shear starts to break at the load of a sharp crack that kinks by "
    "75.8 degrees (quadratic elements with quarter points). The glass plate is that of Borden et al. "
    "(2012), whose crack branches once. Branches are measured over 15 mm along the outermost cracks; they must be the "
    "first two, and do not count if one of those arrests. The concrete panel (l-panel) has Winkler's modulus and "
    "strength and G_c = 90 J/m^2 (Wu 2017). The measured panel absorbed 117 J/m^2 of its section in the end. Its "
    "initial stiffness is 0.64 of that with the given modulus, which another program confirms; it would fit 17.3 GPa "
    "(then 6.92 kN at 0.20 mm). The granite cylinder is in 3D: 0.2 m in diameter, seven times its process zone, and "
    "50 mm long. Its cracks stop about 2 h before either platen, where the material under it (one facet at this h) "
    "is compressed laterally, too. While the halves separate, other cracks start there by strength, as in the disk; "
    "they are close together and crush the ends. Removing the pressure along the crack from cut cells does not help "
    "(1.1 to 1.3 sigma^2 h / 2 E, which a sharp crack does not release). Curves of the other papers are available as "
    "pictures only and are not compared."
)


def sections(records: list[Record]) -> list[Section]:
    """Section with tables, claims, curves and pictures."""
    tables = (
        ReportTable("experiments", "All runs", COLUMNS, tuple(_row(record) for record in records)),
        ReportTable("experiments-spread", "Mean over the meshes and spread, (max - min) / mean", RANGE_COLUMNS,
              tuple(_range_rows(records))),
        *diametral_cracks.table([r for r in records if r["case"] == "granite-cylinder" and r["outcome"] == "done"]),
        *published_results.table(records),
    )  # fmt: skip
    plots = tuple(_load_plot(records, case) for case in BY_CASE if any(_has_curve(record, case) for record in records))
    pictures = tuple(
        Picture(f"{r['case']}, {r['name']}", f"{record_folder(r)}/run/last.png")
        for r in records
        if r["outcome"] == "done" and r["settings"]["h"] == BY_CASE[r["case"]].sizes[1][1]
    )
    return [Section("Experiments", TEXT, claims=_claims(records), tables=tables, plots=plots, pictures=pictures)]


def _compared_load(record: Record) -> float | None:
    """Load that corresponds to the reference: second peak of brittle bars, plateau of ductile bars, else the peak."""
    key = {"A516": "second", "NVE36": "plateau"}.get(record["case"].rpartition("-")[2], "peak")
    outcome: float | None = record["figures"].get(key)
    return outcome


def _row(record: Record) -> tuple[TableCell, ...]:
    """Row of the table of runs."""
    outcome, peak = record["figures"], _compared_load(record)
    over = None if peak is None or not BY_CASE[record["case"]].peak else peak / BY_CASE[record["case"]].peak
    loads, others = ("peak", "second", "plateau", "last"), ("absorbed", "travel", "pieces")
    return (record["case"], record["settings"]["h"], record["outcome"], *(outcome.get(key) for key in loads), over,
            *(outcome.get(key) for key in others))  # fmt: skip


def _range_rows(records: list[Record]) -> list[tuple[TableCell, ...]]:
    """Rows of the mean and range over the meshes."""
    outcome: list[tuple[TableCell, ...]] = []
    for case, experiment in BY_CASE.items():
        peaks = [
            p for r in records if r["case"] == case and r["outcome"] == "done" and (p := _compared_load(r)) is not None
        ]
        if peaks:
            mean = sum(peaks) / len(peaks)
            off = mean / experiment.peak - 1
            outcome.append((case, len(peaks), mean, relative_range(peaks), experiment.peak, off, experiment.source))
    return outcome


def _claims(records: list[Record]) -> tuple[Claim, ...]:
    """Claims of all experiments."""
    disks = [r for r in records if r["case"] == "brazilian" and r["outcome"] == "done"]
    bars = {steel: [r for r in records if steel in r["case"] and r["outcome"] == "done"] for steel in ("A516", "NVE36")}
    cylinders = _cylinder_claims([r for r in records if r["case"] == "granite-cylinder" and r["outcome"] == "done"])
    return (*_disk_claims(disks), *cylinders, *_steel_claims(**bars), *_notch_claims(records), _panel_claim(records))


def _panel_claim(records: list[Record]) -> Claim:
    """Claim on the peak load of the L-shaped panel."""
    panel = BY_CASE["l-panel"]
    outcome = [r["figures"] for r in records if r["case"] == panel.case and r["outcome"] == "done"]
    off = [item["peak"] / panel.peak - 1 for item in outcome]
    return Claim(
        "The peak of a concrete panel is within a tenth of the measured one on three meshes",
        _format_values(off, "{:+.1%}"),
        all(abs(item) <= (panel.within or 0.0) for item in off) if len(off) == 3 else None,
    )  # fmt: skip


def _notch_claims(records: list[Record]) -> tuple[Claim, ...]:
    """Claims on the notched plate, Kalthoff's angle and branching."""
    plate = BY_CASE["notched-tension"]
    done = {case: [r["figures"] for r in records if r["case"] == case and r["outcome"] == "done"]
            for case in (plate.case, "notched-shear", "kalthoff", "branching")}  # fmt: skip
    off = [outcome["peak"] / plate.peak - 1 for outcome in done[plate.case]]
    sheared = BY_CASE["notched-shear"]
    off_in_shear = [outcome["peak"] / sheared.peak - 1 for outcome in done[sheared.case]]
    forks = [outcome for outcome in done["branching"] if outcome["fork"] is not None]
    on = [
        abs(outcome["fork"] - outcome["first"]) < FIRST_BRANCH_LENGTH for outcome in forks
    ]  # the first two branches, not later ones
    askew = [outcome["upper"] - outcome["lower"] if runs else np.inf for outcome, runs in zip(forks, on, strict=True)]
    angles = [outcome["angle"] for outcome in done["kalthoff"] if outcome["angle"] is not None]
    return (
        Claim("A notched plate in tension breaks within 3 % of Griffith's load on three meshes",
              _format_values(off, "{:+.1%}"),
              all(abs(item) <= (plate.within or 0.0) for item in off) if len(off) == 3 else None),
        Claim("The same plate in shear breaks within 7 % of a sharp crack's load on three meshes",
              _format_values(off_in_shear, "{:+.1%}"),
              all(abs(item) <= (sheared.within or 0.0) for item in off_in_shear) if len(off_in_shear) == 3 else None),
        Claim("Kalthoff's crack grows at 65 to 75 degrees on three meshes", _format_values(angles, "{:.0f}"),
              all(65 <= angle <= 75 for angle in angles) if len(angles) == 3 else None),
        Claim("A pane's crack branches on three meshes, symmetric within 10 degrees (inf: one branch arrests)",
              _format_values(askew, "{:+.0f}"),
              all(abs(item) <= 10 for item in askew) and len(forks) == 3 if len(done["branching"]) == 3 else None),
    )  # fmt: skip


def _disk_claims(disks: list[Record]) -> tuple[Claim, ...]:
    """Claims on the Brazilian disk."""
    limit = BY_CASE["brazilian"].within or 0.0
    off = [record["figures"]["peak"] / BY_CASE["brazilian"].peak - 1 for record in disks]
    left = [record["figures"]["last"] / record["figures"]["peak"] for record in disks]
    along = [record["figures"]["along"] for record in disks]
    many = len(disks) == 3
    return (
        Claim("The Brazilian peak is within 10 % of pi D t f_t / 2 on three meshes", _format_values(off, "{:+.1%}"),
              all(abs(item) <= limit for item in off) if many else None),
        Claim("Its load falls by half after the peak", _format_values(left, "{:.2f} left"),
              all(item <= 0.5 for item in left) if many else None),
        Claim("Cracks follow half of the loaded diameter, within a tenth of the radius",
              _format_values(along, "{:.0%}"),
              all(item >= 0.5 for item in along) if many else None),
    )  # fmt: skip


def _cylinder_claims(cylinders: list[Record]) -> tuple[Claim, ...]:
    """Claims on the granite cylinder."""
    cylinder = BY_CASE["granite-cylinder"]
    return diametral_cracks.claims([record["figures"] for record in cylinders], cylinder.peak, cylinder.within or 0.0)


def _steel_claims(A516: list[Record], NVE36: list[Record]) -> tuple[Claim, ...]:
    """Claims on the brittle and the ductile steel."""
    left = [record["figures"]["last"] / record["figures"]["second"] for record in A516]
    stays = [record["figures"]["last"] / record["figures"]["plateau"] for record in NVE36]
    both = len(A516) == 6 and len(NVE36) == 6
    return (
        Claim("The load of A516 falls below 0.4 of its peak, Charpy and Izod", _format_values(left, "{:.2f}"),
              all(item <= 0.4 for item in left) if both else None),
        Claim("NVE 36 bends and still carries at least 0.8 of its plateau", _format_values(stays, "{:.2f}"),
              all(stay > 0.8 for stay in stays) if both else None),
    )  # fmt: skip


def _format_values(values: list[float], form: str) -> str:
    """Values as text; "not run" if there are none."""
    return ", ".join(form.format(value) for value in values) or "not run"


def _has_curve(record: Record, case: str) -> bool:
    """Return whether a record of the case has a load curve."""
    return bool(record["case"] == case and record["outcome"] == "done" and "curve" in record["figures"])


def _load_plot(records: list[Record], case: str) -> Plot:
    """Load over displacement, a line a mesh, with the reference curve or level."""
    experiment, series, farthest = BY_CASE[case], [], 0.0
    for record in records:
        if _has_curve(record, case):
            displacement, load = record["figures"]["curve"]
            series.append(Series(record["name"], tuple(displacement), tuple(load), style="line"))
            farthest = max(farthest, displacement[-1])
    displacement, load = published_results.MEASURED.get(case, ((0.0, farthest), (experiment.peak, experiment.peak)))
    line = Series(experiment.source, displacement, load, style="reference")
    return Plot(f"{case}: load over displacement of the {experiment.pushed}", "m", "N", (*series, line))
