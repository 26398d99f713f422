"""Numbers of points and cells that a legacy or XML file of VTK declares.

VTK's readers may return part of a damaged file without an error; each file is compared with what it declares.
"""

from __future__ import annotations

import base64
import re
from itertools import pairwise
from pathlib import Path
from typing import Any, Literal

from .file_text import decode_text
from .vtk_grid import refuse_vtk


def declared_in_legacy(data: Any) -> tuple[list[int], int | None]:
    """Number of points and of cells that a legacy file declares; None of a grid without a list of cells."""
    version = re.match(rb"# vtk DataFile Version (\d+)", data)
    flags = re.MULTILINE | re.IGNORECASE
    kind = re.search(rb"^DATASET[ \t]+(\w+)", data, flags)
    points = re.search(rb"^POINTS[ \t]+(\d+)", data, flags)
    polygons = kind is not None and kind[1].upper() == b"POLYDATA"
    keywords = rb"VERTICES|LINES|POLYGONS|TRIANGLE_STRIPS" if polygons else rb"CELLS"
    counts: dict[bytes, int] = {}
    # a file may be large: the search ends at the last section that counts
    for match in re.finditer(rb"^(" + keywords + rb"|CELL_DATA|POINT_DATA)[ \t]+(\d+)", data, flags):
        keyword = match[1].upper()
        if keyword.endswith(b"_DATA") or keyword in counts:
            break
        counts[keyword] = int(match[2])
        if not polygons:
            break
    offsets = version is not None and int(version[1]) >= 5  # it declares offsets, one more than cells
    cells = sum(max(count - offsets, 0) for count in counts.values()) if counts else None
    return ([int(points[1])] if points else []), cells


_ATTRIBUTE = rb"SCALARS|VECTORS|NORMALS|TENSORS6?|TEXTURE_COORDINATES|COLOR_SCALARS|GLOBAL_IDS|PEDIGREE_IDS|EDGE_FLAGS"


def check_legacy_arrays(path: Path, data: Any, counts: dict[str, int]) -> None:
    """Raise MeshError if a legacy file declares more arrays than `counts` of them, by "POINT_DATA" and "CELL_DATA".

    VTK 9.7 ends without an error where the text of an array is cut off. The last array of a text has to be whole.
    """
    flags = re.MULTILINE | re.IGNORECASE
    heads = list(re.compile(rb"^(POINT_DATA|CELL_DATA)[ \t]+\d+[ \t]*\r?$", flags).finditer(data))
    for head, after in pairwise([*heads, None]):
        assert head is not None
        begin, end = head.end(), after.start() if after else len(data)
        attributes = re.compile(rb"^(?:" + _ATTRIBUTE + rb")[ \t]+(\S+)", flags).finditer(data, begin, end)
        fields = re.compile(rb"^FIELD[ \t]+\S+[ \t]+(\d+)[ \t]*\r?$", flags).finditer(data, begin, end)
        declared = len({match[1] for match in attributes}) + sum(int(match[1]) for match in fields)
        kind = head[1].decode().upper()
        if counts[kind] < declared:
            refuse_vtk(path, f"{kind} declares {declared} arrays, of which {counts[kind]} can be read; it is damaged")
    is_text = re.match(rb"(?:[^\n]*\n){2}ASCII\b", data)
    arrays = (
        list(re.compile(rb"^\S+[ \t]+(\d+)[ \t]+(\d+)[ \t]+[a-z_]+[ \t]*\r?$", flags).finditer(data)) if is_text else []
    )
    if arrays and len(data[arrays[-1].end() :].split()) < int(arrays[-1][1]) * int(arrays[-1][2]):
        refuse_vtk(path, f"its last array, {arrays[-1][0].decode(errors='replace').split()[0]}, is cut off")


