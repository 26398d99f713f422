"""Gmsh's own format, MSH: version 2 in text or binary is read here, later versions by gmsh.

Format: Gmsh reference manual, "MSH file format version 2 (Legacy)". The first tag of an element is its physical group;
an element of several groups is listed once for each of them.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from .cell_sets import add_to_set, sets_by_tag
from .data import Indices, Points
from .file_text import SourceText, decode_text, excerpt, refuse_file
from .mesh_conversion import Block, MeshFileContents, node_indices
from .topology import first_repeated

SAVE = "Save it as MSH 4.1 or 2.2, for example by `gmsh -3 part.geo -o part.msh`"
# Element type of MSH -> cell type and number of nodes, corners first.
KINDS: dict[int, tuple[str, int]] = {
    1: ("line", 2), 2: ("triangle", 3), 3: ("quad", 4), 4: ("tetra", 4), 5: ("hexahedron", 8), 6: ("wedge", 6),
    7: ("pyramid", 5), 8: ("line3", 3), 9: ("triangle6", 6), 10: ("quad9", 9), 11: ("tetra10", 10),
    12: ("hexahedron27", 27), 13: ("wedge18", 18), 14: ("pyramid14", 14), 15: ("vertex", 1), 16: ("quad8", 8),
    17: ("hexahedron20", 20), 18: ("wedge15", 15), 19: ("pyramid13", 13), 20: ("triangle9", 9),
    21: ("triangle10", 10), 22: ("triangle12", 12), 23: ("triangle15", 15), 25: ("triangle21", 21), 26: ("line4", 4),
    27: ("line5", 5), 28: ("line6", 6), 29: ("tetra20", 20), 30: ("tetra35", 35), 31: ("tetra56", 56),
    36: ("quad16", 16), 37: ("quad25", 25), 38: ("quad36", 36), 92: ("hexahedron64", 64), 93: ("hexahedron125", 125),
}  # fmt: skip
MAX_TAGS = 1000  # of an element, one for each partition that it touches; more is a damaged file
NODE = "a node is `number x y z`"
ELEMENT = "an element is `number type number-of-tags tags... nodes...`, whole numbers"
# Sections that are read, or passed over without a note.
SILENT = {"MeshFormat", "Comments", "PhysicalNames", "Nodes", "ParametricNodes", "Elements", "Periodic"}
_Elements = tuple[Indices, Indices, Indices]  # element numbers (m,), physical groups (m,), node numbers (m, k)


def msh_version(path: Path) -> int:
    """Major version of a file of Gmsh's own format; 0 of a .msh file of ANSYS Fluent and of every other ending.

    Raises:
        MeshError: a .msh file that is neither Gmsh's nor Fluent's.
    """
    if path.suffix.lower() != ".msh":
        return 0
    with path.open("rb") as file:
        head = file.read(65536)
    # gmsh takes any file that does not begin as a mesh for a script, and runs it with its shell commands
    if not head.startswith((b"$MeshFormat", b"$Comments")):
        if head.lstrip()[:1] == b"(":
            return 0  # ANSYS Fluent
        freefem = (
            '(FreeFem\'s own .msh: savemesh(Th, "part.mesh") writes Medit instead.) ' if head[:1].isdigit() else ""
        )
        reason = f"it is no mesh of Gmsh, for it begins with {head[:16]!a}, not with $MeshFormat"
        refuse_file(path, reason, f"{freefem}{SAVE}.")
    _, keyword, text = head.partition(b"$MeshFormat")
    number = re.match(rb"\s*(\d{1,3})(\.\d*)?\s", text) if keyword else None
    if not number or int(number[1]) < 1:
        refuse_file(path, "no version stands behind $MeshFormat: `4.1 0 8`", f"{SAVE}.")
    return int(number[1])


# --- version 2 ------------------------------------------------------------------------------------------------------


def read_msh2(path: Path) -> MeshFileContents:
    """Nodes, elements and physical groups of a file of version 2.

    Raises:
        MeshError: the file is damaged, or holds elements that cannot be used; the message names file and line.
    """
    # Not by gmsh, which puts all elements of an entity into each group of any of them; not by meshio 5.3, which knows
    # neither parametric nodes nor wedges of second order.
    return _Msh2(path).contents()


class _Msh2:
    """The sections of an MSH 2 file: nodes, elements by type, and names of physical groups."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.source = SourceText(path, path.read_bytes())
        self.byte_order = ""  # "<" or ">" of a binary file; "" of text
        self.names: dict[tuple[int, int], str] = {}
        self.ids: Indices = np.zeros(0, np.int64)
        self.points: Points = np.zeros((0, 3))
        self.elements: dict[int, list[_Elements]] = {}  # by element type
        self.unused: list[str] = []
        self._read_sections()

    def _read_sections(self) -> None:
        """Read every section."""
        text, position = self.source.text, 0
        read: set[str] = set()
        while head := re.compile(rb"\s*\$(\w+)[ \t]*\r?\n").match(text, position):
            name, begin = head[1].decode(), head.end()
            # binary sections may hold the bytes of `$End`: their lengths tell where they end
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
            self.source.damaged(position, f"`{excerpt(text[position : position + 80])}` stands outside the sections.")
        if lost := {"Nodes", "Elements"} - read:
            refuse_file(self.path, f"it has no section ${min(lost)}; it is cut off or damaged", f"{SAVE}.")

    def _format(self, begin: int, end: int) -> None:
        """Read the section of the format: text, or the byte order of a binary file."""
        text = self.source.text[begin:end]
        head = re.match(rb"\s*([\d.]+)\s+([01])\s+(\d+)[ \t]*\r?\n", text)
        if not head or head[3] != b"8":
            self.source.refuse(
                begin, f"`{excerpt(text[:80])}` is not version, 0 for text or 1 for binary, and 8: `2.2 0 8`. {SAVE}."
            )
        if head[2] == b"1":
            first = text[head.end() : head.end() + 4]
            self.byte_order = {b"\1\0\0\0": "<", b"\0\0\0\1": ">"}.get(first, "")
            if not self.byte_order:
                self.source.damaged(begin, "the number 1 does not stand behind the version of this binary file.")

    def _physical_names(self, begin: int, end: int) -> None:
        for entry in re.finditer(rb'^\s*(\d+)\s+(-?\d+)\s+"(.*)"\s*$', self.source.text[begin:end], re.MULTILINE):
            self.names[int(entry[1]), abs(int(entry[2]))] = decode_text(entry[3]).strip()

    def _count(self, begin: int, what: str) -> tuple[int, int]:
        """The number on the first line of a section, and the offset of the second line."""
        line = re.compile(rb"[ \t]*(\d{1,18})[ \t]*\r?\n").match(self.source.text, begin)
        if not line:
            line_text = excerpt(self.source.text[begin : begin + 80].split(b"\n")[0])
            self.source.damaged(begin, f"`{line_text}` is not the number of {what}.")
        return int(line[1]), line.end()

    def _section_end(self, begin: int, name: str) -> int:
        """Offset of the `$` that ends a section of text."""
        end = self.source.text.find(b"$", begin)
        if end < 0:
            self.source.damaged(len(self.source.text) - 1, f"the file ends within the section ${name}: it was cut off.")
        return end

    # --- nodes ---

    def _nodes(self, begin: int, parametric: bool) -> int:
        """Read the section of nodes; the offset of its end."""
        count, begin = self._count(begin, "nodes")
        if self.byte_order:
            if parametric:
                self.source.refuse(
                    begin, "parametric nodes of a binary file are not supported. Save it as text (Mesh.Binary = 0)."
                )
            record = np.dtype([("id", self.byte_order + "i4"), ("point", self.byte_order + "f8", 3)])
            rows = self._binary(begin, record, count, f"{count} nodes")
            self.ids, self.points = rows["id"].astype(np.int64), rows["point"].astype(np.float64)
            end = begin + record.itemsize * count
        else:
            end = self._section_end(begin, "Nodes")
            lines = self.source.rows(begin, end, NODE)
            if len(lines) and (wrong := (lines.counts < 4) | (lines.counts > 4) & (not parametric)).any():
                row = int(wrong.argmax())
                self.source.damaged(
                    int(lines.offsets[row]), f"this node has {int(lines.counts[row]) - 1} coordinates; {NODE}."
                )
            if len(lines) != count:
                self.source.damaged(begin - 1, f"{count} nodes are declared, and {len(lines)} are there.")
            values = lines.columns(slice(None), 4)
            self.ids = self.source.integers(values[:, 0], lines.offsets, NODE)
            self.points = np.ascontiguousarray(values[:, 1:])
        if (repeated := first_repeated(self.ids)) is not None:
            self.source.damaged(begin, f"node {repeated} is listed twice.")
        return end

    def _binary(self, begin: int, dtype: Any, count: int, what: str) -> Any:
        """An array of `count` binary records from an offset on."""
        if begin + np.dtype(dtype).itemsize * count > len(self.source.text):
            self.source.damaged(begin, f"{what} are declared, and the file ends before the last of them.")
        return np.frombuffer(self.source.text, dtype, count, begin)

    # --- elements ---

    def _elements(self, begin: int) -> int:
        """Read the section of elements; the offset of its end."""
        count, begin = self._count(begin, "elements")
        end = begin if self.byte_order else self._section_end(begin, "Elements")
        read = 0
        for type_, elements in (
            self._binary_elements(begin, count) if self.byte_order else self._text_elements(begin, end)
        ):
            self.elements.setdefault(type_, []).append(elements)
            read += len(elements[0])
        if read != count:
            self.source.damaged(begin - 1, f"{count} elements are declared, and {read} are there.")
        return self._binary_end if self.byte_order else end

    def _kind(self, type_: int, offset: int) -> tuple[str, int]:
        """Cell type and number of nodes of an element type; MeshError at an offset if it is not supported."""
        if type_ not in KINDS:
            self.source.refuse(
                offset,
                f"an element is of the type {type_}, which is not supported. Supported are points, lines, triangles, "
                "quadrilaterals, tetrahedra, hexahedra, prisms, pyramids; save the mesh with Mesh.ElementOrder = 1.",
            )  # fmt: skip
        return KINDS[type_]

    def _text_elements(self, begin: int, end: int) -> Iterator[tuple[int, _Elements]]:
        """Elements of a text file, those of one type and number of tags together."""
        lines = self.source.rows(begin, end, ELEMENT)
        if not len(lines):
            return
        if (short := lines.counts < 4).any():
            self.source.damaged(int(lines.offsets[short.argmax()]), f"this element is cut short; {ELEMENT}.")
        types, tags = (self.source.integers(lines.values[lines.begins + i], lines.offsets, ELEMENT) for i in (1, 2))
        # lines of one type, number of tags and length are taken together, in the order in which such lines begin
        keys = np.stack([types, tags, lines.counts], axis=1)
        distinct, first, key_of_line = np.unique(keys, axis=0, return_index=True, return_inverse=True)
        key_of_line = key_of_line.ravel()
        for number in np.argsort(first):
            type_, tag_count, width = distinct[number].tolist()
            offset = int(lines.offsets[first[number]])
            nodes = self._kind(type_, offset)[1]
            if not 0 <= tag_count <= MAX_TAGS or width != 3 + tag_count + nodes:
                self.source.damaged(
                    offset, f"an element of type {type_} with {tag_count} tags has {3 + tag_count + nodes} numbers, "
                    f"not {width}.",
                )  # fmt: skip
            rows = np.flatnonzero(key_of_line == number)
            values = self.source.integers(lines.columns(rows, width), lines.offsets[rows], ELEMENT)
            yield type_, (values[:, 0], self._physical(values, 3, tag_count), values[:, 3 + tag_count :])

    @staticmethod
    def _physical(values: Indices, column: int, tag_count: int) -> Indices:
        """(m,) the physical group of each element, 0 for none."""
        return np.abs(values[:, column]) if tag_count else np.zeros(len(values), np.int64)

    def _binary_elements(self, begin: int, count: int) -> Iterator[tuple[int, _Elements]]:
        """Elements of a binary file: lists of one type each, behind a head of three integers."""
        integer, read = self.byte_order + "i4", 0
        while read < count:
            type_, follow, tag_count = self._binary(begin, integer, 3, f"{count} elements").tolist()
            nodes = self._kind(type_, begin)[1]
            if follow < 1 or not 0 <= tag_count <= MAX_TAGS:
                self.source.damaged(begin, f"a list of {follow} elements with {tag_count} tags stands here.")
            width = 1 + tag_count + nodes
            begin += 3 * 4  # bytes of the head
            values = self._binary(begin, integer, follow * width, f"{follow} elements")
            values = values.astype(np.int64).reshape(-1, width)
            begin += 4 * follow * width
            read += follow
            yield type_, (values[:, 0], self._physical(values, 1, tag_count), values[:, 1 + tag_count :])
        self._binary_end = begin

    def contents(self) -> MeshFileContents:
        """The file in arrays, physical groups as sets."""
        blocks: list[Block] = []
        tags: list[Indices] = []
        for type_, parts in self.elements.items():
            numbers, physical, nodes = (np.concatenate(column) for column in zip(*parts, strict=True))
            blocks.append(Block(KINDS[type_][0], node_indices(self.path, self.ids, numbers, nodes)))
            tags.append(physical)
        sets, notes = sets_by_tag(tags, lambda tag, i: self.names.get((blocks[i].dim, tag), ""), "physical groups")
        if self.unused:
            notes += (f"Not used: {', '.join(self.unused)}.",)
        return MeshFileContents(self.points, blocks, sets, copies=True, notes=notes)


