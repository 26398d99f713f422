"""Which numbers colour a picture: a field of the run, or one component of a vector or tensor, and the range shown."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from ...errors import InputError
from ...output.fields_file import TENSOR_COMPONENTS

Values = npt.NDArray[np.float64]

UNITS = {
    "displacement": "m", "velocity": "m/s", "stress": "Pa", "von_mises": "Pa", "energy_density": "J/m³", "age": "s",
}  # fmt: skip
PALETTE = 20  # colours of pieces
# number of components -> their names
COMPONENT_NAMES = {3: ("x", "y", "z"), len(TENSOR_COMPONENTS): TENSOR_COMPONENTS}
HIDDEN = ("origin", "cell", "rest", "dust")  # of the surface: for ParaView, not for colouring
SHOWN = 98.0  # percent of the values that the colours tell apart; a few cells beside a crack would take them all


def select_array(mesh: Any, wanted: str) -> str:
    """The name of the array that `wanted` (NAME or NAME:COMPONENT) means; a component becomes an array of its own."""
    name, _, component = wanted.partition(":")
    data = next((part for part in (mesh.cell_data, mesh.point_data) if name in part), None)
    if data is None or name in HIDDEN:
        known = ", ".join(sorted({"crack", *mesh.cell_data, *mesh.point_data} - set(HIDDEN)))
        raise InputError(f"--field {wanted}: this run has: {known} (output.fields of the study sets what it writes)")
    values = np.asarray(data[name])
    names = COMPONENT_NAMES.get(values.shape[1], ()) if values.ndim == 2 else ()
    if component:
        if component not in names:
            known = f"its components are {', '.join(names)}" if names else "it has no components"
            raise InputError(f"--field {wanted}: {name} has no component {component}; {known}")
        data[wanted] = values[:, names.index(component)]
        return wanted
    if names == TENSOR_COMPONENTS:
        raise InputError(f"--field {wanted}: {name} is a tensor; add a component: {name}:{f', {name}:'.join(names)}")
    return name


def colour_range(values: Values, *, signed: bool = False) -> tuple[float, float] | None:
    """The range of the colours, None where there is nothing to show.

    Symmetric around zero for what is signed, such as a component, and where both signs occur.
    """
    values = values if values.ndim == 1 else np.linalg.norm(values, axis=1)
    values = values[np.isfinite(values)]
    if len(values) == 0:
        return None
    low, high = np.percentile(values, [(100 - SHOWN) / 2, (100 + SHOWN) / 2])
    if signed or low < 0 < high:
        most = float(max(-low, high))
        return -most, most
    return (float(low), float(high)) if high > low else (float(values.min()), float(values.max()))


def field_title(field: str) -> str:
    """A field or component in words, with its unit."""
    unit = UNITS.get(field.partition(":")[0], "")
    return field.replace("_", " ").replace(":", " ").replace("von mises", "von Mises") + (f" ({unit})" if unit else "")


def colour_map_name(limits: tuple[float, float]) -> str:
    """The colours of a range: of two branches where it has both signs."""
    return "coolwarm" if limits[0] < 0 < limits[1] else "viridis"


def map_colours(
    values: npt.NDArray[np.floating], limits: tuple[float, float] | None, missing: str
) -> npt.NDArray[np.uint8]:
    """(n, 3) of values (n,) between `limits`; `missing` "#rrggbb" of what is no number. Limits None: numbers of pieces,
    each with the colour that it has wherever it is seen."""
    import matplotlib

    if limits is None:
        of = matplotlib.colormaps["tab20"](values.astype(np.int64) % PALETTE)
        return np.asarray(np.rint(255 * of[:, :3]), np.uint8)
    low, high = limits
    share = np.clip((values - low) / (high - low), 0, 1) if high > low else np.full(len(values), 0.5)
    table = np.rint(255 * matplotlib.colormaps[colour_map_name(limits)](np.where(np.isfinite(share), share, 0))[:, :3])
    table[~np.isfinite(share)] = rgb(missing)
    return np.asarray(table, np.uint8)


def rgb(colour: str) -> tuple[int, int, int]:
    """#rrggbb -> (r, g, b)."""
    return int(colour[1:3], 16), int(colour[3:5], 16), int(colour[5:7], 16)


def merge_ranges(ranges: list[tuple[float, float] | None]) -> tuple[float, float] | None:
    """One range for several frames, symmetric where one of them is; None where none has anything to show."""
    found = [each for each in ranges if each is not None]
    if not found:
        return None
    low, high = min(each[0] for each in found), max(each[1] for each in found)
    most = max(-low, high)
    return (-most, most) if low < 0 < high else (low, high)