def declared_in_xml(data: Any) -> tuple[list[int], int | None]:
    """Number of points of each piece, and of all cells, that an XML file declares."""
    points, cells = [], 0
    end = data.find(b"<AppendedData")
    for piece in re.finditer(rb"<Piece\b([^>]*)>", data[:end] if end > 0 else data):
        numbers = {key: int(number) for key, number in re.findall(rb"(\w+)\s*=\s*[\"']\s*(\d+)\s*[\"']", piece[1])}
        points.append(numbers.get(b"NumberOfPoints", 0))
        cells += sum(numbers.get(b"NumberOf" + key, 0) for key in (b"Cells", b"Verts", b"Lines", b"Strips", b"Polys"))
    return points, cells


def check_xml_sizes(path: Path, data: Any) -> None:
    """Raise MeshError if an array of points or cells is longer than declared; VTK would read its beginning."""
    appended = re.search(rb"<AppendedData\b[^>]*>\s*_", data)
    text = data[: appended.start() if appended else len(data)]
    file = _xml_attributes(re.search(rb"<VTKFile\b[^>]*>", text))
    if appended:
        file["appended"] = _xml_attributes(appended).get("encoding", "base64")
    for piece in re.finditer(rb"<Piece\b[^>]*>", text):
        counts = _xml_attributes(piece)
        stop = text.find(b"</Piece>", piece.end())
        for section in _XML_SECTION.finditer(text, piece.end(), stop if stop > 0 else len(text)):
            name = decode_text(section[1])
            declared = int(counts.get(f"NumberOf{name}", "0").strip() or 0)
            end = text.find(b"</" + section[1], section.end())
            for tag in _XML_ARRAY.finditer(text, section.end(), end if end > 0 else len(text)):
                array = _xml_attributes(tag)
                if name != "Points" and array.get("Name") not in ("offsets", "types"):
                    continue
                if array.get("format") == "appended" and appended:
                    offset = array.get("offset", "")
                    begin = appended.end() + int(offset) if offset.isdigit() else len(data)
                    values = _xml_values(data[begin : begin + 64], array, file)
                else:
                    end_tag = tag.end() if tag[1] else text.find(b"<", tag.end())
                    values = _xml_values(text[tag.end() : end_tag], array, file)
                if values is not None and values > declared * (3 if name == "Points" else 1):
                    per_point = " (3 a point)" if name == "Points" else ""
                    refuse_vtk(
                        path,
                        f"it declares {declared} {name}, and its array '{array.get('Name', name)}' holds {values} "
                        f"numbers{per_point}",
                    )


_XML_SECTION = re.compile(rb"<(Points|Cells|Verts|Lines|Strips|Polys)>")


_XML_ARRAY = re.compile(rb"<DataArray\b[^>]*?(/?)>")


def _xml_attributes(tag: re.Match[bytes] | None) -> dict[str, str]:
    pairs = re.findall(rb"(\w+)\s*=\s*[\"']([^\"']*)[\"']", tag[0]) if tag else []
    return {decode_text(key): decode_text(value) for key, value in pairs}


def _xml_values(text: bytes, array: dict[str, str], file: dict[str, str]) -> int | None:
    """How many numbers an array of an XML file holds; None: unknown.

    Numbers of text are counted. Binary data begin with their number of bytes, compressed data with the number of
    blocks, the bytes of a block and those of a last, shorter block.
    """
    if array.get("format", "ascii") == "ascii":
        end = text.find(b"<")
        return len(text[: end if end >= 0 else len(text)].split())
    width = 8 if file.get("header_type") == "UInt64" else 4
    size = width * (3 if file.get("compressor") else 1)
    text = text.lstrip() if array["format"] == "binary" else text
    if array["format"] == "binary" or file.get("appended") == "base64":
        try:
            text = base64.b64decode(text[: -(-size // 3) * 4])
        except ValueError:
            return None  # VTK refuses it
    order: Literal["big", "little"] = "big" if file.get("byte_order") == "BigEndian" else "little"
    sizes = [int.from_bytes(text[i : i + width], order) for i in range(0, size, width)]
    if len(text) < width:
        return None
    if len(sizes) == 3:
        blocks, block, last = sizes
        sizes = [(blocks - 1) * block + (last or block) if blocks else 0]
    bits = re.fullmatch(r"U?(?:Int|Float)(8|16|32|64)", array.get("type", ""))
    return sizes[0] * 8 // int(bits[1]) if bits else None
