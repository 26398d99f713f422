"""Parts, instances and the assembly that an Abaqus input file defines, with nodes, elements, sets and surfaces.

Sets and surfaces are kept as they are written; `abaqus.SetResolver` resolves them.

Abaqus Analysis User's Guide, "Elements": names are a family, a number of nodes, and letters for the formulation
(H hybrid, M modified, T temperature, R reduced integration, I incompatible modes, ...), which do not change the shape.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from .abaqus_deck import KeywordBlock, keyword_blocks, parse_number
from .data import Indices, Points, list_some
from .file_text import SourceText
from .mesh_conversion import shape_of

# Dimension -> number of nodes -> cell type
KINDS: dict[int, dict[int, str]] = {
    3: {
        4: "tetra", 5: "pyramid", 6: "wedge", 8: "hexahedron", 10: "tetra10", 13: "pyramid13", 15: "wedge15",
        20: "hexahedron20", 27: "hexahedron27",
    },
    2: {3: "triangle", 4: "quad", 6: "triangle6", 8: "quad8", 9: "quad9"},
    1: {2: "line", 3: "line3"},
}  # fmt: skip
_FAMILIES = (
    (re.compile(r"(?:A|E|Q|D|DC|DCC)?C3D(\d+)[A-Z]*|F3D(\d+)|[CS]SS?(8)R?T?|SC([68])RT?"), 3),
    (re.compile(r"(?:A|D|DC|DCC)?C?2D([3468])[A-Z]*|C2D([3468])|CP[ES]G?([3468])[A-Z]*|WARP2D([34])"), 2),
    (
        re.compile(r"D?S([34689])(?:RS?W?|RT|R5|5|T|S)?|US([34])|STRI(3)|STRI(6)5|(?:M|SFM)3D([34689])R?|R3D([34])"),
        2,
    ),
    (re.compile(r"T[23]D([23])[A-Z]*|B[23]1[A-Z]*|R2D2"), 1),
)
_AXISYMMETRIC = re.compile(r"(?:A|D|DC|DCC)?C?G?AX(?:A)?\d.*|CAX.*|CGAX.*")
# Elements that are no part of a body, or one of a kind that cannot be used: left out
_UNUSED = re.compile(
    r"(?:B[23]|PIPE|ELBOW|FRAME|MASS|HEATCAP|ROTARYI|SPRING|DASHPOT|CONN|JOINT|GAP|DGAP|ITS|ITT|IRS|R2D|R3D|RB[23]D|RAX|SAX|MAX|"
    r"DSAX|SFMAX|SFMCL|MCL|COH|GK|CIN|ACIN|PC3D|PD3D|PSI|DCOUP|DRAG|ROTARY|DIST|LS[36]S|EMC|FLINK|ISL|C3D\d+V$).*"
)

# Shape -> columns of the corners of the faces S1, S2, ...
FACES: dict[str, tuple[tuple[int, ...], ...]] = {
    "tetra": ((0, 1, 2), (0, 3, 1), (1, 3, 2), (2, 3, 0)),
    "pyramid": ((0, 1, 2, 3), (0, 4, 1), (1, 4, 2), (2, 4, 3), (3, 4, 0)),
    "wedge": ((0, 1, 2), (3, 5, 4), (0, 3, 4, 1), (1, 4, 5, 2), (2, 5, 3, 0)),
    "hexahedron": ((0, 1, 2, 3), (4, 7, 6, 5), (0, 4, 5, 1), (1, 5, 6, 2), (2, 6, 7, 3), (3, 7, 4, 0)),
    "triangle": ((0, 1), (1, 2), (2, 0)),
    "quad": ((0, 1), (1, 2), (2, 3), (3, 0)),
}
SUPPORTED = "C3D4, C3D5, C3D6, C3D8, C3D10, C3D15, C3D20, CPS3, CPE3, CPS4, CPE4, CPS6, CPS8, S3, S4"


def kind_of(element_type: str) -> tuple[str, int] | None:
    """Cell type and number of nodes of an element type in upper case; None of one that is left out.

    Raises:
        ValueError: the message says why the type cannot be used.
    """
    if _AXISYMMETRIC.fullmatch(element_type):
        raise ValueError(
            f"elements {element_type} are axisymmetric; bodies are solid or plane. Mesh the whole body with C3D4 or "
            "C3D10, or a plane section with CPE3 or CPS3."
        )
    for family, dim in _FAMILIES:
        if match := family.fullmatch(element_type):
            nodes = next((int(digits) for digits in match.groups() if digits), 2)
            if nodes in KINDS[dim]:
                return KINDS[dim][nodes], nodes
    if _UNUSED.fullmatch(element_type):
        return None
    raise ValueError(
        f"the element type '{element_type[:40]}' is not supported. Supported are {SUPPORTED} and their variants (H, M, "
        "R, T, I, ...); export the mesh with C3D4 or C3D10 (in Abaqus/CAE: Mesh > Element Type)."
    )


def facet_columns(kind: str, identifier: str) -> tuple[int, ...] | None:
    """Columns of the corners of a face ("S2"; of shells "SPOS", "SNEG", "E1"); None if the cell has no such face."""
    shape = shape_of(kind)
    if identifier in ("SPOS", "SNEG") and shape in ("triangle", "quad"):
        return tuple(range(3 if shape == "triangle" else 4))
    letters = ("S", "F") if shape not in ("triangle", "quad") else ("S", "E", "F")
    faces = FACES.get(shape, ())
    if identifier[:1] in letters and identifier[1:].isdecimal() and 1 <= int(identifier[1:]) <= len(faces):
        return faces[int(identifier[1:]) - 1]
    return None


# Keywords that generate or move nodes and elements, which is not supported: without them the body would be incomplete.
GENERATORS = {"NGEN", "NFILL", "NCOPY", "NMAP", "ELGEN", "ELCOPY", "SYMMETRICMODELGENERATION", "SYSTEM", "PARAMETER"}
GENERATORS |= {"IMPORT"}
KEYWORDS = ("NODE", "ELEMENT", "NSET", "ELSET", "SURFACE", "PART", "INSTANCE", "ASSEMBLY", "INCLUDE")
NO_INDICES: Indices = np.zeros(0, np.int64)


@dataclass(frozen=True, eq=False)
class SetEntry:
    """Members of a set or surface, given in one of three ways.

    Attributes:
        block: of the keyword that has the entry.
        numbers: of nodes or elements.
        span: first, last and step of a range of numbers.
        name: of another set, or "instance.set" or "instance.number".
        instance: whose numbers or sets are meant; "": the one that has the entry.
        of_elements: whether nodes of the elements of the set `name` are meant.
        face: of the elements of a surface, such as "S2"; "": their free faces.
    """

    block: KeywordBlock
    numbers: Indices | None = None
    span: tuple[int, int, int] | None = None
    name: str = ""
    instance: str = ""
    of_elements: bool = False
    face: str = ""


@dataclass(eq=False)
class NamedSet:
    """A set of nodes or elements, or a surface, as written.

    Attributes:
        name: as written.
        internal: whether Abaqus/CAE made it for its own use.
        entries: its members.
        surface_kind: "ELEMENT", "NODE" or "UNION" of a surface, "" of one that is not used.
    """

    name: str
    internal: bool
    entries: list[SetEntry] = field(default_factory=list)
    surface_kind: str = ""


@dataclass(frozen=True, eq=False)
class ElementBlock:
    """Elements of one *ELEMENT: element numbers (m,) and node numbers (m, k)."""

    block: KeywordBlock
    kind: str
    ids: Indices
    nodes: Indices


@dataclass(eq=False)
class Component:
    """A part, an instance or, with the name "", the assembly; each has numbers of its own."""

    name: str
    opened: KeywordBlock | None = None
    nodes: list[tuple[KeywordBlock, Indices, Points]] = field(default_factory=list)
    elements: list[ElementBlock] = field(default_factory=list)
    unused: dict[str, int] = field(default_factory=dict)  # number of elements by type
    unused_ids: list[Indices] = field(default_factory=list)
    unused_nodes: list[Indices] = field(default_factory=list)
    node_sets: dict[str, NamedSet] = field(default_factory=dict)
    element_sets: dict[str, NamedSet] = field(default_factory=dict)
    surfaces: dict[str, NamedSet] = field(default_factory=dict)


def label_key(name: str) -> str:
    """The key of a name: letter case and the number of blanks do not count in Abaqus."""
    return " ".join(name.split()).upper()


class Deck:
    """Parts, instances and the assembly of an input file.

    Attributes:
        assembly: nodes, elements and sets outside parts and instances.
        parts: by key.
        instances: by key: the instance, the key of its part, and its keyword block.
        notes: messages to the user.
        last: the last keyword block of the file.
    """

    def __init__(self, path: Path) -> None:
        self.assembly = Component("")
        self.parts: dict[str, Component] = {}
        self.instances: dict[str, tuple[Component, str, KeywordBlock]] = {}
        self.notes: list[str] = []
        self._open: list[tuple[KeywordBlock, Component]] = []
        readers: dict[str, Callable[[KeywordBlock], None]] = {
            "NODE": self._nodes,
            "ELEMENT": self._elements,
            "NSET": self._set,
            "ELSET": self._set,
            "SURFACE": self._surface,
            "PART": self._begin,
            "INSTANCE": self._begin,
            "ASSEMBLY": self._begin,
            "ENDPART": self._end,
            "ENDINSTANCE": self._end,
            "ENDASSEMBLY": self._end,
        }
        blocks = keyword_blocks(path)
        for block in blocks:
            if block.keyword in readers:
                readers[block.keyword](block)
            elif block.keyword in GENERATORS and block.pieces:
                block.refuse(
                    f"*{block.keyword} is not supported: it makes or moves nodes or elements that are not in the file. "
                    "Write the mesh out in full, for example from Abaqus/CAE: Job > Write Input."
                )
            elif len(block.keyword) > 2 and any(word.startswith(block.keyword) for word in KEYWORDS):
                block.refuse(f"the keyword *{block.keyword} is cut short; write it in full, as *NODE or *ELEMENT.")
        self.last = blocks[-1] if blocks else KeywordBlock("", {}, SourceText(path, b""), 0)
        if self.last.keyword in ("NSET", "ELSET", "SURFACE") and self.last.is_open():
            self.notes.append(
                f"The file ends within a line of *{self.last.keyword}, without a line break; is the set whole?"
            )
        if self._open:
            block = self._open[-1][0]
            block.refuse(
                f"*{block.keyword} has no *END {block.keyword}; the file is cut short or damaged. Export it again."
            )

    @property
    def _scope(self) -> Component:
        """The part, instance or assembly that is being defined."""
        return self._open[-1][1] if self._open else self.assembly

    def _begin(self, block: KeywordBlock) -> None:
        """*PART, *INSTANCE or *ASSEMBLY."""
        kind, name = block.keyword, block.parameters.get("NAME", "")
        outer = self._open[-1][0].keyword if self._open else ""
        if outer != ("ASSEMBLY" if kind == "INSTANCE" else ""):
            if outer:
                block.refuse(f"*{kind} stands within *{outer}; *END {outer} is missing before it.")
            block.refuse("*INSTANCE stands outside *ASSEMBLY; the file is damaged. Export it again.")
        if kind == "ASSEMBLY":
            self._open.append((block, self.assembly))
            return
        if not name:
            block.refuse(f"*{kind} has no name; write *{kind}, NAME=...")
        if label_key(name) in (self.parts if kind == "PART" else self.instances):
            block.refuse(f"there is a {kind.lower()} '{name}' already; names must differ.")
        component = Component(name, block)
        if kind == "PART":
            self.parts[label_key(name)] = component
        else:
            part = block.parameters.get("PART", "")
            if label_key(part) not in self.parts:
                block.refuse(
                    f"instance '{name}' is of the part '{part}', which the file does not define before it (parts: "
                    f"{list_some(part.name for part in self.parts.values())}). An instance from an earlier analysis "
                    "cannot be read; export the whole model."
                )
            self.instances[label_key(name)] = component, label_key(part), block
        self._open.append((block, component))

    def _end(self, block: KeywordBlock) -> None:
        """*END PART, *END INSTANCE or *END ASSEMBLY."""
        kind = block.keyword.removeprefix("END")
        if not self._open or self._open[-1][0].keyword != kind:
            block.refuse(f"*END {kind} stands without *{kind}; the file is damaged. Export it again.")
        self._open.pop()

    def _nodes(self, block: KeywordBlock) -> None:
        """*NODE."""
        if block.parameters.get("SYSTEM", "R").upper() != "R":
            block.refuse("*NODE, SYSTEM= with cylindrical or spherical coordinates; write x, y, z.")
        block.check_ended()
        values, ends = block.numbers(np.float64)
        counts = np.diff(ends, prepend=0)
        width = int(counts[0]) if len(counts) else 4
        # a number and two or three coordinates, which up to three direction cosines of a normal may follow
        wrong = (counts != width) & ~((counts > 3) & (counts < 8) & (width > 3)) | (counts < 3) | (counts > 7)
        if wrong.any():
            line = int(np.flatnonzero(wrong)[0])
            block.refuse(
                f"a node has {counts[line] - 1} coordinates; 2 or 3 are needed, as many as the nodes before: "
                "1, 0.0, 0.5, 2.0. Is the line cut?",
                line,
            )
        rows = values[(ends - counts)[:, None] + np.arange(min(width, 4))] if len(counts) else np.zeros((0, 4))
        points = np.zeros((len(rows), 3))
        points[:, : rows.shape[1] - 1] = rows[:, 1:]
        with np.errstate(invalid="ignore"):
            ids = rows[:, 0].astype(np.int64)
        bad = (ids != rows[:, 0]) | (ids < 1) | ~np.isfinite(points).all(axis=1)
        if bad.any():
            block.refuse(
                "a node needs a whole number from 1 and finite coordinates: 1, 0.0, 0.5, 2.0.", int(bad.argmax())
            )
        self._scope.nodes.append((block, ids, points))
        self._add_to_set(block, "NSET", self._scope.node_sets, ids)

    def _add_to_set(self, block: KeywordBlock, key: str, sets: dict[str, NamedSet], ids: Indices) -> None:
        """Add nodes or elements to the set that their keyword names."""
        if name := block.parameters.get(key):
            _named(sets, name).entries.append(SetEntry(block, numbers=ids))

    def _elements(self, block: KeywordBlock) -> None:
        """*ELEMENT."""
        element_type = "".join(block.parameters.get("TYPE", "").upper().split())
        if not element_type:
            block.refuse(f"*ELEMENT has no type; write *ELEMENT, TYPE=C3D4. Supported are {SUPPORTED}.")
        try:
            shape = kind_of(element_type)
        except ValueError as error:
            block.refuse(str(error))
        if shape is None:
            ids = self._unused_elements(block, element_type)
        else:
            block.check_ended()
            rows = _element_rows(block, element_type, shape[1])
            ids = rows[:, 0]
            if shape[0] == "line3":  # Abaqus lists the midside node between the ends
                rows = rows[:, [0, 1, 3, 2]]
            self._scope.elements.append(ElementBlock(block, shape[0], ids, rows[:, 1:]))
        self._add_to_set(block, "ELSET", self._scope.element_sets, ids)

    def _unused_elements(self, block: KeywordBlock, element_type: str) -> Indices:
        """Count elements that are left out; their numbers and nodes are known, so that none counts as lost."""
        ids: list[int] = []
        nodes: list[int] = []
        continued = False
        for fields in block.lines():
            values = [int(v) for v in (parse_number(text, np.int64) for text in fields) if v is not None]
            if not continued:
                ids += values[:1]
            nodes += values[0 if continued else 1 :]
            continued = len(fields) > 15  # a full line goes on with the next one
        self._scope.unused[element_type] = self._scope.unused.get(element_type, 0) + len(ids)
        self._scope.unused_ids.append(np.array(ids, np.int64))
        self._scope.unused_nodes.append(np.array(nodes, np.int64))
        return self._scope.unused_ids[-1]

    def _set(self, block: KeywordBlock) -> None:
        """*NSET or *ELSET."""
        parameters = block.parameters
        name = parameters.get(block.keyword, "")
        if not name:
            block.refuse(f"*{block.keyword} has no name; write *{block.keyword}, {block.keyword}=left.")
        sets = self._scope.node_sets if block.keyword == "NSET" else self._scope.element_sets
        entries = _named(sets, name, "INTERNAL" in parameters).entries
        instance = parameters.get("INSTANCE", "")
        if block.keyword == "NSET" and parameters.get("ELSET"):
            entries.append(SetEntry(block, name=parameters["ELSET"], instance=instance, of_elements=True))
        if "GENERATE" in parameters:
            values, ends = block.numbers(np.int64)
            if not len(ends):
                block.refuse("GENERATE needs a line of first, last and step: 1, 380, 1. The data are missing.")
            for i, row in enumerate(np.split(values, ends[:-1])):
                first, last, step = [*row.tolist(), 1][:3] if len(row) in (2, 3) else (0, 0, 0)
                if step < 1 or last < first:
                    block.refuse("GENERATE needs first, last and step: 1, 380, 1.", i)
                entries.append(SetEntry(block, span=(first, last, step), instance=instance))
            return
        numbers: list[int] = []
        for fields in block.lines():
            for text in fields:
                value = parse_number(text, np.int64)
                if value is not None:
                    numbers.append(int(value))
                elif text:
                    entries.append(SetEntry(block, name=text, instance=instance))
        if numbers:
            entries.append(SetEntry(block, numbers=np.array(numbers, np.int64), instance=instance))

    def _surface(self, block: KeywordBlock) -> None:
        """*SURFACE."""
        name, kind = block.parameters.get("NAME", ""), block.parameters.get("TYPE", "ELEMENT").upper()
        if not name:
            block.refuse("*SURFACE has no name; write *SURFACE, TYPE=ELEMENT, NAME=top.")
        if combine := block.parameters.get("COMBINE", "").upper():
            kind = combine
        if kind not in ("ELEMENT", "NODE", "UNION"):
            self.notes.append(f"Surface '{name}' of the kind {kind[:40]} is not used.")
            kind = ""
        surface = _named(self._scope.surfaces, name, "INTERNAL" in block.parameters)
        surface.surface_kind = kind
        for i, fields in enumerate(block.lines() if kind else ()):
            if kind == "UNION":
                surface.entries += [SetEntry(block, name=text) for text in fields if text]
                continue
            if not fields[0] and kind == "ELEMENT" and not any(fields[1:]):
                surface.entries.append(SetEntry(block))  # the whole free surface
                continue
            if not fields[0] or len(fields) > 2:
                block.refuse("a line of *SURFACE needs a set or a number and a face: top_elements, S2.", i)
            face = fields[1].upper() if len(fields) == 2 and kind == "ELEMENT" else ""
            value = parse_number(fields[0], np.int64)
            numbers = None if value is None else np.array([value], np.int64)
            surface.entries.append(SetEntry(block, numbers, name="" if numbers is not None else fields[0], face=face))


def _named(sets: dict[str, NamedSet], name: str, internal: bool = False) -> NamedSet:
    """The set of a name, which is created if it does not exist."""
    return sets.setdefault(label_key(name), NamedSet(" ".join(name.split()), internal))


def _element_rows(block: KeywordBlock, element_type: str, nodes: int) -> Indices:
    """Element numbers and their nodes, (m, nodes + 1); an element may run over several lines."""
    values, ends = block.numbers(np.int64)
    width = nodes + 1
    # an element may continue on other lines, but has to end where a line ends
    element_ends = np.arange(width, (len(values) // width) * width + 1, width)
    last_line = np.searchsorted(ends, element_ends)
    aligned = ends[np.minimum(last_line, len(ends) - 1)] == element_ends if len(ends) else np.zeros(0, bool)
    if len(values) % width or not aligned.all():
        first = int(np.flatnonzero(~aligned)[0]) if not aligned.all() else len(aligned)
        line = int(np.searchsorted(ends, first * width, side="right"))
        count = int(ends[line] - first * width - 1)
        block.refuse(
            f"element {values[first * width]} has {count} nodes on this line; {element_type} needs {nodes}, and each "
            "element begins on a line of its own. Is the file cut or damaged? Export it again.",
            line,
        )
    rows = values.reshape(-1, width)
    if (bad := rows.min(axis=1, initial=1) < 1).any():
        block.refuse(
            f"element {rows[bad.argmax(), 0]} has a number below 1; numbers of elements and nodes begin with 1.",
            int(last_line[bad.argmax()]),
        )
    return rows
