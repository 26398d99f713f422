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

from .colour_maps import map_colours

Pixels = npt.NDArray[np.uint8]
Colour = tuple[int, int, int]
INK, PALE = (34, 38, 44), (104, 110, 118)
LIGHT = (244, 246, 248)  # what is written on a dark ground
PAPER, EVEN = 230, 150  # of 255: a ground that is nowhere darker needs no more than pale letters, or ink
SMALL = 1.0 / 45.0  # of the height of the picture: the type
TICKS = 5
PREFIXES = {1e3: "km", 1.0: "m", 1e-2: "cm", 1e-3: "mm", 1e-6: "µm"}


@dataclass(frozen=True)
class ColourLegend:
    """The colours of a field.

    Attributes:
        title: with its unit.    limits: of the colours.
    """

    title: str
    limits: tuple[float, float]


def annotate(
    pixels: Pixels,
    *,
    title: str = "",
    time: str = "",
    pixel: float = 0.0,
    legend: ColourLegend | None = None,
    keys: Sequence[tuple[str, str]] = (),
) -> Pixels:
    """With what is to be read; `pixel`: m that one is wide (0: no scale bar); `keys`: (colour, what has it)."""
    from PIL import Image, ImageDraw

    image = Image.fromarray(pixels)
    unit = max(9, round(SMALL * image.height))
    pen = _Pen(image, ImageDraw.Draw(image), unit)
    edge, bottom = unit, image.height - unit
    if title:
        pen.write((edge, edge), title, large=True)
    pen.write((edge, edge + (1.9 * unit if title else 0)), time, PALE if title else INK)
    if legend is not None:
        _bar(pen, legend)
    elif keys:
        _keys(pen, keys, image.width - edge, bottom)
    if pixel > 0:
        length = round_length(0.16 * image.width * pixel)
        x, y = edge, bottom
        pen.bar((x, y - max(2, unit // 6), x + round(length / pixel), y))
        pen.write((x, y - 1.7 * unit), format_length(length))
    return np.asarray(image)


class _Pen:
    """Writes so that it can be read on any ground: in light letters on a dark one, and with a rim where a ground is not
    light all over. On a light ground it is plain ink."""

    def __init__(self, image: Any, draw: Any, unit: int) -> None:
        self.image, self.draw, self.unit = image, draw, unit

    def write(
        self, at: tuple[float, float], text: str, ink: Colour = INK, *, anchor: str = "la", large: bool = False
    ) -> None:
        """A line of text; `anchor`: Pillow's."""
        font = _font(round(1.25 * self.unit) if large else self.unit)
        darkest, most = self._ground(self.draw.textbbox(at, text, font, anchor))
        if darkest >= EVEN:
            self.draw.text(at, text, ink if darkest >= PAPER else INK, font, anchor)
        else:
            ink, rim = _on(most)
            self.draw.text(at, text, ink, font, anchor, stroke_width=max(1, self.unit // 8), stroke_fill=rim)

    def bar(self, box: tuple[float, float, float, float]) -> None:
        """One of the scale."""
        darkest, most = self._ground(box)
        self.draw.rectangle(box, *((INK,) if darkest >= EVEN else _on(most)))

    def _ground(self, box: tuple[float, float, float, float]) -> tuple[float, float]:
        """How light the darkest pixel of a ground is, and the one in the middle, of 255."""
        ground = np.asarray(self.image.crop(tuple(round(each) for each in box)).convert("L"))
        return (float(ground.min()), float(np.median(ground))) if ground.size else (255.0, 255.0)


def _on(ground: float) -> tuple[Colour, Colour]:
    """Ink and its rim."""
    return (INK, LIGHT) if ground >= EVEN else (LIGHT, INK)


def round_length(length: float) -> float:
    """The greatest of 1, 2, 5 times a power of ten that is no longer."""
    power = 10.0 ** math.floor(math.log10(length))
    return max(each * power for each in (1, 2, 5) if each * power <= length * (1 + 1e-9))


def format_length(length: float) -> str:
    """0.05 -> 5 cm."""
    unit = next((each for each in PREFIXES if length >= each * (1 - 1e-9)), 1e-6)
    return f"{length / unit:.4g} {PREFIXES[unit]}"


def format_number(value: float) -> str:
    """As short as it may be."""
    return f"{value:.3g}".replace("e+0", "e").replace("e-0", "e-").replace("e+", "e").replace("-", "\u2212")


def format_time(t: float) -> str:
    """1.2e-4 -> t = 120 µs."""
    for unit, name in ((1.0, "s"), (1e-3, "ms"), (1e-6, "µs")):
        if abs(t) >= unit * (1 - 1e-9) or name == "µs":
            break
    return f"t = {t / unit:.4g} {name}" if t else "t = 0 s"


def _bar(pen: _Pen, legend: ColourLegend) -> None:
    """At the lower edge, in the middle."""
    from PIL import Image

    image, draw, unit = pen.image, pen.draw, pen.unit
    width, height = round(0.4 * image.width), unit
    x, y = (image.width - width) // 2, round(image.height - 2.9 * unit)
    low, high = legend.limits
    row = map_colours(np.linspace(low, high, width), (low, high), "#000000")
    image.paste(Image.fromarray(np.tile(row, (height, 1, 1))), (x, y))
    draw.rectangle((x - 1, y - 1, x + width, y + height), outline=PALE)
    pen.write((x + width / 2, y - 0.4 * unit), legend.title, anchor="mb")
    for share in np.linspace(0, 1, TICKS):
        at = x + share * (width - 1)
        draw.line((at, y + height, at, y + height + unit / 4), INK)
        pen.write((at, y + height + 0.4 * unit), format_number(low + share * (high - low)), anchor="mt")


def _keys(pen: _Pen, keys: Sequence[tuple[str, str]], right: float, bottom: float) -> None:
    """One above the other, in the lower right corner."""
    draw, unit = pen.draw, pen.unit
    wide = max(draw.textlength(text, _font(unit)) for _, text in keys)
    for row, (colour, text) in enumerate(reversed(keys)):
        y = bottom - 1.5 * row * unit
        draw.rectangle((right - wide - 1.6 * unit, y - unit, right - wide - 0.6 * unit, y), colour, PALE)
        pen.write((right - wide, y), text, anchor="lb")


@cache
def _font(size: int) -> Any:
    import matplotlib
    from PIL import ImageFont

    return ImageFont.truetype(str(Path(matplotlib.get_data_path()) / "fonts/ttf/DejaVuSans.ttf"), size)
