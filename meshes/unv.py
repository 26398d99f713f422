"""Universal files (.unv) of I-DEAS, as Salome, gmsh and FreeCAD write them.

Format: datasets between lines `-1`, of which those of nodes, elements and groups are read ("Universal File Datasets",
University of Cincinnati, SDRL). Lines have fixed numbers of fields, which blanks separate.

Not by gmsh (4.13), which reads groups of gmsh's own files only (dataset 2477), without a word on those of Salome.
"""

from __future__ import annotations

import re
from itertools import pairwise
from pathlib import Path

import numpy as np

from .data import Indices, MeshError, Points
from .mesh_conversion import Block, MeshFileContents
from .text_rows import Rows, SourceText, decode_text, is_not_integer, numbered, shown

OLD_NODES, NODES = (15,), (781, 2411)
ELEMENTS = (780, 2412)
GROUPS = (2429, 2430, 2432, 2435, 2452, 2467, 2477)
PAIRED = (2435, 2452, 2467, 2477)  # eight fields on the first line, four for a member; two in the older ones
IGNORED = (151, 164, 2400, 2420)  # head, units, coordinate systems
# Element types ("FE descriptor id"): kind, and the places of the corners, then of the nodes between.
_TRIANGLE6, _QUAD8 = [0, 2, 4, 1, 3, 5], [0, 2, 4, 6, 1, 3, 5, 7]
KINDS: dict[int, tuple[str, list[int]]] = {
    **dict.fromkeys((11, 21), ("line", [0, 1])), **dict.fromkeys((22, 23, 24), ("line3", [0, 2, 1])),
    **dict.fromkeys((41, 51, 61, 74, 81, 91), ("triangle", [0, 1, 2])),
    **dict.fromkeys((42, 52, 62, 72, 82, 92), ("triangle6", _TRIANGLE6)),
    **dict.fromkeys((44, 54, 64, 71, 84, 94), ("quad", [0, 1, 2, 3])),
    **dict.fromkeys((45, 55, 65, 75, 85, 95), ("quad8", _QUAD8)),
    111: ("tetra", [0, 1, 2, 3]), 118: ("tetra10", [0, 2, 4, 9, 1, 3, 5, 6, 7, 8]),
    112: ("wedge", [0, 1, 2, 3, 4, 5]), 113: ("wedge15", [0, 2, 4, 9, 11, 13, 1, 3, 5, 6, 7, 8, 10, 12, 14]),
    114: ("pyramid", [0, 1, 2, 3, 4]), 115: ("hexahedron", list(range(8))),
    116: ("hexahedron20", [0, 2, 4, 6, 12, 14, 16, 18, 1, 3, 5, 7, 8, 9, 10, 11, 13, 15, 17, 19]),
}  # fmt: skip
BEAMS = range(11, 40)  # have a line of their own before their nodes
ONE_NODE = (121, 122, 136, 137, 138, 139, 141, 142, 151, 152, 161)  # rigid, springs, masses: left out and counted
_WORD = re.compile(rb"\S+")
MIN_WINDOW = 256  # elements that are compared with the first of them at once
MAX_NODES = 1000  # of an element
NODE_LINE = "a node has a line `number 1 1 11`, then a line `x y z`"
ELEMENT_LINE = "an element has a line `number type property material colour nodes`, then its nodes, eight on a line"
GROUP_LINE = "a group has a line of eight whole numbers, a line with its name, then its members"
EXPORT = "Supported: nodes (2411), elements (2412) and groups (2467) of I-DEAS; in Salome File > Export > UNV."


def read_unv(path: Path) -> MeshFileContents:
    """Nodes, elements and groups.

    Raises:
        MeshError: the file is damaged, or holds elements that cannot be used; the message names file and line.
    """
    data = path.read_bytes()
    if b"\r" in data:
        data = data.replace(b"\r\n", b"\n").replace(b"\r", b"\n")
    return _Unv(SourceText(path, data)).contents()