# --- version 4, by gmsh ---------------------------------------------------------------------------------------------

# gmsh's names of element types, without their order
SHAPES = {
    "Point": "vertex", "Line": "line", "Triangle": "triangle", "Quadrilateral": "quad", "Tetrahedron": "tetra",
    "Hexahedron": "hexahedron", "Prism": "wedge", "Pyramid": "pyramid",
}  # fmt: skip


def read_with_gmsh(path: Path) -> MeshFileContents:
    """Nodes, elements and physical groups of a file whose `msh_version` is above 2.

    To be called in a process of its own: damaged files have ended gmsh by SIGABRT.

    Raises:
        MeshError: the file is damaged.
    """
    # Not by meshio 5.3, which refuses files with some cells in a physical group, and keeps one unnamed group of each.
    from .gmsh_session import session

    # A link of another name: gmsh would run the commands of part.msh.opt beside part.msh.
    with TemporaryDirectory() as folder, session() as gmsh:
        linked = Path(folder) / "mesh.msh"
        linked.symlink_to(path.resolve())
        try:
            gmsh.merge(str(linked))
        except Exception as error:  # gmsh raises plain Exception with the last line of its log
            text = " ".join(str(error).replace(str(linked), path.name).split())[:200]
            refuse_file(path, f"gmsh says: {text.rstrip('.')}")
        try:
            return _contents_of_model(gmsh)
        except (ValueError, IndexError, KeyError, TypeError):
            refuse_file(path, "its elements do not fit its nodes, or are of a kind that is not supported")


