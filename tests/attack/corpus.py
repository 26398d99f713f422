"""Small studies, a few steps of a few cells, which between them have all tables; and what two runs are compared by."""

from __future__ import annotations

import csv
import hashlib
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import tomli_w

from cases import BAR, DUCTILE_TABLES, STRIP, changed

Data = dict[str, Any]

_TIGHT = {"snes_rtol": 1e-11, "ksp_rtol": 1e-9}
_BALL = {"name": "ball", "shape": "sphere", "radius": 0.1, "at": [0.5, 0.36], "velocity": [0.0, -2.0], "friction": 0.2}
_FLOOR = {"name": "floor", "shape": "plane"}

STUDIES: dict[str, Data] = {
    "bar": BAR,
    "strip": changed(STRIP, fracture={"radius": 0.2}, damping={"mass": 1.0, "stiffness": 1e-4}),
    "ductile": changed(STRIP, **DUCTILE_TABLES),
    "closing": changed(STRIP, fracture={"unilateral": True, "heterogeneity": {"modulus": 8.0, "seed": 1}}),
    "edge": changed(
        STRIP, fracture={"approach": "edge"}, material={"energy": "corotated"},
        output={"fields": ["damage", "von_mises"]},
    ),
    "explicit": changed(STRIP, time={"scheme": "explicit", "step": 1e-3, "end": 5e-3}),
    "newmark": changed(
        BAR, time={"scheme": "newmark"}, load={"gravity": [0.0, 0.0, -9.81]}, initial={"spin": [1.0, 0, 0]}
    ),
    "quasi-static": changed(STRIP, time={"scheme": "quasi-static", "step": 0.01}),
    "struck": changed(STRIP, obstacle=[_BALL], contact={"friction": 0.1}, boundary=[{"on": "left", "fix": "xy"}]),
    "free": changed(
        STRIP, obstacle=[_BALL | {"mass": 5.0}, _FLOOR | {"at": [0.0, -0.1], "normal": [0.0, 1.0]}],
        load={"gravity": [0.0, -9.81]}, boundary=[{"on": "left", "fix": "xy"}],
    ),
    "brittle": changed(STRIP, brittle={"surfaces": 5, "spacing": 0.2}, fracture={"radius": 0.2}),
    "grains": changed(STRIP, brittle={"surfaces": 5, "grains": {"count": 6, "seed": 1}}),
    "cracked": changed(STRIP, crack=[{"segment": [[0.5, 0.0], [0.5, 0.1]]}]),
    "energy": changed(
        STRIP, fracture={"energy": 50.0}, mesh={"size": [1.0, 1.0], "pattern": "unstructured"},
        crack=[{"segment": [[0.0, 0.5], [0.4, 0.5]]}], time={"end": 0.02},
        boundary=[{"on": "bottom", "fix": "xy"}, {"on": "top", "velocity": [0.0, 1.0]}],
        probe=[{"name": "grip", "on": "top"}],
    ),
    "quadratic": changed(BAR, mesh={"order": 2}),
    "plate": changed(STRIP, material={"energy": "stvk", "plane": "stress", "thickness": 0.01}),
    "pressed": changed(
        BAR, boundary=[{"on": "left", "fix": "xyz"}, {"on": "right", "pressure": 1e3},
                       {"on": "top", "traction": [0.0, 0.0, -10.0]}]
    ),
    "table": changed(
        BAR, boundary=[
            {"on": {"box": [[-0.1, -1.0, -1.0], [0.1, 1.0, 1.0]]}, "fix": "xyz"},
            {"on": "right", "displacement": {"time": [0.0, 0.03], "value": [[0.0, "free", 0.0], [0.01, "free", 0.0]]}},
        ],
        time={"step": {"time": [0.0, 0.01], "value": [0.005, 0.01]}},
    ),
    "rigid": {
        "title": "rigid", "mesh": {"builder": "box", "size": [0.2, 0.1, 0.1], "h": 0.1},
        "material": {"energy": "linear", "young": 1e9, "poisson": 0.2, "density": 2000.0},
        "fracture": {"strength": 1e6}, "brittle": {"surfaces": 3},
        "obstacle": [_FLOOR | {"at": [0.0, 0.0, 0.0], "normal": [0.0, 0.0, 1.0]}],
        "body": [{"position": [0.0, 0.0, 0.1], "velocity": [0.0, 0.0, -3.0], "copies": [1, 1, 2],
                  "spacing": [0.5, 0.5, 0.3]}],
        "load": {"gravity": [0.0, 0.0, -9.81]}, "time": {"scheme": "rigid", "step": 0.01, "end": 0.1},
        "output": {"picture": False},
    },
}  # fmt: skip

