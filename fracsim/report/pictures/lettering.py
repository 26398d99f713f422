"""Title, time, scale bar and legend, drawn on the pixels: the same colours and the same type at every size."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from .colouring import colours

Pixels = npt.NDArray[np.uint8]
INK, PALE = (34, 38, 44), (120, 126, 134)
SMALL = 1.0 / 45.0  # of the height of the picture: the type
TICKS = 5
PREFIXES = {1e3: "km", 1.0: "m", 1e-2: "cm", 1e-3: "mm", 1e-6: "µm"}


@dataclass(frozen=True)
class Legend:
    """The colours of a field.

    Attributes:
        title: with its unit.    limits: of the colours.
    """

    title: str
    limits: tuple[float, float]


def lettered(
    pixels: Pixels,
    *,
    title: str = "",
    time: str = "",
    pixel: float = 0.0,
    legend: Legend | None = None,
    keys: Sequence[tuple[str, str]] = (),
) -> Pixels:
    """With what is to be read; `pixel`: m that one is wide (0: no scale bar); `keys`: (colour, what has it)."""
    from PIL import Image, ImageDraw

    image = Image.fromarray(pixels)
    draw, unit = ImageDraw.Draw(image), max(9, round(SMALL * image.height))
    edge, bottom = unit, image.height - unit
    if title:
        draw.text((edge, edge), title, INK, _font(round(1.25 * unit)))
    draw.text((edge, edge + (1.9 * unit if title else 0)), time, PALE if title else INK, _font(unit))
    if legend is not None:
        _bar(draw, image, legend, unit)
    elif keys:
        _keys(draw, keys, image.width - edge, bottom, unit)
    if pixel > 0:
        length = nice(0.16 * image.width * pixel)
        x, y = edge, bottom
        draw.rectangle((x, y - max(2, unit // 6), x + round(length / pixel), y), INK)
        draw.text((x, y - 1.7 * unit), in_words(length), INK, _font(unit))
    return np.asarray(image)


def nice(length: float) -> float:
    """The greatest of 1, 2, 5 times a power of ten that is no longer."""
    power = 10.0 ** math.floor(math.log10(length))
    return max(each * power for each in (1, 2, 5) if each * power <= length * (1 + 1e-9))


def in_words(length: float) -> str:
    """0.05 -> 5 cm."""
    unit = next((each for each in PREFIXES if length >= each * (1 - 1e-9)), 1e-6)
    return f"{length / unit:.4g} {PREFIXES[unit]}"


def number(value: float) -> str:
    """As short as it may be."""
    return f"{value:.3g}".replace("e+0", "e").replace("e-0", "e-").replace("e+", "e").replace("-", "\u2212")


def in_seconds(t: float) -> str:
    """1.2e-4 -> t = 120 µs."""
    for unit, name in ((1.0, "s"), (1e-3, "ms"), (1e-6, "µs")):
        if abs(t) >= unit * (1 - 1e-9) or name == "µs":
            break
    return f"t = {t / unit:.4g} {name}" if t else "t = 0 s"


def _bar(draw: Any, image: Any, legend: Legend, unit: int) -> None:
    """At the lower edge, in the middle."""
    from PIL import Image

    width, height = round(0.4 * image.width), unit
    x, y = (image.width - width) // 2, round(image.height - 2.9 * unit)
    low, high = legend.limits
    row = colours(np.linspace(low, high, width), (low, high), "#000000")
    image.paste(Image.fromarray(np.tile(row, (height, 1, 1))), (x, y))
    draw.rectangle((x - 1, y - 1, x + width, y + height), outline=PALE)
    draw.text((x + width / 2, y - 0.4 * unit), legend.title, INK, _font(unit), anchor="mb")
    for share in np.linspace(0, 1, TICKS):
        at = x + share * (width - 1)
        draw.line((at, y + height, at, y + height + unit / 4), INK)
        draw.text((at, y + height + 0.4 * unit), number(low + share * (high - low)), INK, _font(unit), anchor="mt")


def _keys(draw: Any, keys: Sequence[tuple[str, str]], right: float, bottom: float, unit: int) -> None:
    """One above the other, in the lower right corner."""
    wide = max(draw.textlength(text, _font(unit)) for _, text in keys)
    for row, (colour, text) in enumerate(reversed(keys)):
        y = bottom - 1.5 * row * unit
        draw.rectangle((right - wide - 1.6 * unit, y - unit, right - wide - 0.6 * unit, y), colour, PALE)
        draw.text((right - wide, y), text, INK, _font(unit), anchor="lb")


@cache
def _font(size: int) -> Any:
    import matplotlib
    from PIL import ImageFont

    return ImageFont.truetype(str(Path(matplotlib.get_data_path()) / "fonts/ttf/DejaVuSans.ttf"), size)
