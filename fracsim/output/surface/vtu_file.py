"""VTU files of a split surface, compressed by all ranks: appended raw data in blocks of zlib.

A block holds as many rows as every other one of its array, so that ranks compress whole blocks (compressed_rows). VTK
reads and writes the same format: https://docs.vtk.org/en/latest/vtk_file_formats/vtkxml_file_format.html
"""

from __future__ import annotations

import sys
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from xml.sax.saxutils import quoteattr

import numpy as np
import numpy.typing as npt

from ...mesh.split_surface.surface_numbering import SurfaceNumbering
from ...meshes.plain_files import create
from ..compressed_rows import RowCompressor, deflate
from ..fields_file import TENSOR_COMPONENTS, pad_to_3d

Ints = npt.NDArray[np.integer]
Rows = npt.NDArray[np.generic]
# of a block: few enough that each rank has blocks, and as many as zlib makes use of
ROWS_PER_BLOCK = 1 << 13
# VTK's numbers of cell types
_TRIANGLE, _LINE = 5, 3
_TYPE_NAMES = {"f4": "Float32", "f8": "Float64", "i4": "Int32", "i8": "Int64", "u1": "UInt8"}
_SECTIONS = ("PointData", "CellData", "Points", "Cells")


@dataclass(frozen=True)
class CompressedArray:
    """Array of a VTU file.

    Attributes:
        section: "PointData", "CellData", "Points" or "Cells".
        name: name of the array.
        dtype: of its numbers.
        components: numbers of a row.
        block_rows: rows of every block but the last.
        rows: rows of all blocks.
        blocks: compressed blocks.
    """

    section: str
    name: str
    dtype: np.dtype[Any]
    components: int
    block_rows: int
    rows: int
    blocks: list[bytes]

    def head(self, offset: int) -> str:
        """XML of the array; `offset`: of its data, bytes."""
        components = f' NumberOfComponents="{self.components}"' if self.components > 1 else ""
        # ParaView names six columns so by itself; other programs need the names
        if self.components == len(TENSOR_COMPONENTS):
            named = enumerate(TENSOR_COMPONENTS)
            components += "".join(f' ComponentName{column}="{axes.upper()}"' for column, axes in named)
        kind = _TYPE_NAMES[self.dtype.str[1:]]
        return f'<DataArray type="{kind}" Name={quoteattr(self.name)}{components} format="appended" offset="{offset}"/>'

    def data(self) -> list[bytes]:
        """Data of the array: the sizes of its blocks, and the blocks."""
        row_bytes = self.dtype.itemsize * self.components
        return _with_sizes(self.blocks, self.block_rows * row_bytes, self.rows * row_bytes)


def _with_sizes(blocks: list[bytes], block_bytes: int, all_bytes: int) -> list[bytes]:
    """Blocks, after the numbers of bytes that they take compressed and not; `all_bytes`: of all, not compressed."""
    sizes = [len(blocks), block_bytes, all_bytes % block_bytes, *map(len, blocks)]
    return [np.array(sizes, np.uint32).tobytes(), *blocks]


@dataclass(frozen=True)
class CompressedGrid:
    """Contents of a VTU file.

    Attributes:
        points, elements: their numbers.
        arrays: points, elements and fields.
        origins: names of the numbers in the field "origin"; none of an obstacle.
    """

    points: int
    elements: int
    arrays: list[CompressedArray]
    origins: list[str]

    def write(self, path: Path) -> None:
        """Write the file. Raises OSError."""
        sections: dict[str, list[str]] = {name: [] for name in _SECTIONS}
        data, field_data = list[bytes](), ""
        if self.origins:
            text = "".join(f"{name}\0" for name in self.origins).encode()
            data += _with_sizes([deflate(text)], len(text) + 1, len(text))
            field_data = (
                f'    <FieldData>\n      <Array type="String" Name="origins" NumberOfTuples="{len(self.origins)}" '
                'format="appended" offset="0"/>\n    </FieldData>\n'
            )
        for array in self.arrays:
            sections[array.section].append(f"        {array.head(sum(map(len, data)))}\n")
            data += array.data()
        pieces = [f"      <{name}>\n{''.join(lines)}      </{name}>\n" for name, lines in sections.items()]
        order = "LittleEndian" if sys.byteorder == "little" else "BigEndian"
        head = (
            f'<VTKFile type="UnstructuredGrid" version="0.1" byte_order="{order}" header_type="UInt32" '
            f'compressor="vtkZLibDataCompressor">\n  <UnstructuredGrid>\n{field_data}'
            f'    <Piece NumberOfPoints="{self.points}" NumberOfCells="{self.elements}">\n{"".join(pieces)}'
            '    </Piece>\n  </UnstructuredGrid>\n  <AppendedData encoding="raw">\n   _'
        )
        with create(path) as file:
            file.write(head.encode())
            for part in data:
                file.write(part)
            file.write(b"\n  </AppendedData>\n</VTKFile>\n")


