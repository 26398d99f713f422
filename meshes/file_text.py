"""Text of mesh files: line numbers for error messages, lines of numbers as arrays."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
import numpy.typing as npt

from .data import Indices, MeshError

EXPORT_AGAIN = "The file is damaged; export it again."
_SPACE = np.isin(np.arange(256), list(b" \t\n\v\f\r"))  # (256,) whether each byte is white space
_TO_FLOAT = bytes.maketrans(b"Dd", b"ee")  # Fortran writes 1.5D-3


def refuse_file(path: Path, reason: str, advice: str = EXPORT_AGAIN) -> NoReturn:
    """Raises MeshError: the file, why it could not be read (without a full stop), and how to export it."""
    raise MeshError(f"Mesh file '{path}' could not be read: {reason}. {advice}")


def refuse_line(path: Path, line: int, message: str) -> NoReturn:
    """Raises MeshError with the file and a line of it, counted from 1."""
    raise MeshError(f"Mesh file '{path}', line {line}: {message}")


def read_text(path: Path) -> bytes:
    """The bytes of a file with every line ended by a line feed."""
    return with_line_feeds(path.read_bytes())


def with_line_feeds(text: bytes) -> bytes:
    """The text with a line feed at the end of each line, in place of CR LF or CR."""
    return text.replace(b"\r\n", b"\n").replace(b"\r", b"\n") if b"\r" in text else text


@dataclass(frozen=True, eq=False)
class SourceText:
    """The bytes of a file, its lines ended by a line feed."""

    path: Path
    text: bytes

    def line(self, offset: int) -> int:
        """Number of the line at an offset, counted from 1."""
        return self.text.count(b"\n", 0, offset) + 1

    def refuse(self, offset: int, message: str) -> NoReturn:
        """Raises MeshError with file and line."""
        refuse_line(self.path, self.line(offset), message)

    def damaged(self, offset: int, message: str) -> NoReturn:
        """Raises MeshError with file and line, and what to do with a damaged file."""
        self.refuse(offset, f"{message} {EXPORT_AGAIN}")

    def rows(self, begin: int, end: int, expected: str) -> Rows:
        """The numbers of the lines between two offsets.

        Args:
            begin: offset of the first byte.
            end: offset behind the last byte.
            expected: content of a line, for the message: "a node is `number x y z`".

        Raises:
            MeshError: a line holds anything else than numbers; the message names the line.
        """
        text = self.text[begin:end]
        values = parse_numbers(text)
        starts = _token_starts(text)
        if values is None or len(values) != len(starts):
            self._refuse_row(begin, end, expected)
        # tokens and numbers are as many: each token is a number, and its line is known by its offset
        symbols = np.frombuffer(text, np.uint8)
        line_ends = np.append(np.flatnonzero(symbols == ord("\n")), len(symbols))
        ends = np.searchsorted(starts, line_ends)
        begins = np.concatenate([[0], ends[:-1]])
        offsets = np.concatenate([[0], line_ends[:-1] + 1]) + begin
        filled = ends > begins  # lines that are not blank
        return Rows(values, *(array[filled].astype(np.int64) for array in (begins, ends, offsets)))

    def integers(self, values: npt.NDArray[np.float64], offsets: Indices, expected: str) -> Indices:
        """The numbers (n, ...) of n lines as integers; MeshError names the first line with another number."""
        wrong = is_not_integer(values).reshape(len(values), -1).any(axis=1) if values.size else np.zeros(0, bool)
        if wrong.any():
            self.damaged(int(offsets[wrong.argmax()]), f"a number of this line is not whole; {expected}.")
        integers: Indices = values.astype(np.int64)
        return integers

    def _refuse_row(self, begin: int, end: int, expected: str) -> NoReturn:
        """Raises MeshError at the first line that holds anything else than numbers."""
        while begin < end:
            stop = self.text.find(b"\n", begin, end)
            stop = end if stop < 0 else stop
            line = self.text[begin:stop]
            values = parse_numbers(line)
            if values is None or len(values) != len(_token_starts(line)):
                self.damaged(begin, f"`{excerpt(line)}` is not what stands here: {expected}.")
            begin = stop + 1
        raise AssertionError(expected)


@dataclass(frozen=True, eq=False)
class Rows:
    """Numbers of n lines that are not blank.

    Attributes:
        values: the numbers of all lines in one array.
        begins: (n,) index in `values` of the first number of each line.
        ends: (n,) index behind the last number of each line.
        offsets: (n,) offset of each line in the file.
    """

    values: npt.NDArray[np.float64]
    begins: Indices
    ends: Indices
    offsets: Indices

    def __len__(self) -> int:
        return len(self.begins)

    @property
    def counts(self) -> Indices:
        """(n,) numbers on each line."""
        return self.ends - self.begins

    def columns(self, rows: Any, count: int) -> npt.NDArray[np.float64]:
        """(k, count) the first `count` numbers of the chosen lines, none of which is shorter."""
        return self.values[self.begins[rows][:, None] + np.arange(count)]


def parse_numbers(text: bytes) -> npt.NDArray[np.float64] | None:
    """The numbers of a text that consists of numbers and white space; None of any other text."""
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
    """Offsets of the first byte of each token."""
    if not text:
        return np.zeros(0, np.int64)
    space = _SPACE[np.frombuffer(text, np.uint8)]
    starts: Indices = np.flatnonzero(~space & np.concatenate([[True], space[:-1]])).astype(np.int64)
    return starts


def is_not_integer(values: npt.NDArray[np.float64]) -> npt.NDArray[np.bool_]:
    """Whether each number is no integer that a double holds exactly (at most 2^53); true of nan and inf."""
    wrong: npt.NDArray[np.bool_] = (values != np.rint(values)) | (np.abs(values) > 2**53)
    return wrong


def excerpt(text: bytes) -> str:
    """The first line of a text, cut to 60 characters, for a message."""
    return text.strip().split(b"\n")[0][:60].decode("utf-8", "replace").rstrip()


def decode_text(text: bytes) -> str:
    """The text, decoded as UTF-8, or as Windows-1252 where it is not UTF-8."""
    try:
        return text.decode()
    except UnicodeDecodeError:
        return text.decode("cp1252", errors="replace")
