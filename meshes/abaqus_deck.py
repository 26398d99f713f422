"""Keyword blocks of an Abaqus input file and the files it includes: keyword, parameters and data lines.

Syntax: Abaqus Analysis User's Guide, "Input syntax rules". Keyword lines begin with a star, comments with two. Letter
case and blanks count only within quotes. A keyword line that ends with a comma continues on the next line.
"""

from __future__ import annotations

import re
import warnings
from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import islice
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
import numpy.typing as npt

from .data import Indices, MeshError
from .file_text import SourceText, decode_text, with_line_feeds
from .plain_files import unreadable_reason_beside

_BLANKS = b" \t"
_SEPARATORS_TO_BLANKS = bytes.maketrans(b",\n\t", b"   ")
_FIELD = re.compile(r'(?:"[^"]*"?|[^",])*')  # up to a comma outside quotes
_FORTRAN_EXPONENT = re.compile(r"(?<=[0-9.])[dD](?=[-+0-9])")


@dataclass(eq=False)
class KeywordBlock:
    """A keyword line and its data lines.

    Attributes:
        keyword: upper case, without blanks: "ENDPART".
        parameters: names in upper case without blanks -> values as written, without quotes.
        source: text with the keyword.
        offset: of the keyword.
        pieces: data lines (source, begin, end) between comments.
    """

    keyword: str
    parameters: dict[str, str]
    source: SourceText
    offset: int
    pieces: list[tuple[SourceText, int, int]] = field(default_factory=list)

    def refuse(self, message: str, line: int | None = None) -> NoReturn:
        """Raises MeshError that names the keyword's line, or data line `line`, counted from 0."""
        source, offset = self.source, self.offset
        if line is not None:
            source, offset, _ = next(islice(self._lines(), line, None), (source, offset, b""))
        source.refuse(offset, message)

    def _lines(self) -> Iterator[tuple[SourceText, int, bytes]]:
        """Data lines that are not blank, with their offsets."""
        for source, begin, end in self.pieces:
            while begin < end:
                stop = source.text.find(b"\n", begin, end)
                stop = end if stop < 0 else stop
                if line := source.text[begin:stop].strip():
                    yield source, begin, line
                begin = stop + 1

    def lines(self) -> Iterator[list[str]]:
        """Fields of the data lines; a comma at the end of a line ends no field."""
        for *_, line in self._lines():
            fields = [unquoted(part) for part in split_fields(decode_text(line))]
            yield fields[:-1] if len(fields) > 1 and not fields[-1] else fields

    def is_open(self) -> bool:
        """Whether a file ends within the data lines, without a line end: it may have been cut off."""
        return self._open_piece() is not None

    def _open_piece(self) -> tuple[SourceText, int] | None:
        """The text and offset at which a file ends within the data lines, without a line end."""
        for source, _, end in self.pieces:
            if end == len(source.text) and not source.text.endswith(b"\n"):
                return source, end
        return None

    def check_ended(self) -> None:
        """Raise MeshError if a file ends within the data lines, without a line end."""
        if piece := self._open_piece():
            source, end = piece
            source.refuse(
                end,
                "the file ends within this line, without a line break. Is the file whole? Export it again; where it "
                "is whole, add a line break.",
            )

    def numbers(self, kind: type[np.int64] | type[np.float64]) -> tuple[npt.NDArray[Any], Indices]:
        """All numbers of the data lines, and for each line the index behind its last number.

        Empty fields among coordinates are 0, as in Abaqus.
        """
        # by NumPy at once if every field holds one number; else field by field, so that a message can name the line
        fast = _numbers_at_once(b"".join(source.text[begin:end] for source, begin, end in self.pieces), kind)
        return fast if fast is not None else self._numbers_by_field(kind)

    def _numbers_by_field(self, kind: type[np.int64] | type[np.float64]) -> tuple[npt.NDArray[Any], Indices]:
        """The result of `numbers`; MeshError names the line of a field that holds no number."""
        values: list[float] = []
        ends = []
        for i, fields in enumerate(self.lines()):
            for text in fields:
                value = parse_number(text, kind)
                if value is None:
                    expected = "a whole number" if kind is np.int64 else "a number"
                    self.refuse(f"'{text[:40]}' is not {expected}, as the data of *{self.keyword} need.", i)
                values.append(value)
            ends.append(len(values))
        return np.array(values, kind), np.array(ends, np.int64)


