"""A half-notched beam of concrete in three-point bending, and its load by cohesive springs: NumPy and SciPy alone.

The smallest beam of Gregoire, Rojas-Solano, Pijaudier-Cabot (2013), with an exponential law.
"""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import scipy.sparse as sp
import scipy.sparse.linalg as spl

from .fracture_specimens import LOAD_OUTPUT, node_box, write_outline

Values = npt.NDArray[Any]

YOUNG, POISSON, STRENGTH, ENERGY = 37e9, 0.2, 3.9e6, 143.2  # Pa, 1, Pa, J/m^2
DEPTH, SPAN, THICKNESS = 0.05, 0.125, 0.05  # m; the notch is half as deep


# --- by springs along the ligament -----------------------------------------------------------------------------------


def _half_beam(rows: int) -> tuple[sp.csc_matrix, npt.NDArray[np.int64]]:
    """Stiffness (2 nodes, 2 nodes), N/m, of one half in plane stress by squares, and its nodes (columns, rows + 1)."""
    n, columns = rows + 1, rows * 5 // 4
    nodes = np.arange((columns + 1) * n).reshape(columns + 1, n)
    a, b = SPAN / 2 / columns / 2, DEPTH / rows / 2
    factor = YOUNG / (1 - POISSON**2)
    elastic = factor * np.array([[1, POISSON, 0], [POISSON, 1, 0], [0, 0, (1 - POISSON) / 2]])
    corners, element = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]), np.zeros((8, 8))
    for x, y in corners / np.sqrt(3):
        slope = np.stack([corners[:, 0] * (1 + y * corners[:, 1]) / a, corners[:, 1] * (1 + x * corners[:, 0]) / b]) / 4
        B = np.zeros((3, 8))
        B[0, ::2], B[1, 1::2], B[2, ::2], B[2, 1::2] = slope[0], slope[1], slope[1], slope[0]
        element += B.T @ elastic @ B * a * b * THICKNESS
    quads = np.stack([nodes[:-1, :-1], nodes[1:, :-1], nodes[1:, 1:], nodes[:-1, 1:]], axis=-1).reshape(-1, 4)
    dofs = (2 * quads[:, :, None] + np.arange(2)).reshape(-1, 8)
    i, j = np.repeat(dofs, 8, axis=1).ravel(), np.tile(dofs, 8).ravel()
    return sp.csc_matrix((np.tile(element.ravel(), len(quads)), (i, j))), nodes


