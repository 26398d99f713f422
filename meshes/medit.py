"""Text of Medit (.mesh), as FreeFem, mmg, gmsh and TetGen write it.

Format: "Medit: an interactive mesh visualization software", INRIA RT-0253 (2001), section on the format. A section is a
keyword, a count, and that many entries; the last number of an entry is its label.

Not by meshio (5.3), which knows few of the keywords and stops at the others.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from .data import Indices, MeshError, Points
from .mesh_conversion import Block, MeshFileContents
from .tags import sets_by_tag
from .text_rows import EXPORT_AGAIN, SourceText, is_not_integer, shown

KINDS = {
    "Edges": ("line", 2), "Triangles": ("triangle", 3), "Quadrilaterals": ("quad", 4), "Tetrahedra": ("tetra", 4),
    "Hexahedra": ("hexahedron", 8), "Hexaedra": ("hexahedron", 8), "Prisms": ("wedge", 6), "Pentahedra": ("wedge", 6),
    "Pyramids": ("pyramid", 5), "EdgesP2": ("line3", 3), "TrianglesP2": ("triangle6", 6),
    "TetrahedraP2": ("tetra10", 10), "QuadrilateralsQ2": ("quad9", 9), "HexahedraQ2": ("hexahedron27", 27),
}  # fmt: skip
SECOND_ORDER = {"Edges": "EdgesP2", "Triangles": "TrianglesP2", "Tetrahedra": "TetrahedraP2"}  # the same for gmsh
NUMBERS = "whole numbers of nodes and a label stand here"
_KEYWORD = re.compile(rb"^[ \t]*([A-Za-z]\w*)", re.MULTILINE)
_COMMENT = re.compile(rb"#[^\n]*")
EXPORT = 'Supported is the text of Medit with Vertices; in FreeFem savemesh(Th, "part.mesh") writes it.'


def read_medit(path: Path) -> MeshFileContents:
    """Vertices, and cells with their labels as sets "tag-3"; the label 0 is none.

    Raises:
        MeshError: the file is damaged; the message names file and line.
    """
    data = path.read_bytes()
    if not data.lstrip()[:20].startswith((b"MeshVersionFormatted", b"#")):
        begin = shown(data[:60])
        raise MeshError(
            f"Mesh file '{path}' could not be read: it begins with `{begin}`, not with MeshVersionFormatted. {EXPORT}"
        )
    return _Medit(SourceText(path, _COMMENT.sub(b"", data))).contents()


class _Medit:
    def __init__(self, source: SourceText) -> None:
        self.source = source
        self.dim = 0
        self.points: Points | None = None
        self.cells: dict[str, list[Indices]] = {}  # kind -> rows of nodes and a label
        self.ended = False
        words = list(_KEYWORD.finditer(source.text))
        for word, end in zip(words, [*(after.start() for after in words[1:]), len(source.text)], strict=True):
            self._section(word[1].decode(), word.start(1), word.end(), end)

    def _section(self, name: str, at: int, begin: int, end: int) -> None:
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
            if name in SECOND_ORDER and self._holds(begin, end, KINDS[SECOND_ORDER[name]][1] + 1):
                kind, size = KINDS[SECOND_ORDER[name]]
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

    def _entries(self, name: str, position: int, begin: int, end: int, width: int, needed: str) -> Points:
        """(count, width) the numbers of a section; where one line lacks or has numbers the message has that line."""
        lines = self.source.rows(begin, end, needed)
        values = lines.values
        count = int(values[0]) if len(values) and not is_not_integer(values[:1])[0] and values[0] >= 0 else -1
        if len(values) != 1 + count * width:
            odd = np.flatnonzero(lines.counts[1:] != width)
            position = int(lines.offsets[1 + odd[0]]) if len(odd) else position
            result = max(len(values) - 1, 0) / width
            self.source.damaged(
                position,
                f"the section {name} declares {count} entries of {width} numbers, and holds {result:.6g} of them.",
            )
        return values[1:].reshape(count, width)

    def contents(self) -> MeshFileContents:
        if self.points is None:
            raise MeshError(f"Mesh file '{self.source.path}' could not be read: it has no section Vertices. {EXPORT}")
        blocks: list[Block] = []
        labels_of: list[Indices] = []
        tables = {kind: np.concatenate(parts) for kind, parts in self.cells.items()}
        for kind, rows in tables.items():
            nodes = rows[:, :-1] - 1
            if (missing := ((nodes < 0) | (nodes >= len(self.points))).any(axis=1)).any():
                raise MeshError(
                    f"Mesh file '{self.source.path}' could not be read: the {kind} number {missing.argmax() + 1} has a "
                    f"node that is not among the {len(self.points)} vertices. {EXPORT_AGAIN}"
                )
            blocks.append(Block(kind, nodes))
            labels_of.append(rows[:, -1])
        sets, notes = sets_by_tag(labels_of, lambda *_: "", "labels")
        note = () if self.ended else ("The file lacks the keyword End: if it was cut off, cells are missing.",)
        return MeshFileContents(self.points, blocks, sets, notes=notes + note)
