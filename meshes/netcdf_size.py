"""The size of a netCDF classic file by its header: netCDF's library reads zeros beyond the end of a file.

Format: "NetCDF Classic Format Specification", Unidata; CDF-1, CDF-2 and CDF-5.
"""

from __future__ import annotations

import mmap
import struct
from pathlib import Path

_WIDTHS = {1: 1, 2: 1, 3: 2, 4: 4, 5: 4, 6: 8, 7: 1, 8: 2, 9: 4, 10: 8, 11: 8}  # bytes of a value, by its type


class _Header:
    """Numbers and names one after another."""

    def __init__(self, data: mmap.mmap) -> None:
        self.data, self.at = data, 4
        self.version = data[3]

    def number(self, wide: bool) -> int:
        """An unsigned number of 8 bytes, or of 4."""
        (value,) = struct.unpack_from(">Q" if wide else ">I", self.data, self.at)
        self.at += 8 if wide else 4
        return int(value)

    def count(self) -> int:
        return self.number(self.version == 5)

    def skip(self, size: int) -> None:
        """Over bytes that are filled up to a multiple of four. struct.error beyond the end."""
        self.at += size + -size % 4
        if self.at > len(self.data):
            raise struct.error

    def entries(self) -> int:
        """The number of entries of a list."""
        self.number(False)
        return self.count()

    def skip_attributes(self) -> None:
        for _ in range(self.entries()):
            self.skip(self.count())
            kind = self.number(False)
            self.skip(_WIDTHS[kind] * self.count())


def missing_bytes(path: Path) -> int | None:
    """How many bytes a netCDF classic file is shorter than its header says; <= 0: none. None: no header."""
    with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
        try:
            return _needed(_Header(data)) - len(data)
        except (struct.error, KeyError, IndexError, OverflowError):
            return None


def _needed(header: _Header) -> int:
    """Bytes up to the end of the last value. struct.error, KeyError, IndexError where the header is damaged."""
    records = header.count()
    streaming = records == (2**64 - 1 if header.version == 5 else 2**32 - 1)
    lengths = []
    for _ in range(header.entries()):
        header.skip(header.count())
        lengths.append(header.count())
    header.skip_attributes()
    end, slabs = header.at, []
    for _ in range(header.entries()):
        header.skip(header.count())
        dimensions = [header.count() for _ in range(header.count())]
        header.skip_attributes()
        size = _WIDTHS[header.number(False)]
        header.count()  # vsize, which is not right for variables of 4 GiB and more
        begin = header.number(header.version != 1)
        shape = [lengths[i] for i in dimensions]
        for length in shape[1:] if shape and shape[0] == 0 else shape:
            size *= length
        if shape and lengths[dimensions[0]] == 0:  # the dimension of records
            slabs.append((begin, size))
        else:
            end = max(end, begin + size)
    step = slabs[0][1] if len(slabs) == 1 else sum(size + -size % 4 for _, size in slabs)
    if records and not streaming:
        end = max([end, *(begin + (records - 1) * step + size for begin, size in slabs)])
    return end
