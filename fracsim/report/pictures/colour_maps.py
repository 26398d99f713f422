"""Colours of a field: the array that is shown, its range, and the colour map."""

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
# colours of fragments in matplotlib's tab20
_PALETTE_SIZE = 20
# number of components -> their names
COMPONENT_NAMES = {3: ("x", "y", "z"), len(TENSOR_COMPONENTS): TENSOR_COMPONENTS}
# arrays of the surface that are not fields
HIDDEN = ("origin", "cell", "rest", "dust")
# Percentage of the values inside the range of the colours. Without a limit a few cells beside a crack would determine
# the range.
_SHOWN_PERCENT = 98.0


def select_array(mesh: Any, wanted: str) -> str:
    """Name of the array of a field; a component is added to the mesh as an array of its own.

    Args:
        mesh: grid of pyvista.
        wanted: NAME or NAME:COMPONENT.

    Raises:
        InputError: there is no such field or component.
    """
    name, _, component = wanted.partition(":")
    data = next((part for part in (mesh.cell_data, mesh.point_data) if name in part), None)
    if data is None or name in HIDDEN:
        available = ", ".join(sorted({"crack", *mesh.cell_data, *mesh.point_data} - set(HIDDEN)))
        raise InputError(
            f"--field {wanted}: this run has: {available} (output.fields of the study sets what it writes)"
        )
    values = np.asarray(data[name])
    names = COMPONENT_NAMES.get(values.shape[1], ()) if values.ndim == 2 else ()
    if component:
        if component not in names:
            available = f"its components are {', '.join(names)}" if names else "it has no components"
            raise InputError(f"--field {wanted}: {name} has no component {component}; {available}")
        data[wanted] = values[:, names.index(component)]
        return wanted
    if names == TENSOR_COMPONENTS:
        raise InputError(f"--field {wanted}: {name} is a tensor; add a component: {name}:{f', {name}:'.join(names)}")
    return name


def colour_range(values: Values, *, signed: bool = False) -> tuple[float, float] | None:
    """Range of the colours, None if no value is finite.

    The range is symmetric about zero if the values have both signs.

    Args:
        values: scalars (n,) or vectors (n, d), whose norm is shown.
        signed: make the range symmetric in any case, as for a component.
    """
    values = values if values.ndim == 1 else np.linalg.norm(values, axis=1)
    values = values[np.isfinite(values)]
    if len(values) == 0:
        return None
    low, high = np.percentile(values, [(100 - _SHOWN_PERCENT) / 2, (100 + _SHOWN_PERCENT) / 2])
    if signed or low < 0 < high:
        bound = float(max(-low, high))
        return -bound, bound
    return (float(low), float(high)) if high > low else (float(values.min()), float(values.max()))


def field_unit(field: str) -> str:
    """SI unit of a field or component; "" for numbers."""
    return UNITS.get(field.partition(":")[0], "")


def field_title(field: str, unit: str) -> str:
    """Name of a field or component in words, with the unit of its numbers."""
    return field.replace("_", " ").replace(":", " ").replace("von mises", "von Mises") + (f" ({unit})" if unit else "")


def colour_map_name(limits: tuple[float, float]) -> str:
    """Name of matplotlib's colour map for a range: a diverging one if the range has both signs."""
    return "coolwarm" if limits[0] < 0 < limits[1] else "viridis"


def map_colours(
    values: npt.NDArray[np.floating], limits: tuple[float, float] | None, missing: str
) -> npt.NDArray[np.uint8]:
    """Colours (n, 3) of values (n,).

    Args:
        values: values of the field.
        limits: range of the colours. None: the values are names of fragments, each with a colour of its own.
        missing: colour of values that are not finite, "#rrggbb".
    """
    import matplotlib

    if limits is None:
        palette = matplotlib.colormaps["tab20"](values.astype(np.int64) % _PALETTE_SIZE)
        return np.asarray(np.rint(255 * palette[:, :3]), np.uint8)
    low, high = limits
    share = np.clip((values - low) / (high - low), 0, 1) if high > low else np.full(len(values), 0.5)
    colour_map = matplotlib.colormaps[colour_map_name(limits)]
    colours = np.rint(255 * colour_map(np.where(np.isfinite(share), share, 0))[:, :3])
    colours[~np.isfinite(share)] = rgb(missing)
    return np.asarray(colours, np.uint8)


def rgb(colour: str) -> tuple[int, int, int]:
    """Red, green and blue, 0 to 255, of a colour "#rrggbb"."""
    return int(colour[1:3], 16), int(colour[3:5], 16), int(colour[5:7], 16)


def merge_ranges(ranges: list[tuple[float, float] | None]) -> tuple[float, float] | None:
    """Range that contains the ranges of several frames, symmetric if it has both signs; None if all are None."""
    present = [limits for limits in ranges if limits is not None]
    if not present:
        return None
    low, high = min(limits[0] for limits in present), max(limits[1] for limits in present)
    bound = max(-low, high)
    return (-bound, bound) if low < 0 < high else (low, high)
