"""Text of a mesh file with the numbers of its lines, and lines of numbers as arrays."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
import numpy.typing as npt

from .data import Indices, MeshError

SHOWN = 60  # characters of a line in a message
_SPACE = np.zeros(256, bool)
_SPACE[[9, 10, 11, 12, 13, 32]] = True
_TO_FLOAT = bytes.maketrans(b"Dd", b"ee")  # Fortran's exponents


@dataclass(frozen=True, eq=False)
class SourceText:
    """The bytes of a file, its lines ended by a line feed."""

    path: Path
    text: bytes

    def line(self, offset: int) -> int:
        """Number of the line, from 1, at an offset."""
        return self.text.count(b"\n", 0, offset) + 1

    def refuse(self, offset: int, message: str) -> NoReturn:
        """Raises MeshError with file and line."""
        raise MeshError(f"Mesh file '{self.path}', line {self.line(offset)}: {message}")

    def damaged(self, offset: int, message: str) -> NoReturn:
        """Raises MeshError with file and line, and what to do with a damaged file."""
        self.refuse(offset, f"{message} {EXPORT_AGAIN}")

    def rows(self, begin: int, end: int, needed: str) -> Rows:
        """The numbers of the lines from one offset to another; MeshError names the line with anything else.

        `needed`: what a line holds, for the message: "a node is `number x y z`".
        """
        text = self.text[begin:end]
        values = parse_numbers(text)
        starts = _token_starts(text)
        if values is None or len(values) != len(starts):
            self._refuse_row(begin, end, needed)
        symbols = np.frombuffer(text, np.uint8)
        line_ends = np.append(np.flatnonzero(symbols == ord("\n")), len(symbols))
        ends = np.searchsorted(starts, line_ends)
        begins = np.concatenate([[0], ends[:-1]])
        offsets = np.concatenate([[0], line_ends[:-1] + 1]) + begin
        used = ends > begins  # lines that are not blank
        return Rows(values, begins[used].astype(np.int64), ends[used].astype(np.int64), offsets[used].astype(np.int64))

    def _refuse_row(self, begin: int, end: int, needed: str) -> NoReturn:
        while begin < end:
            stop = self.text.find(b"\n", begin, end)
            stop = end if stop < 0 else stop
            line = self.text[begin:stop]
            values = parse_numbers(line)
            if values is None or len(values) != len(_token_starts(line)):
                self.damaged(begin, f"`{shown(line)}` is not what stands here: {needed}.")
            begin = stop + 1
        raise AssertionError(needed)


EXPORT_AGAIN = "The file is damaged; export it again."


@dataclass(frozen=True, eq=False)
class Rows:
    """Lines of numbers, one after another.

    Attributes:
        values: all numbers.    begins, ends: (n,) of each line that is not blank, among the values.
        offsets: (n,) where the line begins in the file.
    """

    values: npt.NDArray[np.float64]
    begins: Indices
    ends: Indices
    offsets: Indices

    def __len__(self) -> int:
        return len(self.begins)

    @property
    def counts(self) -> Indices:
        return self.ends - self.begins

    def columns(self, rows: Any, count: int) -> npt.NDArray[np.float64]:
        """(k, count) the first numbers of some lines, which have as many."""
        return self.values[self.begins[rows][:, None] + np.arange(count)]


def parse_numbers(text: bytes) -> npt.NDArray[np.float64] | None:
    """All numbers of a text of blanks and numbers; None where something else stands there."""
    if not text.strip():
        return np.zeros(0)
    if b"D" in text or b"d" in text:
        text = text.translate(_TO_FLOAT)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            values: npt.NDArray[np.float64] = np.fromstring(text, sep=" ", dtype=np.float64)
            return values
    except (ValueError, OverflowError, DeprecationWarning):
        return None


def _token_starts(text: bytes) -> Indices:
    """Offsets at which words begin."""
    if not text:
        return np.zeros(0, np.int64)
    space = _SPACE[np.frombuffer(text, np.uint8)]
    starts: Indices = np.flatnonzero(~space & np.concatenate([[True], space[:-1]])).astype(np.int64)
    return starts


def is_not_integer(values: npt.NDArray[np.float64]) -> npt.NDArray[np.bool_]:
    """Which numbers are no whole numbers that 64 bits hold exactly; nan and inf are none."""
    wrong: npt.NDArray[np.bool_] = (values != np.rint(values)) | (np.abs(values) > 2**53)
    return wrong


def shown(line: bytes) -> str:
    """The beginning of the first line, for a message."""
    return line.strip().split(b"\n")[0][:SHOWN].decode("utf-8", "replace").rstrip()


def decode_text(text: bytes) -> str:
    """Text in UTF-8, or else in Windows' Latin alphabet."""
    try:
        return text.decode()
    except UnicodeDecodeError:
        return text.decode("cp1252", errors="replace")


def numbered(ids: Indices, wanted: Indices) -> Indices:
    """Place of each wanted number among `ids`, which differ; -1 where it is not there."""
    if not len(ids):
        return np.full(wanted.shape, -1, np.int64)
    order = np.argsort(ids, kind="stable") if (np.diff(ids) <= 0).any() else np.arange(len(ids))
    position = np.minimum(np.searchsorted(ids, wanted, sorter=order), len(ids) - 1)
    result: Indices = order[position]
    return np.where(ids[result] == wanted, result, -1)