def load_by_springs(rows: int, openings: Values) -> tuple[Values, Values]:
    """Return deflection (n,), m, and load (n,), N, at openings (n,), m, of the lowest spring of the ligament.

    The half beam is condensed to the ligament and the load. Springs carry f_t exp(-w f_t / G_c) when they have been
    open, as much as it takes before, and compression. `rows` is a multiple of 4.
    """
    K, nodes = _half_beam(rows)
    ligament = nodes[0, rows // 2 :]
    size = np.full(len(ligament), DEPTH / rows * THICKNESS)
    size[[0, -1]] /= 2
    # Springs much stiffer than the body stand for an uncracked ligament.
    stiff = 1e3 * YOUNG / DEPTH
    held = 2 * nodes[-1, 0] + 1
    free = np.delete(np.arange(K.shape[0]), held)
    ground = np.zeros(K.shape[0])
    ground[2 * ligament] = stiff * size
    solve = spl.factorized((K + sp.diags(ground))[free][:, free].tocsc())
    unit = np.zeros((K.shape[0], len(ligament) + 1))
    unit[2 * ligament, np.arange(len(ligament))] = 1.0
    unit[2 * nodes[0, -1] + 1, -1] = -0.5
    answer = np.zeros_like(unit)
    answer[free] = np.column_stack([solve(column) for column in unit[free].T])
    A, sinks = answer[2 * ligament], answer[2 * nodes[0, -1] + 1]
    widest: Values = np.zeros(len(ligament))
    u: Values = np.zeros(len(ligament))
    load, result = 0.0, []
    for opening in openings:
        for _ in range(100):
            stress, slope = _spring(2 * u, widest, 2 * stiff)
            # The ground springs are taken out again.
            force = size * (stiff * u - stress)
            out = np.append(u - A[:, :-1] @ force - A[:, -1] * load, 2 * u[0] - opening)
            J = np.zeros((len(out),) * 2)
            J[:-1, :-1] = np.eye(len(u)) - A[:, :-1] * (size * (stiff - 2 * slope))
            J[:-1, -1], J[-1, 0] = -A[:, -1], 2.0
            step = np.linalg.solve(J, out)
            u, load = u - step[:-1], load - step[-1]
            if np.abs(step[:-1]).max() < 1e-12:
                break
        else:
            raise AssertionError(f"no equilibrium at an opening of {opening} m")
        stress, _ = _spring(2 * u, widest, 2 * stiff)
        widest = np.maximum(widest, 2 * u)
        result.append((-sinks[:-1] @ (size * (stiff * u - stress)) - sinks[-1] * load, load))
    return np.array(result).T[0], np.array(result).T[1]


def _spring(w: Values, widest: Values, stiff: float) -> tuple[Values, Values]:
    """Stress (n,), Pa, of springs that are open by w (n,), m, and its slope."""
    start = STRENGTH / stiff

    def law(opening: Values) -> Values:
        return STRENGTH * np.exp(-(opening - start) * STRENGTH / ENERGY)

    secant = np.where(widest > start, law(widest) / np.maximum(widest, start), stiff)
    secant = np.where(w < 0, stiff, secant)
    opens = w >= np.maximum(widest, start)
    stress = np.where(opens, law(np.maximum(w, start)), secant * w)
    return stress, np.where(opens, -stress * STRENGTH / ENERGY, secant)


@cache
def springs_peak(rows: int = 80) -> float:
    """Largest load (N) by springs on `rows` squares; it is reached at an opening of 30 micrometres."""
    return float(load_by_springs(rows, np.linspace(1e-6, 4e-5, 40))[1].max())


# --- the study -------------------------------------------------------------------------------------------------------


def beam_study(folder: Path, cells: float, seed: int, sinks: float, steps: int, *, notch: bool) -> dict[str, Any]:
    """Study of the beam with `cells` cells over the ligament.

    Args:
        folder: folder for the outline.
        cells: ligament over h.
        seed: seed of the mesh.
        sinks: deflection at the end, m.
        steps: number of steps.
        notch: the notch is part of the outline, h wide; otherwise it is a `[[crack]]`.
    """
    h = DEPTH / 2 / cells
    notch_sides = [(-h / 2, 0.0), (-h / 2, DEPTH / 2), (h / 2, DEPTH / 2), (h / 2, 0.0)] if notch else []
    corners = [(-SPAN / 2, 0.0), *notch_sides, (SPAN / 2, 0.0), (SPAN / 2, DEPTH), (0.0, DEPTH), (-SPAN / 2, DEPTH)]
    top = node_box(0.0, DEPTH, 1e-6)
    moved = {"time": [0.0, 1.0], "value": [["free", 0.0], ["free", -sinks]]}
    return {
        "title": "A half-notched beam of concrete",
        "mesh": {"outline": write_outline(folder / "beam.csv", [(x, y, "") for x, y in corners]), "h": h, "seed": seed},
        "material": {
            "energy": "linear", "plane": "stress", "thickness": THICKNESS, "young": YOUNG, "poisson": POISSON,
            "density": 2400.0,
        },
        "fracture": {"strength": STRENGTH, "energy": ENERGY, "law": "cohesive"},
        "crack": [] if notch else [{"segment": [[0.0, -1e-3], [0.0, DEPTH / 2]]}],
        "boundary": [
            {"on": node_box(-SPAN / 2, 0.0, 1e-6), "fix": "xy"},
            {"on": node_box(SPAN / 2, 0.0, 1e-6), "fix": "y"},
            {"on": top, "displacement": moved},
        ],
        "probe": [{"name": "load", "on": top}],
        "time": {"scheme": "quasi-static", "step": 1 / steps, "end": 1.0},
        "output": LOAD_OUTPUT,
    }  # fmt: skip
