"""What `fracsim list` shows."""

from __future__ import annotations

import tomllib

from ..forms.schemes import SCHEMES
from ..meshes import BUILDERS
from ..studies import folder
from . import Time

ENERGIES = {
    "linear": "Hooke's law; small strains and rotations; plane stress in 2D",
    "corotated": "Hooke's law that turns with the cell: small strains, large rotations",
    "stvk": "Saint Venant-Kirchhoff; moderate strains; plane stress in 2D",
    "neo-hookean": "stable neo-Hookean; large strains, any compression (default)",
}
OBSTACLES = {
    "plane": "normal: a half space",
    "sphere": "radius; in 2D a disk; hollow: a bowl",
    "capsule": "radius, length between the centres of its ends, axis",
    "cylinder": "radius, length, axis; rounded edges; 3D; hollow",
    "box": "size; rounded edges; hollow",
    "mesh": "file, scale: a closed surface of triangles; 3D; held or driven",
}


def catalogue() -> dict[str, dict[str, str]]:
    """Heading -> name -> words."""
    studies = {path.stem: tomllib.loads(path.read_text())["title"] for path in sorted(folder().glob("*.toml"))}
    builders = {name: (kind.__doc__ or "").strip().splitlines()[0] for name, kind in BUILDERS.items()}
    chosen = Time.model_fields["scheme"].default
    schemes = {name: kind.summary + " (default)" * (name == chosen) for name, kind in SCHEMES.items()}
    return {"studies": studies, "builders": builders, "energies": ENERGIES, "schemes": schemes, "obstacles": OBSTACLES}
