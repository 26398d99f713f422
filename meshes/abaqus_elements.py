"""Element types of Abaqus: shape, number of nodes, and faces by their identifiers.

Abaqus Analysis User's Guide, "Elements": names are a family, a number of nodes, and letters for the formulation
(H hybrid, M modified, T temperature, R reduced integration, I incompatible modes, ...), which do not change the shape.
"""

from __future__ import annotations

import re

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
