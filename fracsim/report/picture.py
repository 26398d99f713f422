"""Pictures and animations of a run, off-screen: its split surface where there is one, else its mesh."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import numpy.typing as npt

from ..errors import InputError
from ..output.surface.collection import Entry, read_entries
from .colouring import select, shown_range
from .obstacles import add_obstacles, with_obstacles
from .screen import display

Values = npt.NDArray[np.float64]

VIEWS = {
    "iso": (0.7, -1.6, 0.8),
    "front": (0.0, -1.0, 0.0),
    "back": (0.0, 1.0, 0.0),
    "left": (-1.0, 0.0, 0.0),
    "right": (1.0, 0.0, 0.0),
    "top": (0.0, -0.001, 1.0),
}
OLD, CRACK = "#b4bac4", "#e0762b"  # the old boundary and the crack, where no field colours them
PALETTE = 20  # colours of pieces
LINE = 3  # VTK's number of a segment
AMBIENT = 0.25  # light in the shade, so that the side away from the lamp shows its crack too


@dataclass(frozen=True)
class Look:
    """How to draw.

    Attributes:
        colour: "crack" (the crack lighter than the old boundary), or a field: piece, age, von_mises, stress:xx, ...
        explode: how far pieces are moved apart, as a share of their distance from the middle.
        view: a name of VIEWS, or a direction to look from.
        zoom: above 1 is nearer.
    """

    colour: str = "crack"
    explode: float = 0.0
    view: str = "iso"
    zoom: float = 1.0

    def direction(self) -> tuple[float, ...]:
        """Where the camera stands, seen from the body."""
        if self.view in VIEWS:
            return VIEWS[self.view]
        try:
            x, y, z = (float(part) for part in self.view.split(","))
        except ValueError:
            known = ", ".join(VIEWS)
            raise InputError(f"--view {self.view}: must be one of {known}, or three numbers such as 1,-2,0.5") from None
        if not (math.isfinite(x + y + z) and (x or y or z)):
            raise InputError(f"--view {self.view}: a direction must be finite and not zero")
        return x, y, z


def render(folder: Path, target: Path | None = None, look: Look | None = None, *, frame: int = -1) -> Path:
    """Draw one frame as a PNG, or all of them as a GIF where `target` ends so; returns the file written."""
    target, look = target or folder / "last.png", look or Look()
    frames = find_frames(folder)
    if target.suffix not in (".png", ".gif"):
        raise InputError(f"-o {target}: pictures are .png and animations .gif")
    if not -len(frames) <= frame < len(frames):
        raise InputError(f"--frame {frame}: {folder} has {len(frames)} frames, counted from 0 (-1 is the last)")
    look.direction()
    with display():
        import pyvista

        plotter = pyvista.Plotter(off_screen=True, window_size=(1400, 900))
        plotter.set_background("white")
        target.parent.mkdir(parents=True, exist_ok=True)
        if target.suffix == ".gif":
            _animate(plotter, frames, look, target)
        else:
            bounds = _draw(plotter, frames[frame], look)
            _aim(plotter, bounds, look)
            plotter.screenshot(target)
        plotter.close()
    return target


@dataclass(frozen=True)
class Shot:
    """A frame to draw: where its data are."""

    t: float
    file: Path
    index: int  # of the frame in fields.h5, -1: a VTU of the surface
    beside: tuple[Path, ...] = ()  # VTUs of the obstacles


def find_frames(folder: Path) -> list[Shot]:
    """Frames of surface.pvd, or else of fields.h5. InputError where there are none."""
    pvd, h5 = folder / "surface.pvd", folder / "fields.h5"
    if pvd.exists():
        shots = _of_surface(folder, read_entries(pvd))
        if shots:
            return shots
    if not h5.exists():
        raise InputError(f"{folder} has no surface.pvd and no fields.h5: it is not the output folder of a run")
    with h5py.File(h5) as file:
        times = [float(file["frames"][name].attrs["time"]) for name in sorted(file["frames"])]
    if not times:
        raise InputError(f"{h5} has no frame yet")
    return [Shot(t, h5, index) for index, t in enumerate(times)]


def _of_surface(folder: Path, entries: list[Entry]) -> list[Shot]:
    beside: dict[float, list[Path]] = {}
    for entry in entries:
        if entry.part:
            beside.setdefault(entry.t, []).append(folder / entry.file)
    bodies = [entry for entry in entries if not entry.part]
    return [Shot(each.t, folder / each.file, -1, tuple(beside.get(each.t, ()))) for each in bodies]


def load(shot: Shot) -> Any:
    """The frame as a grid of displaced points with its fields."""
    import pyvista

    if shot.index < 0:
        return pyvista.read(shot.file)
    with h5py.File(shot.file) as file:
        frame = file["frames"][sorted(file["frames"])[shot.index]]
        cells = file["cells"][()]
        kind = pyvista.CellType.TRIANGLE if cells.shape[1] == 3 else pyvista.CellType.TETRA
        grid = pyvista.UnstructuredGrid({kind: cells}, file["points"][()] + frame["displacement"][()])
        for name, data in frame.items():
            (grid.point_data if data.attrs["centre"] == "Node" else grid.cell_data)[name] = data[()]
    return grid


def exploded(points: Values, piece: npt.NDArray[np.integer], share: float) -> Values:
    """(n, 3) points with each piece moved away from the middle by `share` of its distance from it."""
    numbers, of_point = np.unique(piece, return_inverse=True)
    counts = np.bincount(of_point)[:, None]
    centres = np.stack([np.bincount(of_point, column) for column in points.T], axis=1) / counts
    middle = (points.min(axis=0) + points.max(axis=0)) / 2
    return np.asarray(points + share * (centres - middle)[of_point]) if len(numbers) > 1 else points


def _draw(plotter: Any, shot: Shot, look: Look) -> Values:
    """Add a frame; returns the bounds of what is worth looking at, debris that flew off left out."""
    grid = load(shot)
    if look.explode and "piece" in grid.point_data:
        grid.points = exploded(np.asarray(grid.points, float), grid.point_data["piece"], look.explode)
    flat = bool(np.ptp(grid.points[:, 2]) == 0)
    _add(plotter, grid, look, lighting=not flat)
    add_obstacles(plotter, shot.beside, flat=flat)
    plotter.add_text(f"t = {shot.t:.4g} s", font_size=11, color="black", name="time")
    return with_obstacles(_worth_seeing(grid), shot.beside)


def _add(plotter: Any, grid: Any, look: Look, *, lighting: bool) -> None:
    outline, grid = _parted(grid)
    body = _whole(grid)
    field = select(body, look.colour) if look.colour != "crack" else ""
    if not field:
        _add_two_tone(plotter, body, lighting)
    elif shown_range(np.asarray(body[field], float)) is not None:
        _add_coloured(plotter, body, field, lighting=lighting)
    else:  # what only the crack has, in a body without crack or on the lines of a 2D one
        plotter.add_mesh(body, color=OLD, lighting=lighting, ambient=AMBIENT)
    if outline is None:
        return
    if look.colour in outline.cell_data and look.colour == "age" and np.isfinite(outline.cell_data["age"]).any():
        _add_coloured(plotter, outline, "age", lighting=False)
    else:
        plotter.add_mesh(outline, color="black", line_width=1.5)


def _parted(grid: Any) -> tuple[Any, Any]:
    """(lines or None, the rest) of the surface of a 2D body."""
    if "origin" not in grid.cell_data or not np.any(grid.celltypes == LINE):
        return None, grid
    lines, rest = (grid.extract_cells(np.flatnonzero(grid.celltypes == LINE)), grid.celltypes != LINE)
    return lines, grid.extract_cells(np.flatnonzero(rest))


def _add_coloured(plotter: Any, mesh: Any, field: str, *, lighting: bool) -> None:
    bar = {
        "title": field.replace("_", " ").replace(":", " ") + "\n", "color": "black", "vertical": False, "height": 0.08,
        "position_y": 0.02, "n_labels": 3, "label_font_size": 16, "title_font_size": 18,
    }  # fmt: skip
    many = field == "piece"
    values = np.asarray(mesh[field])
    limits: tuple[float, float] | None = (-0.5, PALETTE - 0.5)
    if many:  # numbers in the middle of their colours, or round-off speckles what lies between two
        values = values % PALETTE
    else:
        limits = shown_range(values.astype(float), signed=":" in field)
    both_signs = limits is not None and limits[0] < 0 < limits[1]
    plotter.add_mesh(
        mesh, scalars=values if many else field, clim=limits, nan_color=OLD,
        cmap="tab20" if many else "coolwarm" if both_signs else "viridis",
        lighting=lighting, line_width=3, ambient=AMBIENT, scalar_bar_args=bar, show_scalar_bar=not many,
    )  # fmt: skip


def _whole(grid: Any) -> Any:
    """The surface as it is; of a mesh, the surface of the cells that hold together, which opens the crack."""
    if "origin" in grid.cell_data:
        return grid
    if "damage" in grid.cell_data:
        kept = np.flatnonzero(grid.cell_data["damage"] < 0.5)
        grid = grid.extract_cells(kept) if len(kept) else grid
    return grid.extract_surface()


def _add_two_tone(plotter: Any, body: Any, lighting: bool) -> None:
    names = list(body.field_data["origins"]) if "origins" in body.field_data else []
    if "crack" not in names:
        plotter.add_mesh(body, color=OLD, lighting=lighting, ambient=AMBIENT)
        return
    crack = np.asarray(body.cell_data["origin"]) == names.index("crack")
    for part, colour in ((~crack, OLD), (crack, CRACK)):
        if part.any():
            plotter.add_mesh(body.extract_cells(np.flatnonzero(part)), color=colour, lighting=lighting, ambient=AMBIENT)


def _worth_seeing(grid: Any) -> Values:
    """(6,) bounds of the large pieces: those with half a hundredth or more of the points."""
    points = np.asarray(grid.points, float)
    if "piece" in grid.point_data:
        _, of_point, count = np.unique(grid.point_data["piece"], return_inverse=True, return_counts=True)
        points = points[count[of_point] >= min(0.005 * len(points), count.max())]
    return np.stack([points.min(axis=0), points.max(axis=0)], axis=1).reshape(-1)


def _aim(plotter: Any, bounds: Values, look: Look) -> None:
    flat = bounds[4] == bounds[5]
    if flat:
        plotter.view_xy()
    else:
        plotter.camera_position = [look.direction(), (0, 0, 0), (0, 0, 1)]
    plotter.reset_camera(bounds=bounds)
    plotter.camera.zoom((1.3 if flat else 1.1) * look.zoom)


def _animate(plotter: Any, frames: list[Shot], look: Look, target: Path) -> None:
    """All frames from one place that sees the first and the last."""
    ends = [with_obstacles(_worth_seeing(load(shot)), shot.beside) for shot in (frames[0], frames[-1])]
    bounds = np.where(np.arange(6) % 2 == 0, np.minimum(*ends), np.maximum(*ends))
    plotter.open_gif(str(target), fps=12)
    for shot in frames:
        plotter.clear_actors()
        _draw(plotter, shot, look)
        _aim(plotter, bounds, look)
        plotter.write_frame()
