"""What `fracsim list` shows."""

from __future__ import annotations

import tomllib

from ..meshes import BUILDERS
from ..studies import folder

ENERGIES = {
    "linear": "Hooke's law; small strains and rotations; plane stress in 2D",
    "corotated": "Hooke's law that turns with the cell: small strains, large rotations",
    "stvk": "Saint Venant-Kirchhoff; moderate strains; plane stress in 2D",
    "neo-hookean": "stable neo-Hookean; large strains, any compression (default)",
}
SCHEMES = {
    "backward-euler": "first order, damps vibrations; at long steps as good as without inertia",
    "newmark": "second order; the trapezoidal rule unless beta and gamma say otherwise",
    "generalized-alpha": "second order; rho sets how much of the fastest modes is left after a step (default)",
    "explicit": "central differences, no system to solve; the step is cut to what the fastest cell allows",
    "quasi-static": "load stepping without inertia",
}


def catalogue() -> dict[str, dict[str, str]]:
    """Heading -> name -> words."""
    studies = {path.stem: tomllib.loads(path.read_text())["title"] for path in sorted(folder().glob("*.toml"))}
    builders = {name: (kind.__doc__ or "").strip().splitlines()[0] for name, kind in BUILDERS.items()}
    return {"studies": studies, "builders": builders, "energies": ENERGIES, "schemes": SCHEMES}
