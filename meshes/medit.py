"""Text of Medit (.mesh), as FreeFem, mmg, gmsh and TetGen write it.

Format: "Medit: an interactive mesh visualization software", INRIA RT-0253 (2001), section on the format. A section is a
keyword, a count, and that many entries; the last number of an entry is its label.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from .cell_sets import sets_by_tag
from .data import Indices, Points
from .file_text import SourceText, excerpt, is_not_integer, refuse_file
from .mesh_conversion import Block, MeshFileContents

# Keyword -> cell type and its number of nodes
KINDS = {
    "Edges": ("line", 2), "Triangles": ("triangle", 3), "Quadrilaterals": ("quad", 4), "Tetrahedra": ("tetra", 4),
    "Hexahedra": ("hexahedron", 8), "Hexaedra": ("hexahedron", 8), "Prisms": ("wedge", 6), "Pentahedra": ("wedge", 6),
    "Pyramids": ("pyramid", 5), "EdgesP2": ("line3", 3), "TrianglesP2": ("triangle6", 6),
    "TetrahedraP2": ("tetra10", 10), "QuadrilateralsQ2": ("quad9", 9), "HexahedraQ2": ("hexahedron27", 27),
}  # fmt: skip
NUMBERS = "whole numbers of nodes and a label stand here"
_KEYWORD = re.compile(rb"^[ \t]*([A-Za-z]\w*)", re.MULTILINE)
_COMMENT = re.compile(rb"#[^\n]*")
EXPORT = 'Supported is the text of Medit with Vertices; in FreeFem savemesh(Th, "part.mesh") writes it.'


def read_medit(path: Path) -> MeshFileContents:
    """Vertices, and cells with their labels as sets "tag-3"; the label 0 is none.

    Raises:
        MeshError: the file is damaged; the message names file and line.
    """
    # Not by meshio 5.3, which knows few of the keywords and stops at the others.
    data = path.read_bytes()
    if not data.lstrip()[:20].startswith((b"MeshVersionFormatted", b"#")):
        refuse_file(path, f"it begins with `{excerpt(data[:60])}`, not with MeshVersionFormatted", EXPORT)
    return _Medit(SourceText(path, _COMMENT.sub(b"", data))).contents()


class _Medit:
    """Vertices and cells by kind of a Medit file."""

    def __init__(self, source: SourceText) -> None:
        self.source = source
        self.dim = 0
        self.points: Points | None = None
        self.cells: dict[str, list[Indices]] = {}  # kind -> (m, k + 1) node numbers and a label
        self.ended = False
        words = list(_KEYWORD.finditer(source.text))
        for word, end in zip(words, [*(after.start() for after in words[1:]), len(source.text)], strict=True):
            self._section(word[1].decode(), word.start(1), word.end(), end)

    def _section(self, name: str, at: int, begin: int, end: int) -> None:
        """Read the section of a keyword at `at`, whose data stand between two offsets."""
        if name == "Dimension":
            values = self.source.rows(begin, end, "the dimension, 2 or 3").values
            if len(values) != 1 or values[0] not in (2, 3):
                self.source.damaged(at, "the dimension is 2 or 3: `Dimension 3`.")
            self.dim = int(values[0])
        elif name == "Vertices":
            if not self.dim:
                self.source.damaged(at, "no line `Dimension 3` stands before the vertices.")
            rows = self._entries(name, at, begin, end, self.dim + 1, "coordinates and a label stand here")
            self.points = np.ascontiguousarray(rows[:, : self.dim])
        elif name in KINDS:
            kind, size = KINDS[name]
            # gmsh writes cells of second order under the keyword of first order
            quadratic = KINDS.get(name + "P2")
            if quadratic and self._holds(begin, end, quadratic[1] + 1):
                kind, size = quadratic
            rows = self._entries(name, at, begin, end, size + 1, NUMBERS)
            if (wrong := is_not_integer(rows).any(axis=1)).any():
                self.source.damaged(at, f"entry {wrong.argmax() + 1} of {name} has a number that is not whole.")
            self.cells.setdefault(kind, []).append(rows.astype(np.int64))
        elif name == "End":
            self.ended = True

    def _holds(self, begin: int, end: int, width: int) -> bool:
        """Whether the section holds as many entries of `width` numbers as it declares."""
        values = self.source.rows(begin, end, NUMBERS).values
        return len(values) > 1 and len(values) == 1 + width * values[0]

    def _entries(self, name: str, at: int, begin: int, end: int, width: int, expected: str) -> Points:
        """(count, width) the numbers of a section; MeshError names the first line of another length."""
        lines = self.source.rows(begin, end, expected)
        values = lines.values
        count = int(values[0]) if len(values) and not is_not_integer(values[:1])[0] and values[0] >= 0 else -1
        if len(values) != 1 + count * width:
            wrong = np.flatnonzero(lines.counts[1:] != width)
            self.source.damaged(
                int(lines.offsets[1 + wrong[0]]) if len(wrong) else at,
                f"the section {name} declares {count} entries of {width} numbers, and holds "
                f"{max(len(values) - 1, 0) / width:.6g} of them.",
            )
        return values[1:].reshape(count, width)

    def contents(self) -> MeshFileContents:
        """The file in arrays, labels as sets."""
        if self.points is None:
            refuse_file(self.source.path, "it has no section Vertices", EXPORT)
        count = len(self.points)
        blocks: list[Block] = []
        labels: list[Indices] = []
        for kind, parts in self.cells.items():
            rows = np.concatenate(parts)
            nodes = rows[:, :-1] - 1
            if (wrong := ((nodes < 0) | (nodes >= count)).any(axis=1)).any():
                refuse_file(
                    self.source.path,
                    f"the {kind} number {wrong.argmax() + 1} has a node that is not among the {count} vertices",
                )
            blocks.append(Block(kind, nodes))
            labels.append(rows[:, -1])
        sets, notes = sets_by_tag(labels, lambda *_: "", "labels")
        note = () if self.ended else ("The file lacks the keyword End: if it was cut off, cells are missing.",)
        return MeshFileContents(self.points, blocks, sets, notes=notes + note)
