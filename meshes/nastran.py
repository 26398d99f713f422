"""Nodes and elements of the bulk data of Nastran (.bdf, .nas, .fem, .dat).

Format: Nastran Quick Reference Guide, "Format of Bulk Data Entries": small fields of 8 columns, large fields of 16
columns (a star behind the name), or free fields between commas. An entry continues on lines whose first field is blank
or begins with a plus or a star. Real numbers may lack the letter of their exponent: 1.5-3.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import NoReturn

import numpy as np

from .cell_sets import sets_by_tag
from .data import Indices
from .file_text import EXPORT_AGAIN, decode_text, excerpt, read_text, refuse_file, refuse_line
from .mesh_conversion import Block, MeshFileContents, node_indices
from .topology import positions_of

# Entry -> shape, and numbers of nodes of first and of second order
SHAPES: dict[str, tuple[str, tuple[int, ...]]] = {
    "CTETRA": ("tetra", (4, 10)), "CPENTA": ("wedge", (6, 15)), "CHEXA": ("hexahedron", (8, 20)),
    "CPYRAM": ("pyramid", (5, 13)), "CPYRA": ("pyramid", (5, 13)), "CTRIA3": ("triangle", (3,)),
    "CTRIAR": ("triangle", (3,)), "CTRIA6": ("triangle", (3, 6)), "CQUAD4": ("quad", (4,)), "CQUADR": ("quad", (4,)),
    "CQUAD8": ("quad", (4, 8)), "CROD": ("line", (2,)), "CBAR": ("line", (2,)), "CBEAM": ("line", (2,)),
    "CTUBE": ("line", (2,)), "CPLSTN3": ("triangle", (3,)), "CPLSTS3": ("triangle", (3,)),
    "CPLSTN4": ("quad", (4,)), "CPLSTS4": ("quad", (4,)),
}  # fmt: skip
AXISYMMETRIC = ("CTRAX", "CQUADX", "CTRIAX")
# Entries without cells of a body: counted in a note
LEFT_OUT = re.compile(
    r"C(ELAS|MASS|DAMP|BUSH|GAP|ONM|ONROD|VISC|WELD|FAST|SHEAR|BEND|BEAM3|SEAM)\w*|RB\w+|RROD|PLOTEL\w*|SET\d|BSURFS?|ASET\w*"
)
# Comments in which pre-processors name properties (HyperMesh, ANSA, Femap)
NAME_COMMENTS = (
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
    """Nodes and elements; a set for each property, named as in comments of pre-processors, or "tag-<n>".

    Raises:
        MeshError: the file is damaged, or holds elements that cannot be used; the message names file and line.
    """
    # Not by gmsh 4.13, which silently leaves out entries in lower case and tetrahedra of negative orientation.
    text = read_text(path)
    if b"\0" in text:
        refuse_file(path, "it is binary; bulk data of Nastran is text", SUPPORTED)
    return _BulkData(path, text).contents()


class _BulkData:
    """Grid points, elements and names of properties of a Nastran file."""

    def __init__(self, path: Path, text: bytes) -> None:
        self.path = path
        self.line = 0  # being read, from 1
        self.names: dict[int, tuple[int, str]] = {}  # property -> rank of the comment (least wins), name
        self.grids: dict[int, tuple[float, float, float]] = {}
        self.elements: dict[str, tuple[list[int], list[int], list[list[int]]]] = {}  # ids, properties, nodes
        self.element_ids: set[int] = set()
        self.midside_nodes: list[int] = []  # of elements that lack some of them
        self.left_out: dict[str, int] = {}
        self.begun = self.ended = False
        for number, fields in self._entries(decode_text(text).split("\n")):
            self.line = number
            self._entry(fields)
        if self.begun and not self.ended:
            self._refuse("the file ends without ENDDATA behind BEGIN BULK: it was cut off. Export it again.")
        if not self.grids or not self.elements:
            refuse_file(path, f"it has no {'element' if self.grids else 'GRID'} of Nastran", SUPPORTED)

    def _refuse(self, message: str) -> NoReturn:
        """Raises MeshError at the line being read."""
        refuse_line(self.path, self.line, message)

    # --- entries ---

    def _bulk_lines(self, lines: list[str]) -> Iterator[tuple[int, str]]:
        """Numbers and text of the lines of bulk data, from BEGIN BULK (or the first line) to ENDDATA."""
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
        """Take the name of a property from a comment."""
        if "NAME" not in line and "emap" not in line:
            return
        for rank, pattern in enumerate(NAME_COMMENTS):
            if match := pattern.match(line):
                *kind, number, name = match.groups()
                rank += len(NAME_COMMENTS) * (kind == ["COMP"])  # a component's name only if no other is given
                if name.strip() and rank <= self.names.get(int(number), (rank, ""))[0]:
                    self.names[int(number)] = rank, name.strip()

    def _entries(self, lines: list[str]) -> Iterator[tuple[int, list[str]]]:
        """First line and fields of each bulk data entry, its name first."""
        entry: list[str] = []
        begin = 0
        for number, line in self._bulk_lines(lines):
            fields = _fields(line)
            if entry and (not fields[0] or fields[0][0] in "+*"):
                entry += fields[1:]
                continue
            if entry:
                yield begin, entry
            entry, begin = fields, number
        if entry:
            yield begin, entry

    def _entry(self, fields: list[str]) -> None:
        """Read one bulk data entry."""
        name = fields[0].upper().removesuffix("*").rstrip()
        if name == "GRID":
            self._grid(fields)
        elif name in SHAPES:
            self._element(name, fields)
        elif not _NAME.match(name or "-") and not name.startswith("INCLUDE"):
            self._refuse(f"`{excerpt(fields[0].encode())}` is no name of a bulk data entry. {EXPORT_AGAIN}")
        elif name.startswith("INCLUDE"):
            self._refuse("INCLUDE is not supported; put the mesh into one file.")
        elif name.startswith(AXISYMMETRIC):
            self._refuse(f"{name} is axisymmetric, which is not supported. {SUPPORTED}")
        elif name == "GRDSET" and (fields[2] or "0") != "0":
            self._refuse("GRDSET gives nodes a coordinate system; export the nodes in basic coordinates.")
        elif LEFT_OUT.fullmatch(name):
            self.left_out[name] = self.left_out.get(name, 0) + 1

    def _integer(self, text: str, what: str) -> int:
        """The positive integer of a field; MeshError tells what it should be."""
        if not (text.isascii() and text.lstrip("+").isdigit() and len(text) < 18):
            self._refuse(f"`{text[:20]}` is not the {what}, a whole number above 0. {EXPORT_AGAIN}")
        return int(text)

    def _real(self, text: str) -> float:
        """The coordinate of a field; 0 of a blank one."""
        try:
            return float(_EXPONENT.sub(r"e\1", text.replace("D", "e").replace("d", "e"))) if text else 0.0
        except ValueError:
            self._refuse(f"`{text[:20]}` is no coordinate: GRID, 5, , 0.0, 0.5, 1.5-3. {EXPORT_AGAIN}")

    def _grid(self, fields: list[str]) -> None:
        """Read a GRID, which is a node."""
        number = self._integer(fields[1], "number of a GRID")
        if (fields[2] or "0") != "0":
            self._refuse(
                f"GRID {number} is in the coordinate system {fields[2][:8]}; export the nodes in basic coordinates."
            )
        point = self._real(fields[3]), self._real(fields[4]), self._real(fields[5] if len(fields) > 5 else "")
        if self.grids.setdefault(number, point) != point:
            self._refuse(f"GRID {number} is given a second time, at another place. {EXPORT_AGAIN}")

    def _element(self, name: str, fields: list[str]) -> None:
        """Read an element: number, property, corner nodes, midside nodes."""
        shape, sizes = SHAPES[name]
        number = self._integer(fields[1], f"number of a {name}")
        property_id = self._integer(fields[2], "number of a property") if fields[2] else number
        texts = fields[3 : 3 + sizes[-1]]
        texts += [""] * (sizes[0] - len(texts))
        description = f"number of a node of {name} {number}"
        nodes = [self._integer(text, description) for text in texts[: sizes[0]]]
        midside = [self._integer(text, description) for text in texts[sizes[0] :] if text]
        if number in self.element_ids:
            self._refuse(f"element {number} is given a second time. {EXPORT_AGAIN}")
        self.element_ids.add(number)
        kind = shape
        if len(sizes) > 1 and len(midside) == sizes[1] - sizes[0]:
            kind, nodes = f"{shape}{sizes[1]}", nodes + midside
        else:
            self.midside_nodes += midside
        numbers, properties, rows = self.elements.setdefault(kind, ([], [], []))
        numbers.append(number)
        properties.append(property_id)
        rows.append(nodes)

    # --- result ---

    def contents(self) -> MeshFileContents:
        """The file in arrays, properties as sets."""
        ids = np.array(list(self.grids), np.int64)
        points = np.array(list(self.grids.values()), np.float64)
        blocks: list[Block] = []
        tags: list[Indices] = []
        for kind, (numbers, properties, nodes) in self.elements.items():
            blocks.append(Block(kind, node_indices(self.path, ids, np.array(numbers), np.array(nodes, np.int64))))
            tags.append(np.array(properties, np.int64))
        if self.midside_nodes:  # as cells, lest they count as lost nodes
            indices = positions_of(ids, np.unique(self.midside_nodes))
            blocks.append(Block("vertex", indices[indices >= 0][:, None]))
            tags.append(np.zeros(len(blocks[-1].nodes), np.int64))
        names = {number: name for number, (_, name) in self.names.items()}
        sets, notes = sets_by_tag(tags, lambda tag, _: names.get(tag, ""), "properties")
        return MeshFileContents(points, blocks, sets, notes=(*notes, *self._notes()))

    def _notes(self) -> Iterator[str]:
        if self.left_out:
            yield f"Not used: {', '.join(f'{count} {name}' for name, count in self.left_out.items())}."
        if not self.ended:
            yield "The file has no ENDDATA: if it was cut off, cells are missing. Compare the number of cells."
        if self.midside_nodes:
            yield "Some elements of second order lack nodes in the middle of edges; they are taken by their corners."


def _fields(line: str) -> list[str]:
    """Name and data fields of a line: 8 small or 4 large ones; free fields as many as the line has."""
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
