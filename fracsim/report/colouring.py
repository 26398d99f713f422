"""Which numbers colour a picture: a field of the run, or one component of a vector or tensor, and the range shown."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from ..errors import InputError
from ..output.fields_file import TENSOR

Values = npt.NDArray[np.float64]

# number of components -> their names
COMPONENTS = {3: ("x", "y", "z"), len(TENSOR): TENSOR}
HIDDEN = ("origin", "cell")  # of the surface: for ParaView, not for colouring
SHOWN = 98.0  # percent of the values that the colours tell apart; a few cells beside a crack would take them all


def select(mesh: Any, wanted: str) -> str:
    """The name of the array that `wanted` (NAME or NAME:COMPONENT) means; a component becomes an array of its own."""
    name, _, component = wanted.partition(":")
    data = next((part for part in (mesh.cell_data, mesh.point_data) if name in part), None)
    if data is None or name in HIDDEN:
        known = ", ".join(sorted({"crack", *mesh.cell_data, *mesh.point_data} - set(HIDDEN)))
        raise InputError(f"--field {wanted}: this run has: {known} (output.fields of the study sets what it writes)")
    values = np.asarray(data[name])
    names = COMPONENTS.get(values.shape[1], ()) if values.ndim == 2 else ()
    if component:
        if component not in names:
            known = f"its components are {', '.join(names)}" if names else "it has no components"
            raise InputError(f"--field {wanted}: {name} has no component {component}; {known}")
        data[wanted] = values[:, names.index(component)]
        return wanted
    if names == TENSOR:
        raise InputError(f"--field {wanted}: {name} is a tensor; add a component: {name}:{f', {name}:'.join(names)}")
    return name


def shown_range(values: Values, *, signed: bool = False) -> tuple[float, float] | None:
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
