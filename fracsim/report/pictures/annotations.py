"""Title, time, scale bar and legend, drawn on the pixels of a picture in the same style at every size."""

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
Directions = npt.NDArray[np.float64]
Colour = tuple[int, int, int]


@dataclass(frozen=True)
class TextStyle:
    """Style of text and scales.

    Attributes:
        ink: colour of text on a light ground.
        pale: colour of less important text on a light ground.
        light: colour of text on a dark ground.
        white_ground: a ground nowhere darker than this, of 255, carries pale text.
        light_ground: a ground nowhere darker than this, of 255, carries dark text without an outline.
        font_height: height of the font, as a share of the height of the picture.
        ticks: number of ticks of the colour legend.
        axis_length: length of an axis across the line of sight, in heights of the font.
        shortest_axis: sine of the angle to the line of sight below which an axis is not drawn.
        axis_colours: colours of the axes x, y, z.
    """

    ink: Colour = (34, 38, 44)
    pale: Colour = (104, 110, 118)
    light: Colour = (244, 246, 248)
    white_ground: int = 230
    light_ground: int = 150
    font_height: float = 1.0 / 45.0
    ticks: int = 5
    axis_length: float = 3.0
    shortest_axis: float = 0.1
    axis_colours: tuple[str, ...] = ("#c0392b", "#2e8b57", "#2c5fa8")


STYLE = TextStyle()
_LENGTH_UNITS = {1e3: "km", 1.0: "m", 1e-2: "cm", 1e-3: "mm", 1e-6: "µm"}


