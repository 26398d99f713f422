"""surface.pvd: which files are shown at which time. Part 0 is the body, the others what is drawn beside it."""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from ...errors import InputError
from ...meshes.plain_files import check_readable
from ..file_ownership import FRAME

_HEAD = '<?xml version="1.0"?>\n<VTKFile type="Collection" version="0.1">\n  <Collection>\n'
_TAIL = "  </Collection>\n</VTKFile>\n"
_ENTRY = re.compile(r'timestep="([^"]+)"(?: part="(\d+)" name="([^"]+)")? file="([^"]+)"')
BODY = "body"
FRAMES = "surface/"  # where files lie


@dataclass(frozen=True)
class Entry:
    """A file and when it is shown.

    Attributes:
        t: s.    file: relative to the folder.    part: 0 the body.    name: of the part.
    """

    t: float
    file: str
    part: int = 0
    name: str = BODY


def collection_text(entries: Iterable[Entry]) -> str:
    """The file. Parts of a time become the blocks of one data set, by their names; a body alone is a plain one."""
    entries = list(entries)
    blocks = any(entry.part for entry in entries)
    return _HEAD + "".join(_line(entry, blocks) for entry in entries) + _TAIL


def _line(entry: Entry, blocks: bool) -> str:
    part = f'part="{entry.part}" name="{entry.name}" ' if blocks else ""
    return f'    <DataSet timestep="{entry.t:.12g}" {part}file="{entry.file}"/>\n'


def read_entries(pvd: Path) -> list[Entry]:
    """All that is shown. InputError where it names what no run writes: VTK would read any file, by its ending."""
    check_readable(pvd)
    found = _ENTRY.findall(pvd.read_text())
    for *_, file in found:
        if not (file.startswith(FRAMES) and FRAME.fullmatch(file.removeprefix(FRAMES))):
            raise InputError(f"{pvd} names the file {file}, which no run of fracsim writes")
    return [Entry(float(t), file, int(part or 0), name or BODY) for t, part, name, file in found]


def read_collection(pvd: Path) -> list[tuple[float, str]]:
    """(time in s, file relative to the folder) of every frame of the body."""
    return [(entry.t, entry.file) for entry in read_entries(pvd) if not entry.part]
