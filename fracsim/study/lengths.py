"""Whether strength, mesh and body fit together: what `fracsim check` says of them beside cracks that take an energy
(tearing)."""

from __future__ import annotations

from collections.abc import Iterator

from . import Study
from .body import Region
from .materials import MATERIALS
from .tearing import plane_modulus

DISC = 6.0  # h that a tip needs around it
FAR = 3.0  # times that an energy may be off without a word


def fits(study: Study, least: float) -> Iterator[str]:
    """Notes on what does not fit together; `least`: the body's least side, m."""
    table = study.fracture
    if table is None or study.brittle is not None:
        return
    h = study.mesh.parameters.get("h")
    h = float(h) if isinstance(h, int | float) and not isinstance(h, bool) else None
    if table.strength > 0.1 * study.material.young and table.strength < float("inf"):
        yield f"note: strength is {table.strength / study.material.young:.2g} of young: only rubber is that strong"
    if table.energy is None:
        yield from _spent(study, plane_modulus(study, Region()), table.radius or h)
        return
    if table.law == "griffith" and h is not None and least < 2 * DISC * h:
        most = least / 2 / DISC
        yield f"note: tips need {DISC:g} h on every side, the body is {least / h:.3g} h across: h below {most:.2g} m"


def _spent(study: Study, stiff: float, cell: float | None) -> Iterator[str]:
    """What single edges take: the energy of a row of cells at their strength, f_t^2 h / 2 E', whatever G_c is."""
    table, like = study.fracture, study.material.like
    assert table is not None
    if cell is None or not table.strength < float("inf"):
        return
    spent = table.strength**2 * cell / (2 * stiff)
    of = MATERIALS[like].energy if like is not None else None
    word = "radius" if table.radius else "h"
    yield f"edges break one by one: a crack takes some f_t^2 {word} / 2 E' = {spent:.2g} J/m^2, as much as h has it"
    if of is not None and not of / FAR < spent < of * FAR:
        yield (
            f"note: {like} takes {of:g} J/m^2: give fracture.energy = true (2D), or {word} = "
            f"{2 * stiff * of / table.strength**2:.2g} m"
        )
