"""Named groups and regions of a mesh, as a study calls them. No DOLFINx here."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from ..errors import InputError


def check_group(name: str, known: Iterable[str], key: str) -> None:
    """InputError where the mesh has no facet group of that name; `key`: where the study has it."""
    known = sorted(known)
    if name not in known:
        raise InputError(f'{key} = "{name}": the mesh has no such facet group; it has: {", ".join(known) or "none"}')


def check_regions(names: Iterable[str], known: Sequence[str]) -> None:
    """InputError for a [material.NAME] that the mesh does not have."""
    for name in names:
        if name not in known:
            regions = ", ".join(known) or "none"
            raise InputError(f"material.{name}: the mesh has no region of that name; it has: {regions}")
