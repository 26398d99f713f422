"""Contents of `fracsim list`: studies, builders, energies, schemes, obstacles and materials."""

from __future__ import annotations

import tomllib

from ..forms.schemes import SCHEMES
from ..meshes import BUILDERS
from ..studies import folder
from . import TimeSettings
from .material_library import MATERIALS
from .plugins import GROUPS, plugin_names

ENERGIES = {
    "linear": "Hooke's law; small strains and rotations; plane strain or plane stress in 2D",
    "corotated": "Hooke's law that turns with the cell: small strains, large rotations",
    "stvk": "Saint Venant-Kirchhoff; moderate strains; plane strain or plane stress in 2D",
    "neo-hookean": "stable neo-Hookean; large strains, any compression (default)",
}
OBSTACLES = {
    "plane": "normal: a half space",
    "sphere": "radius; in 2D a disk; hollow: a bowl",
    "capsule": "radius, length between the centres of its ends, axis",
    "cylinder": "radius, length, axis; rounded edges; 3D; hollow",
    "box": "size; rounded edges; hollow",
    "mesh": "file, scale: a closed surface of triangles; 3D",
}


def material_table() -> list[str]:
    """Returns the lines of `fracsim list materials`."""
    header = f"{'':27}{'E, Pa':>9} {'nu':>5} {'rho':>6} {'f_t, Pa':>9} {'G_c, J/m^2':>10} {'l_ch, m':>8}  source"
    lines = ["materials: [material] like = NAME; l_ch = E' G_c / f_t^2", header]
    for name, material in MATERIALS.items():
        energy, length = ("-" if value is None else f"{value:.3g}" for value in (material.energy, material.length))
        plastic = f"; yields at {material.yield_stress:.3g} Pa" if material.yield_stress is not None else ""
        elastic = f"{material.young:9.3g} {material.poisson:5.3g} {material.density:6.4g}"
        lines.append(
            f"  {name:25}{elastic} {material.strength:9.3g} {energy:>10} {length:>8}  {material.source}{plastic}"
        )
    return lines


def catalogue() -> dict[str, dict[str, str]]:
    """Returns heading -> name -> description."""
    studies = {
        path.stem: tomllib.loads(path.read_text(encoding="utf-8"))["title"] for path in sorted(folder().glob("*.toml"))
    }
    builders = {name: (kind.__doc__ or "").strip().splitlines()[0] for name, kind in BUILDERS.items()}
    default = TimeSettings.model_fields["scheme"].default
    schemes = {name: kind.summary + " (default)" * (name == default) for name, kind in SCHEMES.items()}
    lists = {"studies": studies, "builders": builders, "energies": ENERGIES, "schemes": schemes, "obstacles": OBSTACLES}
    plugins = {name: GROUPS[group] for group in GROUPS for name in plugin_names(group)}
    return lists | ({"plug-ins": plugins} if plugins else {})