class _Unv:
    def __init__(self, source: SourceText) -> None:
        self.source = source
        self.ids: list[Indices] = []
        self.points: list[Points] = []
        self.elements: dict[str, list[tuple[Indices, Indices]]] = {}  # kind -> element numbers, their nodes
        self.left_out: dict[str, int] = {}
        self.unused: list[str] = []
        self.groups: list[tuple[str, Indices, Indices]] = []  # name, nodes, elements
        self._read()

    def _read(self) -> None:
        text = self.source.text
        marks = [mark.start() for mark in re.finditer(rb"^[ \t]*-1[ \t]*$", text, re.MULTILINE)]
        if not marks or text[: marks[0]].strip():
            self.source.refuse(
                0, f"`{shown(text[:80])}` is not the line `-1` with which a universal file begins. {EXPORT}"
            )
        if len(marks) % 2:
            self.source.damaged(
                marks[-1],
                "the dataset that begins here has no line `-1` at its end: the file was cut off.",
            )
        for begin, end in zip(marks[::2], marks[1::2], strict=True):
            line = re.compile(rb"[ \t]*-1[ \t]*\n[ \t]*(\d{1,6})b?\b[^\n]*\n").match(text, begin)
            if not line or line.end() > end:
                self.source.damaged(begin, "no number of a dataset stands behind this line `-1`.")
            self._dataset(int(line[1]), line.end(), end)
        for first, second in zip(marks[1::2], marks[2::2], strict=False):
            if text[first:second].split()[1:]:
                self.source.damaged(first, "lines stand between two datasets.")
        if text[marks[-1] :].split()[1:]:
            self.source.damaged(marks[-1], "lines stand behind the last dataset.")

    def _dataset(self, number: int, begin: int, end: int) -> None:
        if number in NODES or number in OLD_NODES:
            self._nodes(self.source.rows(begin, end, NODE_LINE), number in OLD_NODES, begin)
        elif number in ELEMENTS:
            self._elements(self.source.rows(begin, end, ELEMENT_LINE))
        elif number in GROUPS:
            self._groups(number, begin, end)
        elif number not in IGNORED and str(number) not in self.unused:
            self.unused.append(str(number))

    def _nodes(self, lines: Rows, one_line: bool, begin: int) -> None:
        counts = lines.counts
        step, widths = (1, [7]) if one_line else (2, [4, 3])
        if len(lines) % step:
            self.source.damaged(int(lines.offsets[-1]), f"the last node has no coordinates; {NODE_LINE}.")
        for i, width in enumerate(widths):
            if (wrong := counts[i::step] != width).any():
                position = int(lines.offsets[i::step][wrong.argmax()])
                count = int(counts[i::step][wrong.argmax()])
                self.source.damaged(
                    position, f"this line of a node has {count} numbers instead of {width}; {NODE_LINE}."
                )
        if not len(lines):
            return
        heads = lines.columns(slice(0, None, step), widths[0])
        points = heads[:, 4:] if one_line else lines.columns(slice(1, None, 2), 3)
        ids = self._whole(heads[:, 0], lines.offsets[::step], NODE_LINE)
        self.ids.append(ids)
        self.points.append(np.ascontiguousarray(points))

    def _whole(self, values: Points, offsets: Indices, needed: str) -> Indices:
        rows = is_not_integer(values).reshape(len(values), -1).any(axis=1) if values.size else np.zeros(0, bool)
        if rows.any():
            self.source.damaged(int(offsets[rows.argmax()]), f"a number of this line is not whole; {needed}.")
        whole: Indices = values.astype(np.int64)
        return whole

    def _elements(self, lines: Rows) -> None:
        """Runs of elements of one type, which have equally many lines, are taken at once."""
        counts, line, window = lines.counts, 0, MIN_WINDOW
        while line < len(lines):
            head = self._head(lines, line)
            type_, size = int(head[1]), int(head[5])
            beam = type_ in BEAMS
            wanted = [6, *([3] if beam else []), *([8] * (size // 8) + ([size % 8] if size % 8 else []))]
            period = len(wanted)
            room = min((len(lines) - line) // period, window)  # types may alternate: not all that is left is looked at
            if not room:
                self.source.damaged(int(lines.offsets[line]), f"element {int(head[0])} is cut short; {ELEMENT_LINE}.")
            table = counts[line : line + room * period].reshape(room, period)
            starts = lines.begins[line : line + room * period : period]
            same = (table == wanted).all(axis=1)
            same[same] &= (lines.values[starts[same] + 1] == type_) & (lines.values[starts[same] + 5] == size)
            run = room if same.all() else int(same.argmin())
            if not run:
                bad = line + int((table[0] != wanted).argmax())
                self.source.damaged(
                    int(lines.offsets[bad]), f"this line of element {int(head[0])} (type {type_}, {size} nodes) has "
                    f"{counts[bad]} numbers instead of {wanted[bad - line]}; {ELEMENT_LINE}.",
                )  # fmt: skip
            first = lines.begins[line : line + run * period : period]
            values = lines.values[first[:, None] + np.arange(sum(wanted))]
            rows = self._whole(
                values[:, [0, *range(6 + 3 * beam, sum(wanted))]], lines.offsets[line::period][:run], ELEMENT_LINE
            )
            self._add(type_, size, rows, int(lines.offsets[line]))
            line += run * period
            window = 2 * window if run == room else MIN_WINDOW

    def _head(self, lines: Rows, line: int) -> Points:
        if lines.counts[line] != 6:
            self.source.damaged(
                int(lines.offsets[line]),
                f"{lines.counts[line]} numbers stand here instead of 6; {ELEMENT_LINE}.",
            )
        head = lines.columns([line], 6)[0]
        if is_not_integer(head).any() or not 0 <= head[5] <= MAX_NODES:
            self.source.damaged(int(lines.offsets[line]), f"this is no head of an element; {ELEMENT_LINE}.")
        return head

    def _add(self, type_: int, size: int, rows: Indices, offset: int) -> None:
        if type_ not in KINDS:
            if type_ not in ONE_NODE:
                self.source.refuse(
                    offset,
                    f"an element is of the type {type_}, which is not supported. Supported are lines, triangles, "
                    "quads, tetrahedra, prisms, pyramids and hexahedra of first and second order.",
                )  # fmt: skip
            self.left_out[f"type {type_}"] = self.left_out.get(f"type {type_}", 0) + len(rows)
            return
        kind, order = KINDS[type_]
        if size != len(order):
            self.source.damaged(
                offset, f"an element of type {type_} ({kind}) has {size} nodes instead of {len(order)}."
            )
        self.elements.setdefault(kind, []).append((rows[:, 0], rows[:, 1:][:, order]))

    # --- groups ---

    def _groups(self, number: int, begin: int, end: int) -> None:
        """A line of numbers, of which the last is the count of members; the name; then the members."""
        text, width = self.source.text, 4 if number in PAIRED else 2
        while text[begin:end].strip():
            head_end = text.find(b"\n", begin, end) + 1
            name_end = text.find(b"\n", head_end, end) + 1
            head = self.source.rows(begin, head_end or end, GROUP_LINE)
            count = int(head.values[-1]) if len(head.values) and not is_not_integer(head.values).any() else -1
            if not head_end or not name_end or count < 0:
                self.source.damaged(begin, f"this is no head of a group; {GROUP_LINE}.")
            stop = _after_tokens(text, name_end, end, width * count)
            if stop < 0:
                self.source.damaged(begin, f"a group of {count} members ends before the last of them.")
            values = self.source.rows(name_end, stop, GROUP_LINE).values
            if len(values) != width * count:
                self.source.damaged(begin, f"a group of {count} members has more numbers on its last line.")
            members = self._whole(values, np.full(len(values), name_end), GROUP_LINE).reshape(-1, width)
            name = decode_text(text[head_end:name_end]).strip() or f"group-{int(head.values[0])}"
            nodes, elements = (members[members[:, 0] == kind, 1] for kind in (7, 8))
            self.groups.append((name, nodes, elements))
            if second := len(members) - len(nodes) - len(elements):
                self.left_out["members of groups that are neither nodes nor elements"] = second
            begin = stop

    # --- result ---

    def contents(self) -> MeshFileContents:
        if not self.points:
            raise MeshError(f"Mesh file '{self.source.path}' could not be read: it has no dataset of nodes. {EXPORT}")
        ids, points = np.concatenate(self.ids), np.concatenate(self.points)
        if len(np.unique(ids)) < len(ids):
            ordered = np.sort(ids)
            self.source.damaged(0, f"node {ordered[np.flatnonzero(np.diff(ordered) == 0)[0]]} is given twice.")
        blocks: list[Block] = []
        owners: list[Indices] = []
        for kind, parts in self.elements.items():
            numbers, nodes = (np.concatenate(column) for column in zip(*parts, strict=True))
            positions = numbered(ids, nodes)
            if (missing := (positions < 0).any(axis=1)).any():
                row = int(missing.argmax())
                self.source.damaged(
                    0, f"element {numbers[row]} has the node {nodes[row][positions[row] < 0][0]}, which is not among "
                    f"the {len(ids)} nodes of the file.",
                )  # fmt: skip
            blocks.append(Block(kind, positions))
            owners.append(numbers)
        notes = self._notes()
        sets, point_sets, lost = self._sets(ids, blocks, owners)
        if lost:
            notes.append(f"Groups name {lost} nodes or elements that are not in the file.")
        return MeshFileContents(points, blocks, sets, point_sets, notes=tuple(notes))

    def _sets(
        self, ids: Indices, blocks: list[Block], owners: list[Indices]
    ) -> tuple[dict[str, list[Indices]], dict[str, Indices], int]:
        sets: dict[str, list[Indices]] = {}
        point_sets: dict[str, Indices] = {}
        lost = 0
        numbers = np.concatenate([*owners, np.zeros(0, np.int64)])
        starts = np.cumsum([0, *map(len, owners)])
        if len(np.unique(numbers)) < len(numbers):
            ordered = np.sort(numbers)
            again = ordered[np.flatnonzero(np.diff(ordered) == 0)[0]]
            self.source.damaged(0, f"element {again} is given twice.")
        for name, nodes, elements in self.groups:
            if len(nodes):
                positions = numbered(ids, nodes)
                lost += int((positions < 0).sum())
                point_sets[name] = np.union1d(point_sets.get(name, positions[:0]), positions[positions >= 0]).astype(
                    np.int64
                )
            if not len(elements):
                continue
            positions = numbered(numbers, elements)
            lost += int((positions < 0).sum())
            positions = np.unique(positions[positions >= 0])
            members = sets.setdefault(name, [np.zeros(0, np.int64) for _ in blocks])
            for i, (begin, end) in enumerate(pairwise(starts)):
                part = positions[(positions >= begin) & (positions < end)] - begin
                members[i] = np.union1d(members[i], part).astype(np.int64)
        return sets, point_sets, lost

    def _notes(self) -> list[str]:
        notes = []
        if self.left_out:
            notes.append(
                f"Not used: {', '.join(f'{count} {description}' for description, count in self.left_out.items())}."
            )
        if self.unused:
            notes.append(f"Datasets of the universal file that are not used: {', '.join(self.unused)}.")
        return notes


def _after_tokens(text: bytes, begin: int, end: int, count: int) -> int:
    """Offset of the line behind so many words; -1 where there are fewer."""
    if not count:
        return begin
    for i, word in enumerate(_WORD.finditer(text, begin, end), start=1):
        if i == count:
            stop = text.find(b"\n", word.end(), end)
            return end if stop < 0 else stop + 1
    return -1
