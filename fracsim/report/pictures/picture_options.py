"""Options of a picture, and the looks of materials."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass

from ...errors import InputError

VIEWS = {
    "iso": (0.7, -1.6, 0.8),
    "front": (0.0, -1.0, 0.0),
    "back": (0.0, 1.0, 0.0),
    "left": (-1.0, 0.0, 0.0),
    "right": (1.0, 0.0, 0.0),
    "top": (0.0, -0.001, 1.0),
}
DEFAULT_SIZE = (1400, 900)
# least and largest side of a picture in pixels; graphics drivers give no more
_SIDE_LIMITS = (16, 8192)
_HEX_COLOUR = re.compile(r"#[0-9a-fA-F]{6}")


@dataclass(frozen=True)
class PictureOptions:
    """Options of a picture.

    Attributes:
        colour: "crack" for the boundary and cracks in a colour each, or the name of a field: piece, age, von_mises,
            stress:xx, ...
        explode: displacement of the fragments away from the centre, as a share of their distance from it.
        view: name of `VIEWS`, or a direction such as "1,-2,0.5" from the body to the camera.
        zoom: magnification, above 1 is nearer.
        material: "" for the look of the study, a name of `MATERIAL_LOOKS`, or two colours "#rrggbb,#rrggbb".
        size: width and height, pixels.
        limits: least and largest value of the colours; None: of the values shown.
        magnify: factor of the displacements.
        floor: draw a floor, at an obstacle plane or below the body.
        title: title; None: that of the study; "": none.
        bare: draw no title, time, scale bar or legend.
        dust: draw single-node fragments.
        fine: supersampling, which takes three times as long.
        axes: draw the directions of x, y and z.
        follow: the camera moves with the body and is as near as at the first frame; otherwise it sees all frames whole.
        target: point (3,) at the centre of the picture, m; None: the centre of what is shown.
    """

    colour: str = "crack"
    explode: float = 0.0
    view: str = "iso"
    zoom: float = 1.0
    material: str = ""
    size: tuple[int, int] = DEFAULT_SIZE
    limits: tuple[float, float] | None = None
    magnify: float = 1.0
    floor: bool = False
    title: str | None = None
    bare: bool = False
    dust: bool = True
    fine: bool = True
    axes: bool = False
    follow: bool = False
    target: tuple[float, ...] | None = None

    def view_direction(self) -> tuple[float, ...]:
        """Direction from the body to the camera. Raises InputError if `view` is neither a name nor a direction."""
        if self.view in VIEWS:
            return VIEWS[self.view]
        try:
            x, y, z = (float(part) for part in self.view.split(","))
        except ValueError:
            names = ", ".join(VIEWS)
            raise InputError(f"--view {self.view}: must be one of {names}, or three numbers such as 1,-2,0.5") from None
        if not (math.isfinite(x + y + z) and (x or y or z)):
            raise InputError(f"--view {self.view}: a direction must be finite and not zero")
        return x, y, z


def parse_size(text: str) -> tuple[int, int]:
    """Width and height in pixels of a text such as "1400x900". Raises InputError."""
    width, _, height = text.partition("x")
    low, high = _SIDE_LIMITS
    if not (width.isdecimal() and height.isdecimal() and all(low <= int(side) <= high for side in (width, height))):
        raise InputError(f"--size {text}: must be WIDTHxHEIGHT in pixels, {low} to {high} each, such as 1400x900")
    return int(width), int(height)


def parse_target(text: str) -> tuple[float, ...]:
    """Point of a text such as "0,0,0.1", m. Raises InputError."""
    try:
        x, y, z = (float(part) for part in text.split(","))
    except ValueError:
        x = y = z = math.nan
    if not math.isfinite(x + y + z):
        raise InputError(f"--target {text}: must be a point in m: --target 0,0,0.1")
    return x, y, z


def parse_limits(text: str) -> tuple[float, float]:
    """Least and largest value of a text such as "0,2e5". Raises InputError."""
    try:
        low, high = (float(part) for part in text.split(","))
    except ValueError:
        low = high = math.nan
    if not (math.isfinite(low) and math.isfinite(high) and low < high):
        raise InputError(f"--range {text}: must be two numbers, the lower first, such as 0,2e5")
    return low, high


@dataclass(frozen=True)
class MaterialLook:
    """Look of a material.

    Attributes:
        boundary_colour: colour of the original boundary, "#rrggbb".
        crack_colour: colour of crack faces, "#rrggbb".
        gloss: share of specular light, 0 (dull) to 1.
        backdrop: colour behind the body, "#rrggbb".
    """

    boundary_colour: str
    crack_colour: str
    gloss: float = 0.1
    backdrop: str = "#eef0f3"


MATERIAL_LOOKS = {
    "plain": MaterialLook("#b4bac4", "#e0762b", 0.0, "#ffffff"),
    "bread": MaterialLook("#b9712c", "#f0deb6", 0.12, "#f3efe6"),
    "porcelain": MaterialLook("#f4f2ee", "#d8bf9c", 0.6, "#c9d2dc"),
    "glass": MaterialLook("#bcd6d0", "#eef7f4", 0.8, "#dfe6ec"),
    "jade": MaterialLook("#5c9c77", "#b5d9b4", 0.5, "#eef0ec"),
    "granite": MaterialLook("#86837f", "#c4b5a6", 0.1),
    "steel": MaterialLook("#76808c", "#d3d8de", 0.55),
    "wood": MaterialLook("#8b5a32", "#e0bd8b", 0.15, "#f3efe6"),
}


def material_look(look: str | Mapping[str, str]) -> MaterialLook:
    """Look of a name or of two colours.

    Args:
        look: a name of `MATERIAL_LOOKS`; or {"skin": "#rrggbb", "inside": "#rrggbb"}, the colours of the original
            boundary and of crack faces; or both as "#rrggbb,#rrggbb".

    Raises:
        InputError: the name is unknown, or a colour is not of that form.
    """
    if isinstance(look, str) and "," not in look:
        if look not in MATERIAL_LOOKS:
            names = ", ".join(MATERIAL_LOOKS)
            raise InputError(f"--look {look}: must be one of {names}, or two colours: #b9712c,#f0deb6")
        return MATERIAL_LOOKS[look]
    boundary, crack = look.split(",", 1) if isinstance(look, str) else (look["skin"], look["inside"])
    if wrong := next((colour for colour in (boundary, crack) if not _HEX_COLOUR.fullmatch(colour)), None):
        raise InputError(f"--look: {wrong} is no colour; write it as #rrggbb, the skin and the inside: #b9712c,#f0deb6")
    return MaterialLook(boundary, crack, 0.2)
