"""Gmsh's own format in version 2, text or binary.

Format: gmsh's reference manual, "MSH file format version 2 (Legacy)". An element has its physical group as first tag;
an element of several groups is listed once for each of them.

Not by gmsh, which puts all elements of one entity into all groups that one of them is in; not by meshio (5.3), which
knows neither parametric nodes nor wedges of second order.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from .data import Indices, MeshError, Points
from .mesh_conversion import Block, MeshFileContents
from .tags import sets_by_tag
from .text_rows import EXPORT_AGAIN, SourceText, decode_text, is_not_integer, numbered, shown

SAVE = "Save it as MSH 4.1 or 2.2, for example by `gmsh -3 part.geo -o part.msh`"
# Numbers of element types in MSH files: kind and number of nodes, corners first.
KINDS: dict[int, tuple[str, int]] = {
    1: ("line", 2), 2: ("triangle", 3), 3: ("quad", 4), 4: ("tetra", 4), 5: ("hexahedron", 8), 6: ("wedge", 6),
    7: ("pyramid", 5), 8: ("line3", 3), 9: ("triangle6", 6), 10: ("quad9", 9), 11: ("tetra10", 10),
    12: ("hexahedron27", 27), 13: ("wedge18", 18), 14: ("pyramid14", 14), 15: ("vertex", 1), 16: ("quad8", 8),
    17: ("hexahedron20", 20), 18: ("wedge15", 15), 19: ("pyramid13", 13), 20: ("triangle9", 9),
    21: ("triangle10", 10), 22: ("triangle12", 12), 23: ("triangle15", 15), 25: ("triangle21", 21), 26: ("line4", 4),
    27: ("line5", 5), 28: ("line6", 6), 29: ("tetra20", 20), 30: ("tetra35", 35), 31: ("tetra56", 56),
    36: ("quad16", 16), 37: ("quad25", 25), 38: ("quad36", 36), 92: ("hexahedron64", 64), 93: ("hexahedron125", 125),
}  # fmt: skip
MAX_TAGS = 1000  # of an element: partitions
NODE = "a node is `number x y z`"
ELEMENT = "an element is `number type number-of-tags tags... nodes...`, whole numbers"
# Sections without a mesh that are passed over without a word.
SILENT = {"MeshFormat", "Comments", "PhysicalNames", "Nodes", "ParametricNodes", "Elements", "Periodic"}
_Group = tuple[Indices, Indices, Indices]  # element numbers, physical groups, (m, k) node numbers


def read_msh2(path: Path) -> MeshFileContents:
    """Nodes, elements and physical groups.

    Raises:
        MeshError: the file is damaged, or holds elements that cannot be used; the message names file and line.
    """
    return _Msh2(path).contents()


class _Msh2:
    def __init__(self, path: Path) -> None:
        self.path = path
        self.source = SourceText(path, path.read_bytes())
        self.order = ""  # of the bytes of binary numbers; "" of text
        self.names: dict[tuple[int, int], str] = {}
        self.ids: Indices = np.zeros(0, np.int64)
        self.points: Points = np.zeros((0, 3))
        self.groups: dict[int, list[_Group]] = {}
        self.unused: list[str] = []
        self._read_sections()

    def _read_sections(self) -> None:
        text, position = self.source.text, 0
        read: set[str] = set()
        while head := re.compile(rb"\s*\$(\w+)[ \t]*\r?\n").match(text, position):
            name, begin = head[1].decode(), head.end()
            if name in ("Nodes", "ParametricNodes"):
                end = self._nodes(begin, name == "ParametricNodes")
            elif name == "Elements":
                end = self._elements(begin)
            else:
                end = text.find(b"$End" + head[1], begin)
                if end < 0:
                    self.source.damaged(head.start(1), f"the section ${name} has no $End{name}: the file was cut off.")
                if name == "MeshFormat":
                    self._format(begin, end)
                elif name == "PhysicalNames":
                    self._physical_names(begin, end)
                elif name not in SILENT and name not in self.unused:
                    self.unused.append(name)
            if name in ("Nodes", "ParametricNodes", "Elements"):
                kind = "Nodes" if name != "Elements" else name
                if kind in read:
                    self.source.damaged(head.start(1), f"there is a second section ${name}.")
                read.add(kind)
            tail = re.compile(rb"\s*\$End" + head[1] + rb"\b[^\n]*\n?").match(text, end)
            if not tail:
                self.source.damaged(
                    end,
                    f"$End{name} is missing behind the section ${name}: it holds more or less than it declares.",
                )
            position = tail.end()
        if text[position:].strip(b" \t\r\n\0"):
            self.source.damaged(position, f"`{shown(text[position : position + 80])}` stands outside the sections.")
        if lost := {"Nodes", "Elements"} - read:
            raise MeshError(
                f"Mesh file '{self.path}' could not be read: it has no section ${min(lost)}; it is cut off or damaged. "
                f"{SAVE}."
            )

    def _format(self, begin: int, end: int) -> None:
        text = self.source.text[begin:end]
        head = re.match(rb"\s*([\d.]+)\s+([01])\s+(\d+)[ \t]*\r?\n", text)
        if not head or head[3] != b"8":
            self.source.refuse(
                begin, f"`{shown(text[:80])}` is not version, 0 for text or 1 for binary, and 8: `2.2 0 8`. {SAVE}."
            )
        if head[2] == b"1":
            first = text[head.end() : head.end() + 4]
            self.order = {b"\1\0\0\0": "<", b"\0\0\0\1": ">"}.get(first, "")
            if not self.order:
                self.source.damaged(begin, "the number 1 does not stand behind the version of this binary file.")

    def _physical_names(self, begin: int, end: int) -> None:
        for entry in re.finditer(rb'^\s*(\d+)\s+(-?\d+)\s+"(.*)"\s*$', self.source.text[begin:end], re.MULTILINE):
            self.names[int(entry[1]), abs(int(entry[2]))] = decode_text(entry[3]).strip()

    def _count(self, begin: int, what: str) -> tuple[int, int]:
        """The number on the first line of a section, and where the next one begins."""
        line = re.compile(rb"[ \t]*(\d{1,18})[ \t]*\r?\n").match(self.source.text, begin)
        if not line:
            result = shown(self.source.text[begin : begin + 80].split(b"\n")[0])
            self.source.damaged(begin, f"`{result}` is not the number of {what}.")
        return int(line[1]), line.end()

    def _section_end(self, begin: int, name: str) -> int:
        end = self.source.text.find(b"$", begin)
        if end < 0:
            self.source.damaged(len(self.source.text) - 1, f"the file ends within the section ${name}: it was cut off.")
        return end

    # --- nodes ---

    def _nodes(self, begin: int, parametric: bool) -> int:
        count, begin = self._count(begin, "nodes")
        if self.order:
            if parametric:
                self.source.refuse(
                    begin, "parametric nodes of a binary file are not supported. Save it as text (Mesh.Binary = 0)."
                )
            kind = np.dtype([("id", self.order + "i4"), ("point", self.order + "f8", 3)])
            rows = self._binary(begin, kind, count, f"{count} nodes")
            self.ids, self.points = rows["id"].astype(np.int64), rows["point"].astype(np.float64)
            end = begin + kind.itemsize * count
        else:
            end = self._section_end(begin, "Nodes")
            lines = self.source.rows(begin, end, NODE)
            if len(lines) and (short := (lines.counts < 4) | (lines.counts > 4) & (not parametric)).any():
                position = int(lines.offsets[short.argmax()])
                self.source.damaged(
                    position, f"this node has {int(lines.counts[short.argmax()]) - 1} coordinates; {NODE}."
                )
            if len(lines) != count:
                self.source.damaged(begin - 1, f"{count} nodes are declared, and {len(lines)} are there.")
            rows4 = lines.columns(slice(None), 4)
            self.ids, self.points = self._whole(rows4[:, 0], lines.offsets, NODE), np.ascontiguousarray(rows4[:, 1:])
        if len(np.unique(self.ids)) < len(self.ids):
            repeated = int(np.sort(self.ids)[np.flatnonzero(np.diff(np.sort(self.ids)) == 0)[0]])
            self.source.damaged(begin, f"node {repeated} is listed twice.")
        return end

    def _binary(self, begin: int, kind: Any, count: int, what: str) -> Any:
        if begin + np.dtype(kind).itemsize * count > len(self.source.text):
            self.source.damaged(begin, f"{what} are declared, and the file ends before the last of them.")
        return np.frombuffer(self.source.text, kind, count, begin)

    def _whole(self, values: Any, offsets: Indices, needed: str) -> Indices:
        wrong = is_not_integer(values)
        if wrong.any():
            position = int(wrong.argmax())
            self.source.damaged(int(offsets[position]), f"{values[position]:g} is no whole number; {needed}.")
        whole: Indices = values.astype(np.int64)
        return whole

    # --- elements ---

    def _elements(self, begin: int) -> int:
        count, begin = self._count(begin, "elements")
        end = begin if self.order else self._section_end(begin, "Elements")
        result = 0
        for type_, group in self._binary_groups(begin, count) if self.order else self._text_groups(begin, end):
            self.groups.setdefault(type_, []).append(group)
            result += len(group[0])
        if result != count:
            self.source.damaged(begin - 1, f"{count} elements are declared, and {result} are there.")
        return self._binary_end if self.order else end

    def _kind(self, type_: int, offset: int) -> tuple[str, int]:
        if type_ not in KINDS:
            self.source.refuse(
                offset,
                f"an element is of the type {type_}, which is not supported. Supported are points, lines, triangles, "
                "quadrilaterals, tetrahedra, hexahedra, prisms, pyramids; save the mesh with Mesh.ElementOrder = 1.",
            )  # fmt: skip
        return KINDS[type_]

    def _text_groups(self, begin: int, end: int) -> Iterator[tuple[int, _Group]]:
        lines = self.source.rows(begin, end, ELEMENT)
        if not len(lines):
            return
        if (short := lines.counts < 4).any():
            self.source.damaged(int(lines.offsets[short.argmax()]), f"this element is cut short; {ELEMENT}.")
        types, tags = (self._whole(lines.values[lines.begins + i], lines.offsets, ELEMENT) for i in (1, 2))
        keys = np.stack([types, tags, lines.counts], axis=1)
        distinct, first, position = np.unique(keys, axis=0, return_index=True, return_inverse=True)
        position = position.ravel()
        for number in np.argsort(first):
            type_, tag_count, width = distinct[number].tolist()
            offset = int(lines.offsets[first[number]])
            nodes = self._kind(type_, offset)[1]
            if not 0 <= tag_count <= MAX_TAGS or width != 3 + tag_count + nodes:
                self.source.damaged(
                    offset, f"an element of type {type_} with {tag_count} tags has {3 + tag_count + nodes} numbers, "
                    f"not {width}.",
                )  # fmt: skip
            rows = np.flatnonzero(position == number)
            values = self._whole_rows(lines.columns(rows, width), lines.offsets[rows])
            yield type_, (values[:, 0], self._physical(values, 3, tag_count), values[:, 3 + tag_count :])

    def _whole_rows(self, values: Any, offsets: Indices) -> Indices:
        if (wrong := is_not_integer(values).any(axis=1)).any():
            self.source.damaged(int(offsets[wrong.argmax()]), f"a number of this element is not whole; {ELEMENT}.")
        whole: Indices = values.astype(np.int64)
        return whole

    @staticmethod
    def _physical(values: Indices, column: int, tag_count: int) -> Indices:
        return np.abs(values[:, column]) if tag_count else np.zeros(len(values), np.int64)

    def _binary_groups(self, begin: int, count: int) -> Iterator[tuple[int, _Group]]:
        result = 0
        while result < count:
            type_, follow, tag_count = self._binary(begin, self.order + "i4", 3, f"{count} elements").tolist()
            nodes = self._kind(type_, begin)[1]
            if follow < 1 or not 0 <= tag_count <= MAX_TAGS:
                self.source.damaged(begin, f"a list of {follow} elements with {tag_count} tags stands here.")
            width = 1 + tag_count + nodes
            begin += 12
            values = self._binary(begin, self.order + "i4", follow * width, f"{follow} elements")
            values = values.astype(np.int64).reshape(-1, width)
            begin += 4 * follow * width
            result += follow
            yield type_, (values[:, 0], self._physical(values, 1, tag_count), values[:, 1 + tag_count :])
        self._binary_end = begin

    # --- result ---

    def contents(self) -> MeshFileContents:
        blocks: list[Block] = []
        parts: list[Indices] = []
        for type_, groups in self.groups.items():
            kind = KINDS[type_][0]
            numbers, physical, nodes = (np.concatenate(column) for column in zip(*groups, strict=True))
            positions = numbered(self.ids, nodes)
            if (missing := (positions < 0).any(axis=1)).any():
                row = int(missing.argmax())
                raise MeshError(
                    f"Mesh file '{self.path}' could not be read: element {numbers[row]} has the node "
                    f"{int(nodes[row][positions[row] < 0][0])}, which is not in the file. {EXPORT_AGAIN}"
                )
            blocks.append(Block(kind, positions))
            parts.append(physical)
        sets, notes = sets_by_tag(parts, lambda tag, i: self.names.get((blocks[i].dim, tag), ""), "physical groups")
        if self.unused:
            notes += (f"Not used: {', '.join(self.unused)}.",)
        return MeshFileContents(self.points, blocks, sets, copies=True, notes=notes)
