"""Universal files (.unv) of I-DEAS, as Salome, gmsh and FreeCAD write them.

Format: "Universal File Datasets", University of Cincinnati, SDRL. A dataset stands between lines `-1`; those of nodes,
elements and groups are read. Lines have fixed numbers of fields, separated by blanks.
"""

from __future__ import annotations

import re
from itertools import islice, pairwise
from pathlib import Path

import numpy as np

from .cell_sets import add_to_set
from .data import Indices, Points
from .file_text import Rows, SourceText, decode_text, excerpt, is_not_integer, read_text, refuse_file
from .mesh_conversion import Block, MeshFileContents, node_indices
from .topology import first_repeated, positions_of

# Number of a dataset -> its content; a member of a group has two or four fields.
DATASETS = {
    15: "nodes on one line", **dict.fromkeys((781, 2411), "nodes"), **dict.fromkeys((780, 2412), "elements"),
    **dict.fromkeys((2429, 2430, 2432), "groups of two fields"),
    **dict.fromkeys((2435, 2452, 2467, 2477), "groups of four fields"),
    **dict.fromkeys((151, 164, 2400, 2420), "head, units or coordinate systems"),
}  # fmt: skip
# Element type ("FE descriptor id") -> cell type, and the columns of the corners, then of the midside nodes; None: rigid
# elements, springs and masses, which are counted and left out.
_TRIANGLE6, _QUAD8 = [0, 2, 4, 1, 3, 5], [0, 2, 4, 6, 1, 3, 5, 7]
KINDS: dict[int, tuple[str, list[int]] | None] = {
    **dict.fromkeys((11, 21), ("line", [0, 1])), **dict.fromkeys((22, 23, 24), ("line3", [0, 2, 1])),
    **dict.fromkeys((41, 51, 61, 74, 81, 91), ("triangle", [0, 1, 2])),
    **dict.fromkeys((42, 52, 62, 72, 82, 92), ("triangle6", _TRIANGLE6)),
    **dict.fromkeys((44, 54, 64, 71, 84, 94), ("quad", [0, 1, 2, 3])),
    **dict.fromkeys((45, 55, 65, 75, 85, 95), ("quad8", _QUAD8)),
    111: ("tetra", [0, 1, 2, 3]), 118: ("tetra10", [0, 2, 4, 9, 1, 3, 5, 6, 7, 8]),
    112: ("wedge", [0, 1, 2, 3, 4, 5]), 113: ("wedge15", [0, 2, 4, 9, 11, 13, 1, 3, 5, 6, 7, 8, 10, 12, 14]),
    114: ("pyramid", [0, 1, 2, 3, 4]), 115: ("hexahedron", list(range(8))),
    116: ("hexahedron20", [0, 2, 4, 6, 12, 14, 16, 18, 1, 3, 5, 7, 8, 9, 10, 11, 13, 15, 17, 19]),
    **dict.fromkeys((121, 122, 136, 137, 138, 139, 141, 142, 151, 152, 161)),
}  # fmt: skip
NODE_LINE = "a node has a line `number 1 1 11`, then a line `x y z`"
ELEMENT_LINE = "an element has a line `number type property material colour nodes`, then its nodes, eight on a line"
GROUP_LINE = "a group has a line of eight whole numbers, a line with its name, then its members"
EXPORT = "Supported: nodes (2411), elements (2412) and groups (2467) of I-DEAS; in Salome File > Export > UNV."


def read_unv(path: Path) -> MeshFileContents:
    """Nodes, elements and groups.

    Raises:
        MeshError: the file is damaged, or holds elements that cannot be used; the message names file and line.
    """
    # Not by gmsh 4.13, which reads only its own groups (dataset 2477), and silently leaves out those of Salome.
    return _UniversalFile(SourceText(path, read_text(path))).contents()