def _contents_of_model(gmsh: Any) -> MeshFileContents:
    """The mesh of gmsh's current model, physical groups as sets."""
    tags, coordinates, _ = gmsh.model.mesh.getNodes()
    index = np.full(int(tags.max(initial=0)) + 1, -1, np.int64)
    index[tags] = np.arange(len(tags))
    blocks: list[Block] = []
    owners: list[tuple[int, int]] = []
    for entity in gmsh.model.getEntities():
        for kind, _, nodes in zip(*gmsh.model.mesh.getElements(*entity), strict=True):
            name, _, order, count, _, _ = gmsh.model.mesh.getElementProperties(kind)
            shape = SHAPES.get(name.split()[0], name)
            blocks.append(Block(shape if order == 1 else f"{shape}{count}", index[nodes].reshape(-1, count)))
            owners.append(entity)
    return MeshFileContents(coordinates.reshape(-1, 3), blocks, _physical_groups(gmsh, blocks, owners))


def _physical_groups(gmsh: Any, blocks: list[Block], owners: list[tuple[int, int]]) -> dict[str, list[Indices]]:
    """Sets of the physical groups; groups of several dimensions may share a name."""
    sets: dict[str, list[Indices]] = {}
    for dim, tag in gmsh.model.getPhysicalGroups():
        name = gmsh.model.getPhysicalName(dim, tag) or f"tag-{tag}"
        entities = set(gmsh.model.getEntitiesForPhysicalGroup(dim, tag).tolist())
        for i, (block, owner) in enumerate(zip(blocks, owners, strict=True)):
            if owner[0] == dim and owner[1] in entities:
                add_to_set(sets, blocks, name, i, np.arange(len(block.nodes)))
    return sets
