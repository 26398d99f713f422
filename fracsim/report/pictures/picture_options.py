"""What a user asks of a picture."""

from __future__ import annotations

import math
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
SIZE = (1400, 900)
LARGEST = 8192  # pixels a side: what drivers give


@dataclass(frozen=True)
class PictureOptions:
    """How to draw.

    Attributes:
        colour: "crack" (skin and inside each in its own colour), or a field: piece, age, von_mises, stress:xx, ...
        explode: how far pieces are moved apart, as a share of their distance from the middle.
        view: a name of VIEWS, or a direction to look from.
        zoom: above 1 is nearer.
        material: "" (as the study says), a name of MATERIAL_LOOKS, or two colours "#rrggbb,#rrggbb".
        size: of the picture, pixels.
        limits: least and greatest of the colours; None: of what is shown.
        magnify: displacements are drawn so many times as large.
        floor: draw one, where an obstacle plane is, else below the body.
        title: None: that of the study; "": none.
        bare: no title, time, scale bar, legend.
        dust: draw pieces of a single node.
        fine: supersampled; costs some three times as much.
    """

    colour: str = "crack"
    explode: float = 0.0
    view: str = "iso"
    zoom: float = 1.0
    material: str = ""
    size: tuple[int, int] = SIZE
    limits: tuple[float, float] | None = None
    magnify: float = 1.0
    floor: bool = False
    title: str | None = None
    bare: bool = False
    dust: bool = True
    fine: bool = True

    def view_direction(self) -> tuple[float, ...]:
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


def parse_size(text: str) -> tuple[int, int]:
    """1400x900 -> (1400, 900)."""
    width, _, height = text.partition("x")
    if not (width.isdecimal() and height.isdecimal() and all(16 <= int(n) <= LARGEST for n in (width, height))):
        raise InputError(f"--size {text}: must be WIDTHxHEIGHT in pixels, 16 to {LARGEST} each, such as 1400x900")
    return int(width), int(height)


def parse_limits(text: str) -> tuple[float, float]:
    """0,2e5 -> (0.0, 2e5)."""
    try:
        low, high = (float(part) for part in text.split(","))
    except ValueError:
        low = high = math.nan
    if not (math.isfinite(low) and math.isfinite(high) and low < high):
        raise InputError(f"--range {text}: must be two numbers, the lower first, such as 0,2e5")
    return low, high
