"""Sets of cells from an array on the cells: integer tags, or names."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import numpy.typing as npt

from .data import Indices
from .mesh_conversion import Block

Array = npt.NDArray[Any]

# Arrays by which formats mark groups of cells; the first that the file has is used. 0 means "no group" in all of them.
TAG_ARRAYS = (
    "gmsh:physical",
    "group",
    "medit:ref",
    "cell_tags",
    "nastran:ref",
    "netgen:index",
    "su2:tag",
    "tetgen:ref",
)
REGION_ARRAYS = ("region", "material")  # as people call them, in any case; 0 is a region like any other
NOT_TAGS = ("gmsh:geometrical", "vtkGhostType", "ObjectId")
MAX_TAGS = 1000  # an integer array with more values than this numbers cells; it does not group them


def tag_sets(
    cell_data: dict[str, list[Any]], blocks: list[Block], names_of: Callable[[int, int], list[str]]
) -> tuple[dict[str, list[Indices]], tuple[str, ...], tuple[str, ...]]:
    """Sets of cells by one array of tags, the names of all arrays that could be such, and notes.

    Arguments:
        cell_data: name -> for each block an array with one value a cell; integers are tags, strings are names.
        names_of: names of the sets of a tag and a dimension.
    """
    arrays = {key: parts for key, values in cell_data.items() if (parts := _tags(key, values)) is not None}
    chosen = _chosen(arrays)
    if chosen is None:
        return {}, (), ()
    remaining = [key for key in arrays if key != chosen]
    notes = (f"Groups come from the cell array '{chosen}'; not used: {', '.join(remaining)}.",) if remaining else ()
    top = max((block.dim for block in blocks if len(block.nodes)), default=0)
    sets: dict[str, list[Indices]] = {}
    for i, (block, tags) in enumerate(zip(blocks, arrays[chosen], strict=True)):
        for tag in np.unique(tags):
            if tag == 0 and (chosen in TAG_ARRAYS or block.dim < top):
                continue
            for name in [str(tag)] if tags.dtype.kind == "U" else names_of(int(tag), block.dim):
                if name:
                    sets.setdefault(name, [np.zeros(0, np.int64) for _ in blocks])[i] = np.flatnonzero(tags == tag)
    return sets, tuple(arrays), notes


def _chosen(arrays: dict[str, list[Array]]) -> str | None:
    by_name = {key.casefold(): key for key in reversed(arrays)}
    for key in TAG_ARRAYS:
        if key in arrays:
            return key
    return next((by_name[key] for key in REGION_ARRAYS if key in by_name), next(iter(arrays), None))


def _tags(key: str, values: list[Any]) -> list[Array] | None:
    """The parts of an array that holds tags: integers or strings, one a cell, of few values; None of any other.

    Whole numbers in an array of floats are tags where the array has the name of one.
    """
    parts = [np.asarray(part) for part in values]
    if key in NOT_TAGS or any(part.ndim != 1 for part in parts):
        return None
    if key.casefold() in REGION_ARRAYS and all(part.dtype.kind == "f" for part in parts):
        if not all(np.all(np.abs(part) < 2**53) and np.all(part == np.rint(part)) for part in parts):
            return None
        parts = [part.astype(np.int64) for part in parts]
    if any(part.dtype.kind not in "iuU" for part in parts):
        return None
    return parts if not parts or len(np.unique(np.concatenate(parts))) <= MAX_TAGS else None


def members_by_tag(values: Indices) -> Iterator[tuple[int, Indices]]:
    """Numbers other than 0, and the places of each."""
    order = np.argsort(values, kind="stable").astype(np.int64)
    distinct, first = np.unique(values[order], return_index=True)
    for tag, members in zip(map(int, distinct), np.split(order, first[1:]), strict=False):
        if tag:
            yield tag, members


def sets_by_tag(
    tags: list[Indices], name_of: Callable[[int, int], str], what: str
) -> tuple[dict[str, list[Indices]], tuple[str, ...]]:
    """Sets of cells by one whole number a cell, 0 for none; and notes.

    Arguments:
        tags: for each block one number a cell.
        name_of: the name of a number in a block, "" where it has none: it is called "tag-7" then.
        what: the numbers in words, for a note where those without a name are too many to mean groups.
    """
    sets: dict[str, list[Indices]] = {}
    unnamed: set[int] = set()
    for i, values in enumerate(tags):
        for tag, members in members_by_tag(values):
            name = name_of(tag, i)
            if not name:
                unnamed.add(tag)
                name = f"tag-{tag}"
            parts = sets.setdefault(name, [np.zeros(0, np.int64) for _ in tags])
            parts[i] = np.union1d(parts[i], members).astype(np.int64) if len(parts[i]) else members
    if len(unnamed) <= MAX_TAGS:
        return sets, ()
    numbers = {f"tag-{tag}" for tag in unnamed}
    retained = {name: parts for name, parts in sets.items() if name not in numbers}
    return retained, (f"Not used: {len(unnamed)} {what} without a name, too many to mean groups of cells.",)
