"""Nodes and elements of the bulk data of Nastran (.bdf, .nas, .fem, .dat).

Format: Nastran Quick Reference Guide, "Format of Bulk Data Entries": small fields of 8 columns, large fields of 16
columns (a star behind the name), free fields between commas; continued where the first field is blank or begins with
a plus or a star. Real numbers may lack the letter of their exponent: 1.5-3.

Not by gmsh (4.13), which leaves out cards in lower case and tetrahedra of the order that most others do not have,
without a word.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import NoReturn

import numpy as np

from .data import Indices, MeshError
from .mesh_conversion import Block, MeshFileContents
from .tags import sets_by_tag
from .text_rows import EXPORT_AGAIN, SourceText, decode_text, numbered, shown

# Kinds of cells, by the number of nodes.
SHAPES: dict[str, tuple[str, tuple[int, ...]]] = {
    "CTETRA": ("tetra", (4, 10)), "CPENTA": ("wedge", (6, 15)), "CHEXA": ("hexahedron", (8, 20)),
    "CPYRAM": ("pyramid", (5, 13)), "CPYRA": ("pyramid", (5, 13)), "CTRIA3": ("triangle", (3,)),
    "CTRIAR": ("triangle", (3,)), "CTRIA6": ("triangle", (3, 6)), "CQUAD4": ("quad", (4,)), "CQUADR": ("quad", (4,)),
    "CQUAD8": ("quad", (4, 8)), "CROD": ("line", (2,)), "CBAR": ("line", (2,)), "CBEAM": ("line", (2,)),
    "CTUBE": ("line", (2,)), "CPLSTN3": ("triangle", (3,)), "CPLSTS3": ("triangle", (3,)),
    "CPLSTN4": ("quad", (4,)), "CPLSTS4": ("quad", (4,)),
}  # fmt: skip
AXISYMMETRIC = ("CTRAX", "CQUADX", "CTRIAX")
LEFT_OUT = re.compile(
    r"C(ELAS|MASS|DAMP|BUSH|GAP|ONM|ONROD|VISC|WELD|FAST|SHEAR|BEND|BEAM3|SEAM)\w*|RB\w+|RROD|PLOTEL\w*|SET\d|BSURFS?|ASET\w*"
)
NAMES = (
    re.compile(r'\$HMNAME\s+(PROP|COMP)\s+(\d+)\s*"([^"]*)"'),
    re.compile(r"\$ANSA_NAME_COMMENT;(\d+);P\w+;([^;]*);"),
    re.compile(r"\$\s*Femap.*\bProperty\s+(\d+)\s*:\s*(.+)"),
)
SUPPORTED = (
    "Supported are GRID in basic coordinates, CTETRA, CPENTA, CHEXA, CPYRAM, CTRIA3, CTRIA6, CQUAD4, CQUAD8 and their "
    "like."
)
_EXPONENT = re.compile(r"(?<=[0-9.])([-+]\d+)$")
_NAME = re.compile(r"[A-Z][A-Z0-9]*\*?$")


def read_nastran(path: Path) -> MeshFileContents:
    """Nodes, and elements with their properties as sets: named as pre-processors name them in comments, or "tag-7".

    Raises:
        MeshError: the file is damaged, or holds elements that cannot be used; the message names file and line.
    """
    data = path.read_bytes()
    if b"\0" in data:
        raise MeshError(
            f"Mesh file '{path}' could not be read: it is binary; bulk data of Nastran is text. {SUPPORTED}"
        )
    if b"\r" in data:
        data = data.replace(b"\r\n", b"\n").replace(b"\r", b"\n")
    return _Bulk(SourceText(path, data)).contents()


class _Bulk:
    def __init__(self, source: SourceText) -> None:
        self.source = source
        self.line = 0  # being read, from 1
        self.names: dict[int, tuple[int, str]] = {}  # property -> rank of the writer of the name, name
        self.grids: dict[int, tuple[float, float, float]] = {}
        self.elements: dict[str, tuple[list[int], list[int], list[list[int]]]] = {}  # ids, properties, nodes
        self.seen: set[int] = set()  # element numbers
        self.middles: list[int] = []  # nodes of edges, of elements that do not have all of them
        self.left_out: dict[str, int] = {}
        self.begun = self.ended = False
        for number, fields in self._cards():
            self.line = number
            self._card(fields)
        if self.begun and not self.ended:
            self._refuse("the file ends without ENDDATA behind BEGIN BULK: it was cut off. Export it again.")
        if not self.grids or not self.elements:
            description = "GRID" if not self.grids else "element"
            raise MeshError(
                f"Mesh file '{source.path}' could not be read: it has no {description} of Nastran. {SUPPORTED}"
            )

    def _refuse(self, message: str) -> NoReturn:
        raise MeshError(f"Mesh file '{self.source.path}', line {self.line}: {message}")

    # --- cards ---

    def _bulk_lines(self) -> Iterator[tuple[int, str]]:
        """Numbers and text of the lines of bulk data, from BEGIN BULK to ENDDATA where they are there."""
        lines = decode_text(self.source.text).split("\n")
        first = next((i for i, line in enumerate(lines) if line[:12].upper().split()[:2] == ["BEGIN", "BULK"]), -1)
        self.begun = first >= 0
        for line in lines[: first + 1]:
            self._name(line)
        for number, line in enumerate(lines[first + 1 :], start=first + 2):
            if line.startswith("$"):
                self._name(line)
                continue
            if line[:7].upper() == "ENDDATA":
                self.ended = True
                return
            self.line = number
            if text := line.partition("$")[0].rstrip():
                yield number, text

    def _name(self, line: str) -> None:
        if "NAME" not in line and "emap" not in line:
            return
        for rank, pattern in enumerate(NAMES):
            if match := pattern.match(line):
                *kind, number, name = match.groups()
                rank += 3 * (kind == ["COMP"])  # names of properties count more
                if name.strip() and rank <= self.names.get(int(number), (9, ""))[0]:
                    self.names[int(number)] = rank, name.strip()

    def _cards(self) -> Iterator[tuple[int, list[str]]]:
        """First line and fields of the cards, the name first."""
        card: list[str] = []
        begin = 0
        for number, line in self._bulk_lines():
            fields = self._fields(line)
            if card and (not fields[0] or fields[0][0] in "+*"):
                card += fields[1:]
                continue
            if card:
                yield begin, card
            card, begin = fields, number
        if card:
            yield begin, card

    def _fields(self, line: str) -> list[str]:
        """Name and data of a line: 8 fields, 4 in large fields; free fields have as many as stand there."""
        if "," in line:
            fields = [field.strip() for field in line.split(",")]
            width = 5 if fields[0].endswith("*") else 9
            if len(fields) < width:
                return fields + [""] * (width - len(fields))
            if len(fields) > width and (not fields[width] or fields[width][0] in "+*"):
                return fields[:width]  # the last names the line to come
            return fields
        if "\t" in line:
            line = line.expandtabs(8)
        name = line[:8].strip()
        if name.endswith("*") or name.startswith("*"):
            return [name, *(line[i : i + 16].strip() for i in (8, 24, 40, 56))]
        return [name, *(line[i : i + 8].strip() for i in range(8, 72, 8))]

    def _card(self, fields: list[str]) -> None:
        name = fields[0].upper().removesuffix("*").rstrip()
        if name == "GRID":
            self._grid(fields)
        elif name in SHAPES:
            self._element(name, fields)
        elif not _NAME.match(name or "-") and not name.startswith("INCLUDE"):
            self._refuse(f"`{shown(fields[0].encode())}` is no name of a bulk data entry. {EXPORT_AGAIN}")
        elif name.startswith("INCLUDE"):
            self._refuse("INCLUDE is not supported; put the mesh into one file.")
        elif name.startswith(AXISYMMETRIC):
            self._refuse(f"{name} is axisymmetric, which is not supported. {SUPPORTED}")
        elif name == "GRDSET" and (fields[2] or "0") != "0":
            self._refuse("GRDSET gives nodes a coordinate system; export the nodes in basic coordinates.")
        elif LEFT_OUT.fullmatch(name):
            self.left_out[name] = self.left_out.get(name, 0) + 1

    def _whole(self, text: str, what: str) -> int:
        if not (text.isascii() and text.lstrip("+").isdigit() and len(text) < 18):
            self._refuse(f"`{text[:20]}` is not the {what}, a whole number above 0. {EXPORT_AGAIN}")
        return int(text)

    def _real(self, text: str) -> float:
        try:
            return float(_EXPONENT.sub(r"e\1", text.replace("D", "e").replace("d", "e"))) if text else 0.0
        except ValueError:
            self._refuse(f"`{text[:20]}` is no coordinate: GRID, 5, , 0.0, 0.5, 1.5-3. {EXPORT_AGAIN}")

    def _grid(self, fields: list[str]) -> None:
        number = self._whole(fields[1], "number of a GRID")
        if (fields[2] or "0") != "0":
            self._refuse(
                f"GRID {number} is in the coordinate system {fields[2][:8]}; export the nodes in basic coordinates."
            )
        point = self._real(fields[3]), self._real(fields[4]), self._real(fields[5] if len(fields) > 5 else "")
        if self.grids.setdefault(number, point) != point:
            self._refuse(f"GRID {number} is given a second time, at another place. {EXPORT_AGAIN}")

    def _element(self, name: str, fields: list[str]) -> None:
        shape, sizes = SHAPES[name]
        number = self._whole(fields[1], f"number of a {name}")
        owner = self._whole(fields[2], "number of a property") if fields[2] else number
        texts = fields[3 : 3 + sizes[-1]]
        texts += [""] * (sizes[0] - len(texts))
        nodes = [self._whole(text, f"number of a node of {name} {number}") for text in texts[: sizes[0]]]
        middles = [self._whole(text, f"number of a node of {name} {number}") for text in texts[sizes[0] :] if text]
        if number in self.seen:
            self._refuse(f"element {number} is given a second time. {EXPORT_AGAIN}")
        self.seen.add(number)
        kind = shape
        if len(sizes) > 1 and len(middles) == sizes[1] - sizes[0]:
            kind, nodes = f"{shape}{sizes[1]}", nodes + middles
        else:
            self.middles += middles
        numbers, properties, rows = self.elements.setdefault(kind, ([], [], []))
        numbers.append(number)
        properties.append(owner)
        rows.append(nodes)

    # --- result ---

    def contents(self) -> MeshFileContents:
        ids = np.array(list(self.grids), np.int64)
        points = np.array(list(self.grids.values()), np.float64)
        blocks: list[Block] = []
        owners: list[Indices] = []
        for kind, (numbers, properties, nodes) in self.elements.items():
            table = np.array(nodes, np.int64)
            positions = numbered(ids, table)
            if (missing := (positions < 0).any(axis=1)).any():
                row = int(missing.argmax())
                raise MeshError(
                    f"Mesh file '{self.source.path}' could not be read: element {numbers[row]} has the node "
                    f"{int(table[row][positions[row] < 0][0])}, which is no GRID of the file. {EXPORT_AGAIN}"
                )
            blocks.append(Block(kind, positions))
            owners.append(np.array(properties, np.int64))
        if self.middles:
            positions = numbered(ids, np.unique(self.middles))
            blocks.append(Block("vertex", positions[positions >= 0][:, None]))
            owners.append(np.zeros(len(blocks[-1].nodes), np.int64))
        names = {number: name for number, (_, name) in self.names.items()}
        sets, notes = sets_by_tag(owners, lambda tag, _: names.get(tag, ""), "properties")
        return MeshFileContents(points, blocks, sets, notes=(*notes, *self._notes()))

    def _notes(self) -> Iterator[str]:
        if self.left_out:
            yield f"Not used: {', '.join(f'{count} {name}' for name, count in self.left_out.items())}."
        if not self.ended:
            yield "The file has no ENDDATA: if it was cut off, cells are missing. Compare the number of cells."
        if self.middles:
            yield "Some elements of second order lack nodes in the middle of edges; they are taken by their corners."