class GridCompressor:
    """Compresses points, elements and fields of a surface of which ranks have parts, while its elements stay."""

    def __init__(self, numbering: SurfaceNumbering, triangles: Ints, segments: Ints) -> None:
        """Compress the elements (collective).

        Args:
            numbering: of the points and elements of this rank.
            triangles: points (k, 3) of this rank.
            segments: points (m, 2) of this rank.
        """
        self._numbering, comm = numbering, numbering.comm
        self._compressors = {
            "Point": self._compressor(numbering.points[numbering.is_own]),
            "Cell": self._compressor(numbering.elements),
        }
        is_triangle = numbering.elements < numbering.triangle_count
        end = 2 * numbering.elements + np.minimum(numbering.elements + 1, numbering.triangle_count) + 2
        sizes, corners = np.where(is_triangle, 3, 2), np.concatenate([triangles.ravel(), segments.ravel()])
        within = np.arange(len(corners)) - np.repeat(np.cumsum(sizes) - sizes, sizes)
        corner_rows = self._compressor(np.repeat(end - sizes, sizes) + within)
        # half the bytes of 64-bit numbers before compression
        is_small = max(corner_rows.rows, numbering.point_count) <= np.iinfo(np.int32).max
        number = np.int32 if is_small else np.int64
        types = np.where(is_triangle, _TRIANGLE, _LINE).astype(np.uint8)
        self._comm, self._elements = comm, [
            _compressed("Cells", "connectivity", numbering.points[corners].astype(number), corner_rows),
            _compressed("Cells", "offsets", end.astype(number), self._compressors["Cell"]),
            _compressed("Cells", "types", types, self._compressors["Cell"]),
        ]  # fmt: skip

    def _compressor(self, numbers: npt.NDArray[np.int64]) -> RowCompressor:
        comm = self._numbering.comm
        return RowCompressor(comm, numbers, ROWS_PER_BLOCK, compress=deflate, fill_last=False)

    def __call__(
        self, points: Rows, point_fields: dict[str, Rows], element_fields: dict[str, Rows], origins: Iterable[str] = ()
    ) -> CompressedGrid | None:
        """The surface on rank 0, None elsewhere (collective).

        Args:
            points: positions (n, d) of the points of this rank, m.
            point_fields: rows (n, ...) by name.
            element_fields: rows (m, ...) of the elements of this rank by name.
            origins: names of the numbers in the field "origin".
        """
        is_own, rows = self._numbering.is_own, self._compressors
        of_points = {("PointData", name): values for name, values in point_fields.items()} | {
            ("Points", "Points"): points
        }
        arrays = [_compressed(*key, values[is_own], rows["Point"]) for key, values in of_points.items()]
        arrays += [_compressed("CellData", name, values, rows["Cell"]) for name, values in element_fields.items()]
        if self._numbering.comm.rank:
            return None
        elements = self._numbering.triangle_count + self._numbering.segment_count
        return CompressedGrid(self._numbering.point_count, elements, arrays + self._elements, list(origins))


def _compressed(section: str, name: str, values: Rows, compressor: RowCompressor) -> CompressedArray:
    """Array with rows of all ranks, without its blocks on ranks other than 0 (collective)."""
    rows = pad_to_3d(values)
    components = rows.shape[1] if rows.ndim == 2 else 1
    blocks = compressor(rows) or []
    return CompressedArray(section, name, rows.dtype, components, compressor.chunk_rows, compressor.rows, blocks)