def parse_number(text: str, kind: type[np.int64] | type[np.float64]) -> float | None:
    """The number that a field holds, or None."""
    # Python takes other digits and underscores for numbers, which Abaqus does not
    try:
        if kind is np.int64:
            value = int(text) if text.isascii() and "_" not in text else None
            return value if value is not None and abs(value) < 2**62 else None
        return float(_FORTRAN_EXPONENT.sub("e", text)) if text and "_" not in text else (None if text else 0.0)
    except ValueError:
        return None


def _numbers_at_once(text: bytes, kind: type[Any]) -> tuple[npt.NDArray[Any], Indices] | None:
    """The result of KeywordBlock.numbers; None unless every field holds exactly one number."""
    compact = text.translate(None, _BLANKS).strip(b"\n")
    while b"\n\n" in compact:
        compact = compact.replace(b"\n\n", b"\n")
    if not compact:
        return np.zeros(0, kind), np.zeros(0, np.int64)
    # NumPy would pass over an empty field
    if b",," in compact or b"\n," in compact or compact.startswith(b","):
        return None
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            values = np.fromstring(text.translate(_SEPARATORS_TO_BLANKS), sep=" ", dtype=kind)
    except (ValueError, OverflowError, DeprecationWarning):  # a field holds something else
        return None
    # fields up to the end of each line: its commas and those before, one more for each line without a comma at its end
    symbols = np.frombuffer(compact + b"\n", np.uint8)
    line_ends = np.flatnonzero(symbols == ord("\n"))
    separators = symbols == ord(",")
    commas = np.searchsorted(np.flatnonzero(separators), line_ends)
    open_ended = separators[line_ends - 1]
    ends = (commas + np.arange(1, len(line_ends) + 1) - np.cumsum(open_ended)).astype(np.int64)
    return (values, ends) if ends[-1] == len(values) else None


def split_fields(line: str) -> list[str]:
    """The fields between commas; a comma in quotes separates nothing."""
    if '"' not in line:
        return line.split(",")
    fields, begin = [], 0
    while begin <= len(line):
        match = _FIELD.match(line, begin)
        assert match  # the pattern matches an empty field
        fields.append(match[0])
        begin = match.end() + 1
    return fields


def unquoted(text: str) -> str:
    """The text without blanks and quotes around it."""
    text = text.strip()
    return text[1:-1].strip() if len(text) > 1 and text[0] == text[-1] == '"' else text


# --- a file and what it includes --------------------------------------------------------------------------------------


def keyword_blocks(path: Path) -> list[KeywordBlock]:
    """Keyword blocks of a deck in their order, those of included files in place of *INCLUDE.

    Raises:
        MeshError: the file is not text, or has data lines before the first keyword; a file to be included is no plain
            file beside the deck, includes itself, or is one of too many.
    """
    reader = _DeckReader(path)
    reader.read(_source(path))
    return reader.blocks


def _source(path: Path) -> SourceText:
    """The text of a file, in UTF-8 and with line feeds; MeshError if it is not text."""
    try:
        text = path.read_bytes()
    except OSError as error:
        raise MeshError(f"Mesh file '{path}' cannot be read: {error.strerror}.") from None
    # some Windows programs write UTF-16 or a byte order mark
    if text.startswith((b"\xff\xfe", b"\xfe\xff")):
        text = text.decode("utf-16", errors="replace").encode()
    text = text.removeprefix(b"\xef\xbb\xbf")
    if (null := text.find(b"\0")) >= 0:
        SourceText(path, text).refuse(
            null, "a byte 0 stands here; the file is not text. Export the mesh as an Abaqus input file (.inp)."
        )
    return SourceText(path, with_line_feeds(text))