@dataclass(frozen=True)
class ColourLegend:
    """Legend of the colours of a field.

    Attributes:
        title: name of the field, with its unit.
        limits: range of the colours, in that unit.
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
    axes: Directions | None = None,
) -> Pixels:
    """Picture (height, width, 3) with annotations.

    Args:
        pixels: picture (height, width, 3).
        title: title in the upper left corner.
        time: text below the title.
        pixel: width of a pixel, m; 0 for no scale bar.
        legend: legend of a field.
        keys: pairs (colour, text), shown if there is no legend.
        axes: directions (3, 2) of x, y and z on the picture, to the right and upwards; None: not shown.
    """
    from PIL import Image, ImageDraw

    image = Image.fromarray(pixels)
    unit = max(9, round(STYLE.font_height * image.height))
    pen = _Pen(image, ImageDraw.Draw(image), unit)
    edge, bottom = unit, image.height - unit
    if title:
        pen.write((edge, edge), title, large=True)
    pen.write((edge, edge + (1.9 * unit if title else 0)), time, STYLE.pale if title else STYLE.ink)
    if legend is not None:
        _draw_legend(pen, legend)
    elif keys:
        _draw_keys(pen, keys, image.width - edge, bottom)
    if pixel > 0:
        length = round_length(0.16 * image.width * pixel)
        x, y = edge, bottom
        pen.bar((x, y - max(2, unit // 6), x + round(length / pixel), y))
        pen.write((x, y - 1.7 * unit), format_length(length))
    if axes is not None:
        _draw_axes(pen, axes)
    return np.asarray(image)


class _Pen:
    """Pen whose text is readable on any ground.

    Text is light on a dark ground, has an outline on a ground that is dark in places, and is plain ink otherwise.

    Attributes:
        image, draw: image and drawing context of Pillow.
        unit: height of the font, pixels.
    """

    def __init__(self, image: Any, draw: Any, unit: int) -> None:
        self.image, self.draw, self.unit = image, draw, unit

    def write(
        self,
        at: tuple[float, float],
        text: str,
        ink: Colour = STYLE.ink,
        *,
        anchor: str = "la",
        large: bool = False,
    ) -> None:
        """Write a line of text at a point (x, y) in pixels; `anchor` is that of Pillow."""
        font = _font(round(1.25 * self.unit) if large else self.unit)
        darkest, median = self._ground_brightness(self.draw.textbbox(at, text, font, anchor))
        if darkest >= STYLE.light_ground:
            self.draw.text(at, text, ink if darkest >= STYLE.white_ground else STYLE.ink, font, anchor)
        else:
            ink, outline = _contrasting_colours(median)
            width = max(1, self.unit // 8)
            self.draw.text(at, text, ink, font, anchor, stroke_width=width, stroke_fill=outline)

    def bar(self, box: tuple[float, float, float, float]) -> None:
        """Draw the bar of a scale in a box (left, top, right, bottom) in pixels."""
        darkest, median = self._ground_brightness(box)
        self.draw.rectangle(box, *((STYLE.ink,) if darkest >= STYLE.light_ground else _contrasting_colours(median)))

    def _ground_brightness(self, box: tuple[float, float, float, float]) -> tuple[float, float]:
        """Least and median brightness of the pixels in a box, 0 to 255."""
        ground = np.asarray(self.image.crop(tuple(round(side) for side in box)).convert("L"))
        return (float(ground.min()), float(np.median(ground))) if ground.size else (255.0, 255.0)


def _contrasting_colours(ground: float) -> tuple[Colour, Colour]:
    """Colours of text and its outline on a ground of this brightness, 0 to 255."""
    return (STYLE.ink, STYLE.light) if ground >= STYLE.light_ground else (STYLE.light, STYLE.ink)


def round_length(length: float) -> float:
    """Largest of 1, 2, 5 times a power of ten that is not longer."""
    power = 10.0 ** math.floor(math.log10(length))
    return max(digit * power for digit in (1, 2, 5) if digit * power <= length * (1 + 1e-9))


def format_length(length: float) -> str:
    """Length in m with a suitable unit, as in "5 cm" for 0.05."""
    unit = next((size for size in _LENGTH_UNITS if length >= size * (1 - 1e-9)), 1e-6)
    return f"{length / unit:.4g} {_LENGTH_UNITS[unit]}"


def format_number(value: float) -> str:
    """Number with three digits, without needless characters of its exponent."""
    return f"{value:.3g}".replace("e+0", "e").replace("e-0", "e-").replace("e+", "e").replace("-", "\u2212")


def format_time(t: float) -> str:
    """Time in s with a suitable unit, as in "t = 120 µs" for 1.2e-4."""
    for unit, name in ((1.0, "s"), (1e-3, "ms"), (1e-6, "µs")):
        if abs(t) >= unit * (1 - 1e-9) or name == "µs":
            break
    return f"t = {t / unit:.4g} {name}" if t else "t = 0 s"


def _draw_legend(pen: _Pen, legend: ColourLegend) -> None:
    """Draw the colour legend at the centre of the lower edge."""
    from PIL import Image

    image, draw, unit = pen.image, pen.draw, pen.unit
    width, height = round(0.4 * image.width), unit
    x, y = (image.width - width) // 2, round(image.height - 2.9 * unit)
    low, high = legend.limits
    row = map_colours(np.linspace(low, high, width), (low, high), "#000000")
    image.paste(Image.fromarray(np.tile(row, (height, 1, 1))), (x, y))
    draw.rectangle((x - 1, y - 1, x + width, y + height), outline=STYLE.pale)
    pen.write((x + width / 2, y - 0.4 * unit), legend.title, anchor="mb")
    for share in np.linspace(0, 1, STYLE.ticks):
        tick = x + share * (width - 1)
        draw.line((tick, y + height, tick, y + height + unit / 4), STYLE.ink)
        pen.write((tick, y + height + 0.4 * unit), format_number(low + share * (high - low)), anchor="mt")


def _draw_axes(pen: _Pen, axes: Directions) -> None:
    """Draw the directions (k, 2) of the axes with their names in the upper right corner."""
    length = STYLE.axis_length * pen.unit
    x, y = pen.image.width - 1.6 * length, 1.6 * length
    for name, colour, right, up in zip("xyz", STYLE.axis_colours, axes[:, 0], axes[:, 1], strict=False):
        if math.hypot(right, up) < STYLE.shortest_axis:
            continue
        pen.draw.line((x, y, x + length * right, y - length * up), colour, max(2, pen.unit // 8))
        beyond = length + 0.7 * pen.unit
        pen.write((x + beyond * right, y - beyond * up), name, anchor="mm")


def _draw_keys(pen: _Pen, keys: Sequence[tuple[str, str]], right: float, bottom: float) -> None:
    """Draw pairs (colour, text) one above the other in the lower right corner, in pixels."""
    draw, unit = pen.draw, pen.unit
    width = max(draw.textlength(text, _font(unit)) for _, text in keys)
    for row, (colour, text) in enumerate(reversed(keys)):
        y = bottom - 1.5 * row * unit
        draw.rectangle((right - width - 1.6 * unit, y - unit, right - width - 0.6 * unit, y), colour, STYLE.pale)
        pen.write((right - width, y), text, anchor="lb")


@cache
def _font(size: int) -> Any:
    """DejaVu Sans, which comes with matplotlib, with a height in pixels."""
    import matplotlib
    from PIL import ImageFont

    return ImageFont.truetype(str(Path(matplotlib.get_data_path()) / "fonts/ttf/DejaVuSans.ttf"), size)
