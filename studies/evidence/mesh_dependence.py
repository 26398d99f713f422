"""Dependence of results on the mesh: a bar and a plate with a slit on five meshes, by strength and by energy."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from . import run_results, slit_specimens
from .report_section import Picture, Plot, ReportTable, Section, Series, TableCell, record_folder
from .stability_measures import read_surface
from .trial import Trial

GROUP = "dependence"
AVERAGING_RADIUS = 2e-3  # m: two cells of the coarsest mesh
MESHES = (
    ("structured", 1e-3),
    ("unstructured", 7e-4),
    ("structured", 5e-4),
    ("unstructured", 3.5e-4),
    ("structured", 2.5e-4),
)
MAX_PATH_POINTS = 200  # of a crack's path
Record = dict[str, Any]


def trials() -> list[Trial]:
    """Trials of two specimens with two averaging radii on five meshes, and of the plate with a fracture energy.

    The finest mesh is left to the full report.
    """
    by_edges = [
        _strength_trial(name, pattern, h, radius)
        for name in slit_specimens.SPECIMENS
        for radius in (0.0, AVERAGING_RADIUS)
        for pattern, h in MESHES
    ]
    return by_edges + [_energy_trial(pattern, h) for pattern, h in MESHES]


def _energy_trial(pattern: str, h: float) -> Trial:
    """Trial of the plate with a fracture energy."""
    return Trial(
        GROUP, "plate-energy", f"{h * 1e3:g}-mm-{pattern}", limit=600.0,
        study=slit_specimens.cracked_specimen_study(slit_specimens.PLATE, pattern, h),
        settings={"h": h, "pattern": pattern, "radius": 0.0}, measure="mesh_dependence:measure_plate", full=h < 3e-4,
    )  # fmt: skip


def _strength_trial(name: str, pattern: str, h: float, radius: float) -> Trial:
    """Trial of a specimen with a strength and an averaging radius."""
    study: dict[str, Any] | None = None
    script: tuple[str, ...] = ()
    if pattern == "structured":
        script = ("fracsim.studies.evidence.slit_specimens", name, f"{h:g}", f"{radius:g}")
    else:
        study = slit_specimens.specimen_study(
            slit_specimens.SPECIMENS[name], slit_specimens.unstructured_mesh(slit_specimens.SPECIMENS[name], h), radius
        )
    label = "local" if radius == 0 else "averaged"
    return Trial(
        GROUP, f"{name}-{label}", f"{h * 1e3:g}-mm-{pattern}", study=study, script=script,
        settings={"h": h, "pattern": pattern, "radius": radius}, measure=f"mesh_dependence:measure_{name}", limit=600.0,
        full=h < 3e-4,
    )  # fmt: skip


# --- measures --------------------------------------------------------------------------------------------------------


def measure_bar(run: Path) -> Record:
    """Figures of the bar."""
    return measure_specimen(run, slit_specimens.BAR)


def measure_plate(run: Path) -> Record:
    """Figures of the plate."""
    return measure_specimen(run, slit_specimens.PLATE)


def measure_specimen(run: Path, specimen: slit_specimens.Specimen) -> Record:
    """Peak load, new surface, energy and path of the crack for a thickness of 1 m."""
    rows = run_results.history(run)
    area, centres = crack_faces(run)
    stray = np.abs(centres[:, specimen.axis] - specimen.plane)
    load = np.abs(rows[f"reaction_load_{specimen.pull}"])
    # A crack that advances in a step lowers its load: the peak is that before.
    onset = np.abs(rows.get(f"onset_load_{specimen.pull}", load))
    return {
        "peak_load": float(onset.max()),
        "at": float(rows["time"][onset.argmax()] * abs(specimen.travel)),
        "broken_area": float(area.sum() / 2),
        "dissipated": float(rows["dissipated"][-1]),
        "stray": float(stray @ area / area.sum()) if area.sum() else 0.0,
        "left": float(load[-1] / onset.max()),
        "broken_edges": float(rows["broken_edges"][-1]),
        "path": crack_path(centres[:, 1 - specimen.axis], centres[:, specimen.axis] - specimen.plane),
    }


def crack_path(along: npt.NDArray[np.float64], off: npt.NDArray[np.float64]) -> list[list[float]]:
    """At most MAX_PATH_POINTS points of the crack, ordered: position along the slit and distance from its plane, m."""
    order = np.argsort(along, kind="stable")[:: max(1, -(-len(along) // MAX_PATH_POINTS))]
    return [[float(item) for item in row] for row in np.column_stack([along, off])[order]]


def crack_faces(run: Path) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """Sizes (n,) and centres (n, 3) of the crack faces in the reference configuration, both sides.

    Sizes are lengths in 2D (m^2 for a thickness of 1 m) and areas in 3D, of the last frame of the split surface.
    """
    corners = crack_corners(run)
    d = corners[:, 1:] - corners[:, :1]
    flat = corners.shape[1] == 2
    size = np.linalg.norm(d[:, 0], axis=1) if flat else np.linalg.norm(np.cross(d[:, 0], d[:, 1]), axis=1) / 2
    return size, corners.mean(axis=1)


def crack_corners(run: Path, time: float | None = None) -> npt.NDArray[np.float64]:
    """Corners (n, 2 or 3, 3) of the crack faces in the reference configuration, m.

    Taken from the last frame, or from the one nearest to `time`, s.
    """
    from fracsim.mesh.split_surface.entity_numbering import CRACK
    from fracsim.output.surface.vtk_files import read_body_frames

    frames = read_body_frames(run / "surface.pvd")
    chosen = frames[-1] if time is None else min(frames, key=lambda frame: abs(float(frame[0]) - time))
    grid = read_surface(run / chosen[1])
    points = np.asarray(grid.points, float) - np.asarray(grid.point_data["displacement"], float)
    kind = 3 if 3 in grid.cells_dict else 5  # VTK: lines in 2D, triangles in 3D
    opened = np.asarray(grid.cell_data["origin"])[grid.celltypes == kind] == CRACK
    return np.asarray(points[grid.cells_dict[kind][opened]])


# --- the page -------------------------------------------------------------------------------------------------------

FIGURES = ("peak_load", "broken_area", "dissipated", "stray")
COLUMNS = (
    "specimen",
    "h, m",
    "pattern",
    "outcome",
    "peak load, N",
    "broken area, m2",
    "dissipated, J",
    "stray, m",
    "load left",
)


def sections(records: list[Record]) -> list[Section]:
    """Section with tables of all runs and of their range, curves over h, and pictures."""
    rows = tuple(_row(record) for record in records)
    text = (
        "A bar pulled along its length and a plate pulled upwards, both with a slit, in plane strain and for a "
        "thickness of 1 m, on five meshes. Cracks follow mesh edges. With radius 0 the peak load falls with the cell "
        "size at the tip, since the elastic stress there is singular. A radius of two coarse cells introduces a length "
        "scale. With fracture.energy (plate-energy: the slit is a [[crack]], 350 J/m2) the crack advances where it "
        "releases that energy. Stray is the mean distance of the new surface from the plane of the slit. The broken "
        "area counts all cracks, including those that do not separate the body. Spread is (max - min) / mean over the "
        "meshes."
    )
    tables = (
        ReportTable(
            "dependence-spread", "Spread over the meshes", ("specimen", "meshes", *FIGURES), tuple(_range_rows(records))
        ),
        ReportTable("dependence", "All runs", COLUMNS, rows),
    )
    plots = (*(_plot(records, key) for key in ("peak_load", "dissipated")), *_plate_plots(records))
    pictures = tuple(
        Picture(f"{r['case']}, {r['name']}", f"{record_folder(r)}/run/last.png")
        for r in records
        if r["outcome"] == "done"
    )
    return [Section("Dependence on the mesh", text, tables=tables, plots=plots, pictures=pictures[:12])]


def _row(record: Record) -> tuple[TableCell, ...]:
    """Row of the table of runs."""
    figures, settings = record["figures"], record["settings"]
    measured = (figures.get(key) for key in (*FIGURES, "left"))
    return (record["case"], settings["h"], settings["pattern"], record["outcome"], *measured)


def relative_range(values: list[float]) -> float:
    """(max - min) / mean; 0 if all values are 0."""
    return (max(values) - min(values)) / (sum(values) / len(values)) if any(values) else 0.0


def _range_rows(records: list[Record]) -> list[tuple[TableCell, ...]]:
    """Rows of the table of ranges, one a case."""
    outcome: list[tuple[TableCell, ...]] = []
    for case in dict.fromkeys(record["case"] for record in records):
        done = [record["figures"] for record in records if record["case"] == case and record["outcome"] == "done"]
        if done:
            outcome.append((case, len(done), *(relative_range([figures[key] for figures in done]) for key in FIGURES)))
    return outcome


def _plate_plots(records: list[Record]) -> list[Plot]:
    """Peak load and crack path of the plate by strength, averaged strength and energy."""
    done = [r for r in records if r["case"].startswith("plate") and r["outcome"] == "done" and "path" in r["figures"]]
    if not done:
        return []
    cases = {case: [r for r in done if r["case"] == case] for case in dict.fromkeys(r["case"] for r in done)}
    peaks = tuple(
        Series(case, tuple(r["settings"]["h"] for r in item), tuple(r["figures"]["peak_load"] for r in item))
        for case, item in cases.items()
    )
    paths = tuple(_crack_series(r) for r in done if r["case"] != "plate-averaged" and r["figures"]["path"])
    return [
        Plot("Peak load of the plate, before and with a fracture energy", "h, m", "peak load, N", peaks, kind="loglog"),
        Plot("Crack of the plate, before and with a fracture energy", "along the slit, m", "off it, m", paths),
    ]


def _crack_series(record: Record) -> Series:
    """Path of the crack as a line."""
    x, y = np.array(record["figures"]["path"]).T
    label = f"{record['case']}, {record['settings']['h'] * 1e3:g} mm"
    return Series(label, tuple(x.tolist()), tuple(y.tolist()), "line")


def _plot(records: list[Record], key: str) -> Plot:
    """One figure over h, relative to its value on the coarsest mesh; a line for each specimen and radius."""
    words = f"{key.replace('_', ' ')} over that of the coarsest mesh"
    series = []
    for case in dict.fromkeys(record["case"] for record in records):
        done = [record for record in records if record["case"] == case and record["outcome"] == "done"]
        if not done:
            continue
        first = done[0]["figures"][key] or 1.0
        h, values = [r["settings"]["h"] for r in done], [r["figures"][key] / first for r in done]
        series.append(Series(case, tuple(h), tuple(values)))
    return Plot(words.capitalize(), "h, m", words, tuple(series), kind="logx")
