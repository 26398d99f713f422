"""Named sets of cells, and sets from integer tags or strings on the cells.

A set has, for each block of cells, the numbers of the cells of that block that belong to it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sized
from typing import Any

import numpy as np
import numpy.typing as npt

from .data import Indices
from .mesh_conversion import Block

Array = npt.NDArray[Any]

# Cell arrays in which formats store groups, in order of preference; the value 0 means "no group" in all of them.
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
REGION_ARRAYS = ("region", "material")  # usual names, upper or lower case; here the value 0 is a region too
NOT_TAGS = ("gmsh:geometrical", "vtkGhostType", "ObjectId")
MAX_TAGS = 1000  # distinct values; an integer array with more of them is a numbering of the cells


def add_to_set(sets: dict[str, list[Indices]], blocks: Sized, name: str, block: int, members: Indices) -> None:
    """Add cells of one block to the set of a name, which is created if it does not exist."""
    parts = sets.setdefault(name, [np.zeros(0, np.int64) for _ in range(len(blocks))])
    parts[block] = np.union1d(parts[block], members).astype(np.int64) if len(parts[block]) else members


def tag_sets(
    cell_data: dict[str, list[Any]], blocks: list[Block], names_of: Callable[[int, int], list[str]]
) -> tuple[dict[str, list[Indices]], tuple[str, ...], tuple[str, ...]]:
    """Sets of cells from one array of tags, the names of all arrays of tags, and notes.

    Args:
        cell_data: name -> for each block an array with one value a cell; integers are tags, strings are set names.
        blocks: the cells.
        names_of: set names of a tag and a dimension.
    """
    arrays = {key: parts for key, values in cell_data.items() if (parts := _tags(key, values)) is not None}
    chosen = _preferred(arrays)
    if chosen is None:
        return {}, (), ()
    unused = [key for key in arrays if key != chosen]
    notes = (f"Groups come from the cell array '{chosen}'; not used: {', '.join(unused)}.",) if unused else ()
    top = max((block.dim for block in blocks if len(block.nodes)), default=0)
    sets: dict[str, list[Indices]] = {}
    for i, (block, tags) in enumerate(zip(blocks, arrays[chosen], strict=True)):
        for tag in np.unique(tags):
            if tag == 0 and (chosen in TAG_ARRAYS or block.dim < top):
                continue
            for name in [str(tag)] if tags.dtype.kind == "U" else names_of(int(tag), block.dim):
                if name:
                    add_to_set(sets, blocks, name, i, np.flatnonzero(tags == tag))
    return sets, tuple(arrays), notes


def _preferred(arrays: dict[str, list[Array]]) -> str | None:
    """Name of the array that becomes the sets: by TAG_ARRAYS, then by REGION_ARRAYS, else the first."""
    by_name = {key.casefold(): key for key in reversed(arrays)}
    for key in TAG_ARRAYS:
        if key in arrays:
            return key
    return next((by_name[key] for key in REGION_ARRAYS if key in by_name), next(iter(arrays), None))


def _tags(key: str, values: list[Any]) -> list[Array] | None:
    """The array of each block if they hold tags, else None.

    Tags are integers or strings, one a cell, with at most MAX_TAGS distinct values. Integers stored as floats are
    tags if the array has a name of REGION_ARRAYS.
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
    """Each distinct value other than 0 and the indices at which it stands."""
    order = np.argsort(values, kind="stable").astype(np.int64)
    distinct, first = np.unique(values[order], return_index=True)
    for tag, members in zip(map(int, distinct), np.split(order, first[1:]), strict=False):
        if tag:
            yield tag, members


def sets_by_tag(
    tags: list[Indices], name_of: Callable[[int, int], str], what: str
) -> tuple[dict[str, list[Indices]], tuple[str, ...]]:
    """Sets of cells from one integer tag a cell, 0 for none; and notes.

    Args:
        tags: for each block one tag a cell.
        name_of: name of a tag in a block; where it is "" the set is called "tag-<n>".
        what: plural of the tags' meaning, for the note that more than MAX_TAGS tags without a name are not used.
    """
    sets: dict[str, list[Indices]] = {}
    unnamed: set[int] = set()
    for i, values in enumerate(tags):
        for tag, members in members_by_tag(values):
            name = name_of(tag, i)
            if not name:
                unnamed.add(tag)
                name = f"tag-{tag}"
            add_to_set(sets, tags, name, i, members)
    if len(unnamed) <= MAX_TAGS:
        return sets, ()
    named = {name: parts for name, parts in sets.items() if name not in {f"tag-{tag}" for tag in unnamed}}
    return named, (f"Not used: {len(unnamed)} {what} without a name, too many to mean groups of cells.",)
