"""Pictures of a run, off-screen."""

from __future__ import annotations

import os
import shutil
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from .errors import InputError


def render_last(folder: Path, png: Path | None = None) -> Path:
    """Draw the last frame of folder/fields.h5: cells that hold together, deformed, coloured by damage or stress."""
    target = png or folder / "last.png"
    grid, field, t = read_frame(folder)
    with display():
        import pyvista

        plotter = pyvista.Plotter(off_screen=True, window_size=(1400, 900))
        plotter.set_background("white")
        body = _add_body(plotter, grid, field)
        plotter.add_text(f"t = {t:.4g} s", font_size=11, color="black")
        _aim(plotter, body)
        plotter.screenshot(target)
        plotter.close()
    return target


def read_frame(folder: Path, index: int = -1) -> tuple[Any, str, float]:
    """(grid with fields, name of the field to colour by, time in s) of one frame; points are displaced."""
    import pyvista

    path = folder / "fields.h5"
    if not path.exists():
        raise InputError(f"{folder} has no fields.h5: it is not the output folder of a run")
    with h5py.File(path) as file:
        names = sorted(file["frames"])
        if not names:
            raise InputError(f"{path} has no frame yet")
        frame = file["frames"][names[index]]
        points, cells = file["points"][()], file["cells"][()]
        kind = pyvista.CellType.TRIANGLE if cells.shape[1] == 3 else pyvista.CellType.TETRA
        grid = pyvista.UnstructuredGrid({kind: cells}, points + frame["displacement"][()])
        for name, data in frame.items():
            holder = grid.point_data if data.attrs["centre"] == "Node" else grid.cell_data
            holder[name] = data[()]
        t = float(frame.attrs["time"])
    field = next((name for name in ("damage", "von_mises") if name in grid.cell_data), "displacement")
    return grid, field, t


def _add_body(plotter: Any, grid: Any, field: str) -> Any:
    """Draw the cells that hold together; returns what was drawn."""
    whole = grid
    if "damage" in grid.cell_data:
        # a cell with half of its edges broken has come apart or nearly so; leaving it out opens the crack
        whole = grid.extract_cells(np.flatnonzero(grid.cell_data["damage"] < 0.5))
    if whole.n_cells == 0:
        whole = grid
    bar = {
        "title": field.replace("_", " ") + "\n", "color": "black", "vertical": False, "height": 0.08,
        "position_y": 0.02, "n_labels": 3, "label_font_size": 16, "title_font_size": 18,
    }  # fmt: skip
    edges = grid.n_cells < 60_000
    plotter.add_mesh(
        whole.extract_surface(), scalars=field, cmap="YlOrBr", show_edges=edges, line_width=0.5, edge_opacity=0.35,
        scalar_bar_args=bar, lighting=bool(np.ptp(whole.points[:, 2])),
    )  # fmt: skip
    return whole


def _aim(plotter: Any, body: Any) -> None:
    if np.ptp(body.points[:, 2]) == 0:
        plotter.view_xy()
    else:
        plotter.camera_position = [(0.7, -1.6, 0.8), (0, 0, 0), (0, 0, 1)]
    plotter.reset_camera(bounds=body.bounds)
    plotter.camera.zoom(1.3)


@contextmanager
def display() -> Iterator[None]:
    """A screen for VTK: the one there is, or a virtual one that ends with the picture."""
    xvfb = shutil.which("Xvfb")
    if os.environ.get("DISPLAY") or xvfb is None:
        yield
        return
    read, write = os.pipe()
    command = [xvfb, "-displayfd", str(write), "-screen", "0", "1600x1200x24", "-nolisten", "tcp"]
    server = subprocess.Popen(command, pass_fds=[write], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    os.close(write)
    try:
        with os.fdopen(read) as pipe:
            os.environ["DISPLAY"] = f":{pipe.readline().strip()}"
        yield
    finally:
        os.environ.pop("DISPLAY", None)
        server.terminate()
        server.wait()