class _DeckReader:
    """The keyword blocks of a deck, and the files that are open while it is read."""

    def __init__(self, deck: Path) -> None:
        self.blocks: list[KeywordBlock] = []
        self._open = [deck.resolve()]
        self._included = 0

    def read(self, source: SourceText) -> None:
        """Append the keyword blocks of a text."""
        text, data, unread = source.text, 0, 0  # offsets of data lines that are not added yet, and of text not read yet
        while (star := text.find(b"*", unread)) >= 0:
            begin = text.rfind(b"\n", 0, star) + 1
            if text[begin:star].strip():
                unread = _line_end(text, star)  # the star stands within a line
                continue
            self._add_data(source, data, begin)
            if text[star : star + 2] == b"**":
                data = unread = _line_end(text, star)
                continue
            words, data = _keyword_words(source, star)
            unread = data
            self._add_keyword(_block(words, source, star))
        self._add_data(source, data, len(text))

    def _add_data(self, source: SourceText, begin: int, end: int) -> None:
        """Add data lines to the last keyword."""
        if begin >= end:
            return
        if self.blocks:
            self.blocks[-1].pieces.append((source, begin, end))
        elif lines := source.text[begin:end].split():
            source.refuse(begin + source.text[begin:end].find(lines[0]), (
                f"'{decode_text(lines[0])[:40]}' stands before the first keyword; an Abaqus input file begins with a "
                "keyword such as *HEADING or *NODE. (The name of an AVS UCD file ends with .avs.)"
            ))  # fmt: skip

    def _add_keyword(self, block: KeywordBlock) -> None:
        """Add a keyword block, or the blocks of the file that it includes; a keyword may have its data in a file."""
        name = block.parameters.get("INPUT", "")
        if block.keyword == "INCLUDE":
            if not name:
                block.refuse("*INCLUDE names no file; write *INCLUDE, INPUT=mesh.inc with a file beside the deck.")
            self._include(block, name)
            return
        self.blocks.append(block)
        if block.keyword in ("NODE", "ELEMENT", "NSET", "ELSET", "SURFACE") and "INPUT" in block.parameters:
            self._include(block, name)

    def _include(self, block: KeywordBlock, name: str) -> None:
        """Read a file that a keyword names."""
        source = self._beside(block, name)
        self._open.append(source.path.resolve())
        self.read(source)
        self._open.pop()

    def _beside(self, block: KeywordBlock, name: str) -> SourceText:
        """The text of a file that a keyword names: a plain file in the folder of its file, or below."""
        path = block.source.path.parent / name
        wrong = unreadable_reason_beside(block.source.path, name)
        if not wrong and path.is_symlink():
            wrong = "is a link; put the file itself there"
        if not wrong and path.resolve() in self._open:
            wrong = "is being read: it would include itself a second time"
        if wrong:
            block.refuse(f"*{block.keyword} names the file '{name}', which {wrong}.")
        self._included += 1
        if self._included > (limit := 1000):
            block.refuse(f"more than {limit} files are included; put the mesh into one file.")
        return _source(path)


def _line_end(text: bytes, at: int) -> int:
    """Offset of the line after the one with an offset."""
    end = text.find(b"\n", at)
    return len(text) if end < 0 else end + 1


def _keyword_words(source: SourceText, star: int) -> tuple[str, int]:
    """The keyword line without its star, continued where it ends with a comma, and where its data begin."""
    text = source.text
    end = _line_end(text, star)
    lines = [text[star + 1 : end].strip()]
    while lines[-1].endswith(b",") and end < len(text):
        after = _line_end(text, end)
        continued = text[end:after].strip()
        if continued.startswith(b"**"):
            end = after
            continue
        if continued.startswith(b"*") or not continued:
            break
        if continued[:1] in b"+-.0123456789":
            source.refuse(end, (
                f"the keyword line before ends with a comma, and so goes on here with '{decode_text(continued)[:40]}', "
                "which is no parameter. Take the comma away."
            ))  # fmt: skip
        lines.append(continued)
        end = after
    return decode_text(b"".join(lines)), end


def _block(words: str, source: SourceText, offset: int) -> KeywordBlock:
    """The keyword and parameters of a keyword line."""
    first, *parameters = split_fields(words)
    values = {}
    for parameter in parameters:
        key, _, value = parameter.partition("=")
        if key := _normalised(key):
            values[key] = unquoted(value)
    return KeywordBlock(_normalised(first), values, source, offset)


def _normalised(words: str) -> str:
    """Words in upper case without blanks."""
    return "".join(words.split()).upper()