class _UniversalFile:
    """Nodes, elements by type, and groups of a universal file."""

    def __init__(self, source: SourceText) -> None:
        self.source = source
        self.ids: list[Indices] = []
        self.points: list[Points] = []
        self.elements: dict[str, list[tuple[Indices, Indices]]] = {}  # kind -> element numbers, node numbers
        self.left_out: dict[str, int] = {}
        self.unused: list[str] = []
        self.groups: list[tuple[str, Indices, Indices]] = []  # name, node numbers, element numbers
        self._read()

    def _read(self) -> None:
        """Read every dataset."""
        text = self.source.text
        marks = [mark.start() for mark in re.finditer(rb"^[ \t]*-1[ \t]*$", text, re.MULTILINE)]
        if not marks or text[: marks[0]].strip():
            self.source.refuse(
                0, f"`{excerpt(text[:80])}` is not the line `-1` with which a universal file begins. {EXPORT}"
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
        """Read the dataset of a number, whose lines stand between two offsets."""
        content = DATASETS.get(number, "")
        if content.startswith("nodes"):
            self._nodes(self.source.rows(begin, end, NODE_LINE), one_line=content == "nodes on one line")
        elif content == "elements":
            self._elements(self.source.rows(begin, end, ELEMENT_LINE))
        elif content.startswith("groups"):
            self._groups(begin, end, width=4 if content == "groups of four fields" else 2)
        elif not content and str(number) not in self.unused:
            self.unused.append(str(number))

    def _nodes(self, lines: Rows, one_line: bool) -> None:
        """Read nodes: number, coordinate systems and colour, then coordinates, on one line or two."""
        counts = lines.counts
        step, widths = (1, [7]) if one_line else (2, [4, 3])
        if len(lines) % step:
            self.source.damaged(int(lines.offsets[-1]), f"the last node has no coordinates; {NODE_LINE}.")
        for i, width in enumerate(widths):
            if (wrong := counts[i::step] != width).any():
                row = i + step * int(wrong.argmax())
                self.source.damaged(
                    int(lines.offsets[row]),
                    f"this line of a node has {counts[row]} numbers instead of {width}; {NODE_LINE}.",
                )
        if not len(lines):
            return
        heads = lines.columns(slice(0, None, step), widths[0])
        points = heads[:, 4:] if one_line else lines.columns(slice(1, None, 2), 3)
        self.ids.append(self.source.integers(heads[:, 0], lines.offsets[::step], NODE_LINE))
        self.points.append(np.ascontiguousarray(points))

    def _elements(self, lines: Rows) -> None:
        """Read elements, a run of elements of one type and number of nodes at once."""
        # Types may alternate: of all lines that are left only a window is compared with the first element, which
        # doubles as long as the run fills it.
        min_window = 256
        counts, line, window = lines.counts, 0, min_window
        while line < len(lines):
            head = self._head(lines, line)
            type_, size = int(head[1]), int(head[5])
            # beams have a line of orientation and sections before their nodes
            beam = 11 <= type_ < 40
            # numbers on each line of an element: its head, the line of a beam, eight nodes on a line
            widths = [6, *([3] if beam else []), *([8] * (size // 8) + ([size % 8] if size % 8 else []))]
            period = len(widths)
            compared = min((len(lines) - line) // period, window)
            if not compared:
                self.source.damaged(int(lines.offsets[line]), f"element {int(head[0])} is cut short; {ELEMENT_LINE}.")
            table = counts[line : line + compared * period].reshape(compared, period)
            starts = lines.begins[line : line + compared * period : period]
            same = (table == widths).all(axis=1)
            same[same] &= (lines.values[starts[same] + 1] == type_) & (lines.values[starts[same] + 5] == size)
            run = compared if same.all() else int(same.argmin())
            if not run:
                bad = line + int((table[0] != widths).argmax())
                self.source.damaged(
                    int(lines.offsets[bad]), f"this line of element {int(head[0])} (type {type_}, {size} nodes) has "
                    f"{counts[bad]} numbers instead of {widths[bad - line]}; {ELEMENT_LINE}.",
                )  # fmt: skip
            first = lines.begins[line : line + run * period : period]
            values = lines.values[first[:, None] + np.arange(sum(widths))]
            rows = self.source.integers(
                values[:, [0, *range(6 + 3 * beam, sum(widths))]], lines.offsets[line::period][:run], ELEMENT_LINE
            )
            self._add(type_, size, rows, int(lines.offsets[line]))
            line += run * period
            window = 2 * window if run == compared else min_window

    def _head(self, lines: Rows, line: int) -> Points:
        """The six numbers of an element's first line: number, type, ..., number of nodes."""
        if lines.counts[line] != 6:
            self.source.damaged(
                int(lines.offsets[line]),
                f"{lines.counts[line]} numbers stand here instead of 6; {ELEMENT_LINE}.",
            )
        head = lines.columns([line], 6)[0]
        if is_not_integer(head).any() or not 0 <= head[5] <= 1000:  # nodes: many more than any element has
            self.source.damaged(int(lines.offsets[line]), f"this is no head of an element; {ELEMENT_LINE}.")
        return head

    def _add(self, type_: int, size: int, rows: Indices, offset: int) -> None:
        """Keep elements of one type: rows of an element number and its nodes."""
        if type_ not in KINDS:
            self.source.refuse(
                offset,
                f"an element is of the type {type_}, which is not supported. Supported are lines, triangles, quads, "
                "tetrahedra, prisms, pyramids and hexahedra of first and second order.",
            )
        if (supported := KINDS[type_]) is None:
            self.left_out[f"type {type_}"] = self.left_out.get(f"type {type_}", 0) + len(rows)
            return
        kind, order = supported
        if size != len(order):
            self.source.damaged(
                offset, f"an element of type {type_} ({kind}) has {size} nodes instead of {len(order)}."
            )
        self.elements.setdefault(kind, []).append((rows[:, 0], rows[:, 1:][:, order]))

    # --- groups ---

    def _groups(self, begin: int, end: int, width: int) -> None:
        """Read groups: a line of numbers with the count of members at its end, the name, members of `width` fields."""
        text = self.source.text
        while text[begin:end].strip():
            head_end = text.find(b"\n", begin, end) + 1
            name_end = text.find(b"\n", head_end, end) + 1
            head = self.source.rows(begin, head_end or end, GROUP_LINE)
            count = int(head.values[-1]) if len(head.values) and not is_not_integer(head.values).any() else -1
            if not head_end or not name_end or count < 0:
                self.source.damaged(begin, f"this is no head of a group; {GROUP_LINE}.")
            stop = _end_of_tokens(text, name_end, end, width * count)
            if stop < 0:
                self.source.damaged(begin, f"a group of {count} members ends before the last of them.")
            values = self.source.rows(name_end, stop, GROUP_LINE).values
            if len(values) != width * count:
                self.source.damaged(begin, f"a group of {count} members has more numbers on its last line.")
            members = self.source.integers(values, np.full(len(values), name_end), GROUP_LINE).reshape(-1, width)
            name = decode_text(text[head_end:name_end]).strip() or f"group-{int(head.values[0])}"
            nodes, elements = (members[members[:, 0] == entity, 1] for entity in (7, 8))  # entity type codes
            self.groups.append((name, nodes, elements))
            if other_members := len(members) - len(nodes) - len(elements):
                self.left_out["members of groups that are neither nodes nor elements"] = other_members
            begin = stop

    # --- contents ---

    def contents(self) -> MeshFileContents:
        """The file in arrays, groups as sets."""
        path = self.source.path
        if not self.points:
            refuse_file(path, "it has no dataset of nodes", EXPORT)
        ids, points = np.concatenate(self.ids), np.concatenate(self.points)
        if (repeated := first_repeated(ids)) is not None:
            refuse_file(path, f"node {repeated} is given twice")
        blocks: list[Block] = []
        element_ids: list[Indices] = []
        for kind, parts in self.elements.items():
            numbers, nodes = (np.concatenate(column) for column in zip(*parts, strict=True))
            blocks.append(Block(kind, node_indices(path, ids, numbers, nodes)))
            element_ids.append(numbers)
        notes = self._notes()
        sets, point_sets, lost = self._sets(ids, blocks, element_ids)
        if lost:
            notes.append(f"Groups name {lost} nodes or elements that are not in the file.")
        return MeshFileContents(points, blocks, sets, point_sets, notes=tuple(notes))

    def _sets(
        self, ids: Indices, blocks: list[Block], element_ids: list[Indices]
    ) -> tuple[dict[str, list[Indices]], dict[str, Indices], int]:
        """Sets of cells and of nodes, and how many members are not in the file."""
        sets: dict[str, list[Indices]] = {}
        point_sets: dict[str, Indices] = {}
        lost = 0
        numbers = np.concatenate([*element_ids, np.zeros(0, np.int64)])
        starts = np.cumsum([0, *map(len, element_ids)])
        if (repeated := first_repeated(numbers)) is not None:
            refuse_file(self.source.path, f"element {repeated} is given twice")
        for name, nodes, elements in self.groups:
            if len(nodes):
                indices = positions_of(ids, nodes)
                lost += int((indices < 0).sum())
                before = point_sets.get(name, indices[:0])
                point_sets[name] = np.union1d(before, indices[indices >= 0]).astype(np.int64)
            if not len(elements):
                continue
            indices = positions_of(numbers, elements)
            lost += int((indices < 0).sum())
            indices = np.unique(indices[indices >= 0])
            for i, (begin, end) in enumerate(pairwise(starts)):
                add_to_set(sets, blocks, name, i, indices[(indices >= begin) & (indices < end)] - begin)
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


def _end_of_tokens(text: bytes, begin: int, end: int, count: int) -> int:
    """Offset of the line after the one with the `count`-th token; -1 of fewer tokens."""
    if not count:
        return begin
    last = next(islice(re.compile(rb"\S+").finditer(text, begin, end), count - 1, None), None)
    if last is None:
        return -1
    stop = text.find(b"\n", last.end(), end)
    return end if stop < 0 else stop + 1