# Runs that are stopped and go on: every step leaves a checkpoint, and solvers are tight, so that what differs is wrong.
_LONG = {"output": {"checkpoint": 1e-9, "fields": ["damage", "piece"]}, "solver": _TIGHT}
RUNS: dict[str, Data] = {
    "strip": changed(STUDIES["strip"], **_LONG, time={"step": 0.0025, "end": 0.1}),
    "ductile": changed(STUDIES["ductile"], **_LONG, time={"end": 0.1}),
    "struck": changed(STUDIES["struck"], **_LONG, time={"step": 0.0025, "end": 0.03}),
    "explicit": changed(STUDIES["explicit"], **_LONG | {"solver": {}}, time={"step": 1e-3, "end": 0.03}),
    "brittle": changed(STUDIES["brittle"], **_LONG, time={"step": 0.0025, "end": 0.08}),
    "rigid": changed(STUDIES["rigid"], time={"end": 0.4}, output={"checkpoint": 1e-9}),
}  # fmt: skip
# what depends on the machine, or on what multigrid was set up for
_NOT_COMPARED = ("wall_step", "newton_its", "krylov_its")


def write(path: Path, data: Data) -> Path:
    """A study file."""
    path.write_text(tomli_w.dumps(data))
    return path


def history(folder: Path) -> dict[str, npt.NDArray[np.float64]]:
    """Columns of history.csv."""
    with (folder / "history.csv").open(newline="") as file:
        rows = list(csv.reader(file))
    table = np.array([[float(each or "nan") for each in row] for row in rows[1:]]).reshape(len(rows) - 1, len(rows[0]))
    return dict(zip(rows[0], table.T, strict=True))


def differences(folder: Path, reference: Path, rtol: float = 1e-6) -> list[str]:
    """Columns of history.csv by which two runs differ, and frames of fields.h5."""
    import h5py

    found, wanted = history(folder), history(reference)
    if list(found) != list(wanted):
        return ["other columns"]
    if len(found["step"]) != len(wanted["step"]) or np.any(found["step"] != wanted["step"]):
        return [f"rows: steps {found['step'].tolist()[-3:]} of {len(found['step'])}, not {len(wanted['step'])}"]
    wrong = []
    for name, values in wanted.items():
        scale = np.abs(values).max(initial=0.0)
        if name not in _NOT_COMPARED and not np.allclose(
            found[name], values, rtol=rtol, atol=rtol * scale + 1e-12, equal_nan=True
        ):
            wrong.append(f"{name} by {np.nanmax(np.abs(found[name] - values)):.3g} of {scale:.3g}")
    if (reference / "fields.h5").exists():
        with h5py.File(folder / "fields.h5") as one, h5py.File(reference / "fields.h5") as other:
            if list(one["frames"]) != list(other["frames"]):
                wrong.append(f"{len(one['frames'])} frames, not {len(other['frames'])}")
            else:
                last = max(other["frames"])
                for name, values in other["frames"][last].items():
                    scale = np.abs(values[()]).max(initial=0.0)
                    if not np.allclose(one["frames"][last][name][()], values[()], rtol=rtol, atol=rtol * scale + 1e-12):
                        wrong.append(f"last frame: {name}")
    return wrong


def contents(folder: Path) -> dict[str, str]:
    """What is in a folder: kinds and digests of files, by name."""
    found = {}
    for path in sorted(folder.rglob("*")):
        name = str(path.relative_to(folder))
        if path.is_symlink():
            found[name] = f"-> {path.readlink()}"
        elif path.is_file():
            found[name] = hashlib.sha256(path.read_bytes()).hexdigest()
        else:
            found[name] = "folder" if path.is_dir() else "other"
    return found
