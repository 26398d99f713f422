"""Specimens with a slit on structured and unstructured meshes, for the dependence on the mesh.

    python -m fracsim.studies.evidence.slit_specimens SPECIMEN H RADIUS -o figures.json

runs a specimen on a structured mesh without the cells in the slit.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from typing import Any

import numpy as np

from .custom_meshes import MESH_TABLE, run_custom_mesh

Data = dict[str, Any]
MM = 1e-3
LOAD_STEPS = 40


@dataclass(frozen=True)
class Specimen:
    """A rectangle with a slit in 2D plane strain, pulled until it separates.

    Attributes:
        size: m.
        slit: lower and upper corner of the slit, m; a multiple of cells of 1 mm and of their halves.
        axis: of the normal of the slit's plane (0: x, 1: y).
        builder: the unstructured mesh of the same outline (its slit ends in a point).
        held: conditions that fix the specimen.
        loaded: group that moves.
        moved: components of its motion, times `travel`.
        travel: m.
    """

    size: tuple[float, float]
    slit: tuple[tuple[float, float], tuple[float, float]]
    axis: int
    builder: Data
    held: tuple[Data, ...]
    loaded: str
    moved: tuple[float | str, float | str]
    travel: float

    @property
    def pull(self) -> str:
        """Axis of the load."""
        return "xy"[self.axis]

    @property
    def plane(self) -> float:
        """Coordinate of the slit's plane along `axis`, m."""
        return (self.slit[0][self.axis] + self.slit[1][self.axis]) / 2


BAR = Specimen(
    size=(40 * MM, 10 * MM),
    slit=((19.5 * MM, 0.0), (20.5 * MM, 3 * MM)),
    axis=0,
    builder={
        "builder": "notched-bar", "length": 40 * MM, "height": 10 * MM, "thickness": 0.0, "notch": "slit",
        "notch_depth": 3 * MM, "notch_width": 1 * MM, "span": 0.0,
    },
    held=(
        {"on": "left", "displacement": [0.0, "free"]},
        {"on": {"box": [[-1e-6, -1e-6], [1e-6, 1e-6]]}, "fix": "y"},
    ),
    loaded="right",
    moved=(1.0, "free"),
    travel=0.8 * MM,
)  # fmt: skip
PLATE = Specimen(
    size=(20 * MM, 20 * MM),
    slit=((0.0, 9.5 * MM), (8 * MM, 10.5 * MM)),
    axis=1,
    builder={
        "builder": "notched-plate", "length": 20 * MM, "height": 20 * MM, "notch_length": 8 * MM,
        "notch_width": 1 * MM,
    },
    held=({"on": "bottom", "fix": "xy"},),
    loaded="top",
    moved=(0.0, 1.0),
    travel=0.5 * MM,
)  # fmt: skip
SPECIMENS = {"bar": BAR, "plate": PLATE}


def specimen_study(specimen: Specimen, mesh: Data, radius: float) -> Data:
    """Study of slow loading to separation. Each step is repeated until nothing breaks; its size hardly matters."""
    end = [part if isinstance(part, str) else part * specimen.travel for part in specimen.moved]
    start = [part if isinstance(part, str) else 0.0 for part in specimen.moved]
    moved = {"time": [0.0, 1.0], "value": [start, end]}
    return {
        "title": "a slit specimen broken",
        "mesh": mesh,
        "material": {"energy": "linear", "young": 3e9, "poisson": 0.35, "density": 1200.0},
        "fracture": {"strength": 6e7, "radius": radius, "passes": 40},
        "boundary": [*specimen.held, {"on": specimen.loaded, "displacement": moved}],
        "time": {"scheme": "quasi-static", "step": 1.0 / LOAD_STEPS, "end": 1.0},
        "probe": [{"name": "load", "on": specimen.loaded}],
        "output": {"every": LOAD_STEPS // 4, "fields": ["damage", "von_mises"]},
    }


FRACTURE_ENERGY = 350.0  # G_c in J/m^2: PMMA


def cracked_specimen_study(specimen: Specimen, pattern: str, h: float) -> Data:
    """Study of the full rectangle with a fracture energy and a crack in place of the slit.

    The crack does not pass through the nodes of a lattice.
    """
    at = specimen.plane + 0.2 * MM
    low, high = specimen.slit
    ends = [list(low), list(high)]
    for end in ends:
        end[specimen.axis] = at
    mesh = {"builder": "box", "size": list(specimen.size), "h": h, "pattern": pattern}
    data = specimen_study(specimen, mesh, 0.0)
    data["fracture"] = {"strength": data["fracture"]["strength"], "energy": FRACTURE_ENERGY}
    data["crack"] = [{"segment": ends}]
    data["time"] |= {"breaking_step": 1.0 / LOAD_STEPS / 32, "until": {"drop": 0.8}}
    return data


def unstructured_mesh(specimen: Specimen, h: float) -> Data:
    """Table [mesh] of an unstructured mesh with uniform cell size."""
    fine = "h_notch" if specimen is BAR else "h_tip"
    return specimen.builder | {"h": h, fine: h}


def structured_mesh(specimen: Specimen, h: float) -> Any:
    """Mesh of squares of side h in two triangles each, without those in the slit."""
    from ...meshes.builders.box import lattice
    from ...meshes.data import MeshData
    from ...meshes.topology import boundary_facets, facet_groups_on_planes

    points, cells = lattice(tuple(round(length / h) for length in specimen.size))
    points = points * np.array(specimen.size)
    middle = points[cells].mean(axis=1)
    low, high = specimen.slit
    cells = cells[~((middle > low) & (middle < high)).all(axis=1)]
    used, inverse = np.unique(cells, return_inverse=True)
    points, cells = points[used], inverse.reshape(cells.shape)
    sides = {"left": (0, 0.0), "right": (0, specimen.size[0]), "bottom": (1, 0.0), "top": (1, specimen.size[1])}
    return MeshData(points, cells, facet_groups_on_planes(points, boundary_facets(cells), sides))


if __name__ == "__main__":
    name, spacing, reach = sys.argv[1], float(sys.argv[2]), float(sys.argv[3])
    run_custom_mesh(
        lambda: (structured_mesh(SPECIMENS[name], spacing), specimen_study(SPECIMENS[name], dict(MESH_TABLE), reach))
    )
