"""Units with the prefix that suits a value, for axes and legends."""

from __future__ import annotations

import math

# prefixes by their power of 1,000
_PREFIXES = {-4: "p", -3: "n", -2: "µ", -1: "m", 0: "", 1: "k", 2: "M", 3: "G"}


def readable_unit(unit: str, largest: float) -> tuple[str, float]:
    """Unit whose numbers have one to three digits before the point at a value, and the SI value of one such unit.

    Args:
        unit: SI unit; "" for numbers without a unit, which have no prefix.
        largest: the value, in SI units.
    """
    if not unit or not 0 < largest < math.inf:
        return unit, 1.0
    power = min(max(math.floor(math.log10(largest) / 3 + 1e-9), min(_PREFIXES)), max(_PREFIXES))
    return _PREFIXES[power] + unit, 1000.0**power
