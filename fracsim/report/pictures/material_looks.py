"""What materials look like: a colour for the skin that the body had, one for its inside that cracks lay open."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass

from ...errors import InputError

OLD, CRACK = "#b4bac4", "#e0762b"  # the old boundary and the crack, where no look and no field colours them
_COLOUR = re.compile(r"#[0-9a-fA-F]{6}")


@dataclass(frozen=True)
class MaterialLook:
    """How light comes back.

    Attributes:
        boundary_colour, crack_colour: "#rrggbb".
        gloss: 0 (dull) to 1, share of mirrored light.
        backdrop: behind all.
    """

    boundary_colour: str
    crack_colour: str
    gloss: float = 0.1
    backdrop: str = "#eef0f3"


MATERIAL_LOOKS = {
    "plain": MaterialLook(OLD, CRACK, 0.0, "#ffffff"),
    "bread": MaterialLook("#b9712c", "#f0deb6", 0.12, "#f3efe6"),
    "porcelain": MaterialLook("#f4f2ee", "#d8bf9c", 0.6, "#c9d2dc"),
    "jade": MaterialLook("#5c9c77", "#b5d9b4", 0.5, "#eef0ec"),
    "granite": MaterialLook("#86837f", "#c4b5a6", 0.1),
    "steel": MaterialLook("#76808c", "#d3d8de", 0.55),
    "wood": MaterialLook("#8b5a32", "#e0bd8b", 0.15, "#f3efe6"),
}


def material_look(look: str | Mapping[str, str]) -> MaterialLook:
    """The skin of a name, or of own colours: {"skin": "#rrggbb", "inside": "#rrggbb"}, also as "skin,inside"."""
    if isinstance(look, str) and "," not in look:
        if look not in MATERIAL_LOOKS:
            raise InputError(
                f"--look {look}: must be one of {', '.join(MATERIAL_LOOKS)}, or two colours: #b9712c,#f0deb6"
            )
        return MATERIAL_LOOKS[look]
    skin, inside = look.split(",", 1) if isinstance(look, str) else (look["skin"], look["inside"])
    if wrong := next((each for each in (skin, inside) if not _COLOUR.fullmatch(each)), None):
        raise InputError(f"--look: {wrong} is no colour; write it as #rrggbb, the skin and the inside: #b9712c,#f0deb6")
    return MaterialLook(skin, inside, 0.2)
