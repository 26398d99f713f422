"""Figures of a run with any outcome: finite values, energy balance, iterations, broken edges."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import h5py
import numpy as np
import numpy.typing as npt

from . import block_stretch, run_results, stability_studies

Values = npt.NDArray[np.float64]
Figures = dict[str, float | int | bool]


def measure_run(run: Path) -> Figures:
    """Figures of an output folder; empty if the study was refused."""
    if not (run / "history.csv").exists():
        return {}
    rows, frames = run_results.history(run), _check_frames(run)
    figures: Figures = {
        "finite": all(np.isfinite(column).all() for column in rows.values()) and frames[0] and surface_is_finite(run),
        "smallest_J": frames[1],
        "checkpoint": (run / "checkpoint").exists(),
    }
    if len(rows["time"]):
        figures |= {
            "steps": len(rows["time"]),
            "growth": energy_growth(rows, moving_at_start=moves_at_start(run_results.study(run))),
            "newton_max": int(rows["newton_its"].max()),
            "newton_mean": float(rows["newton_its"].mean()),
            "krylov_max": int(rows["krylov_its"].max()),
            "krylov_mean": float(rows["krylov_its"].mean()),
            "broken": int(rows["broken_edges"][-1]),
            "broken_in_a_step": int(np.diff(rows["broken_edges"], prepend=0).max()),
            "pieces": int(rows["pieces"][-1]),
        }
    return figures


def measure_stretch(run: Path) -> Figures:
    """Figures of `measure_run`, and error of a uniaxial or confined stretch against its closed form."""
    return (
        measure_run(run) | block_stretch.stretch_error(run_results.study(run), run_results.history(run))
        if run.exists()
        else {}
    )


def measure_momentum(run: Path) -> Figures:
    """Figures of `measure_run`, and error of the momentum p = F t of a free body under a dead load F."""
    if not run.exists():
        return {}
    study = run_results.study(run)
    area, traction = np.prod(stability_studies.BAR["size"][1:]), np.array(study["boundary"][0]["traction"])
    pieces = run_results.columns(run / "pieces.csv")
    last = pieces["time"] == pieces["time"].max()
    momentum = np.array([(pieces["mass"] * pieces[f"velocity_{axis}"])[last].sum() for axis in "xyz"])
    exact = traction * area * pieces["time"].max()
    return measure_run(run) | {"error": float(np.linalg.norm(momentum - exact) / np.linalg.norm(exact))}


def measure_weight(run: Path) -> Figures:
    """Figures of `measure_run`, and error of the support reaction against the weight of the body."""
    if not run.exists():
        return {}
    pieces, rows = run_results.columns(run / "pieces.csv"), run_results.history(run)
    weight = -pieces["mass"][pieces["time"] == 0].sum() * run_results.study(run)["load"]["gravity"][2]
    return measure_run(run) | {"error": float(abs(rows["reaction_grip_z"][-1] / weight - 1))}


def measure_momentum_drift(run: Path) -> Figures:
    """Figures of `measure_run`, and momentum gained by a force-free body, over mass times its largest speed."""
    if not run.exists():
        return {}
    start, pieces = (
        run_results.study(run)["initial"].get("velocity", [0.0, 0.0, 0.0]),
        run_results.columns(run / "pieces.csv"),
    )
    last = pieces["time"] == pieces["time"].max()
    mass, v = pieces["mass"][last], np.stack([pieces[f"velocity_{axis}"][last] for axis in "xyz"])
    gained = v @ mass - mass.sum() * np.array(start)
    return measure_run(run) | {"error": float(np.linalg.norm(gained) / (mass.sum() * np.linalg.norm(v, axis=0).max()))}


# --- reading an output folder ---------------------------------------------------------------------------------------


def moves_at_start(study: dict[str, Any]) -> bool:
    """Return whether the body or a free obstacle has initial kinetic energy."""
    free = (item for item in study.get("obstacle", []) if "mass" in item or "density" in item)
    return "initial" in study or any("velocity" in item or "spin" in item for item in free)


def energy_growth(rows: dict[str, Values], *, moving_at_start: bool) -> float:
    """Largest rise of elastic + kinetic + dissipated - work above an earlier minimum, relative to the largest energy.

    A scheme may lose energy but not create it. In a quasi-static run `dissipated` closes the balance and has to grow,
    so that a fall of it counts as created energy. The trapezoidal rule of the work has an error over large steps.
    """
    held = rows["elastic"] + rows["kinetic"]
    balance = held + rows["dissipated"] - rows["external_work"]
    if not moving_at_start:
        balance = np.concatenate([[0.0], balance])
    scale = max(np.abs(rows["external_work"]).max(), held.max())
    fall = -rows["dissipated"].min(initial=0.0) if not rows["kinetic"].any() else 0.0
    rise = (balance - np.minimum.accumulate(balance)).max()
    return float(max(rise, fall) / scale) if scale else 0.0


def _check_frames(run: Path) -> tuple[bool, float]:
    """(all fields finite, smallest J of cells that carry load) over the frames of fields.h5."""
    finite, least = True, np.inf
    with h5py.File(run / "fields.h5") as file:
        points, cells = file["points"][()], file["cells"][()]
        for frame in file["frames"].values():
            finite &= all(np.isfinite(data[()]).all() for data in frame.values())
            carries = _load_bearing_cells(frame, len(cells))
            J = volume_ratios(points, cells, frame["displacement"][()])
            least = min(least, J[carries].min(initial=np.inf))
    return bool(finite), float(least)


def _load_bearing_cells(frame: Any, cells: int) -> npt.NDArray[np.bool_]:
    """Flags (m,) of the cells that broken edges have not separated."""
    if "chi" in frame:
        return np.asarray(frame["chi"][()] > 0)
    return np.asarray(frame["damage"][()] == 0) if "damage" in frame else np.ones(cells, bool)


def volume_ratios(points: Values, cells: npt.NDArray[np.integer], u: Values) -> Values:
    """Volume ratio J (m,) = det(x_1 - x_0, ...) / det(X_1 - X_0, ...) of each simplex; points and u (n, 3)."""
    d = cells.shape[1] - 1

    def measure(x: Values) -> Values:
        corners = x[cells][:, :, :d]
        return np.asarray(np.linalg.det(corners[:, 1:] - corners[:, :1]))

    return measure(points + u) / measure(points)


def surface_is_finite(run: Path) -> bool:
    """Return whether all points of the last split surface are finite; True without a surface."""
    if not (run / "surface.pvd").exists():
        return True
    from fracsim.output.surface.vtk_files import read_body_frames

    frames = read_body_frames(run / "surface.pvd")
    return not frames or bool(np.isfinite(read_surface(run / frames[-1][1]).points).all())


def read_surface(path: Path) -> Any:
    """One frame of the split surface as a pyvista grid."""
    import pyvista

    return pyvista.read(path)
