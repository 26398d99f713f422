"""Materials by name: `material.like = "soda-lime glass"`; a study may override each value.

Typical values at room temperature in SI units. Values are those for which the sources are known, and were not verified
in print again. Fracture energies follow from K_c by G_c = K_c^2 / E' (plane strain). Strength and fracture energy
scatter by tens of per cent between specimens, and strength depends on size: important values should be measured.
Poisson's ratio of nearly incompressible materials is 0.45 here, since linear cells lock near 0.5.
"""

from __future__ import annotations

import difflib
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class NamedMaterial:
    """Values of a material.

    Attributes:
        young, strength: Pa.
        poisson: Poisson's ratio.
        density: kg/m^3.
        energy: G_c in J/m^2; None if no source gives one.
        source: of which value; M22 is Mandal et al. (2022), table 2.
        yield_stress: Pa, if the material yields before it breaks.
    """

    young: float
    poisson: float
    density: float
    strength: float
    energy: float | None
    source: str
    yield_stress: float | None = None

    @property
    def length(self) -> float | None:
        """Irwin's length l_ch = E' G_c / f_t^2 in plane strain, m; None without a fracture energy.

        Bodies that are much larger break by G_c rather than by strength.
        """
        if self.energy is None:
            return None
        return self.young / (1 - self.poisson**2) * self.energy / self.strength**2


def _fracture_energy(k: float, young: float, poisson: float) -> float:
    """G_c in J/m^2 from K_c in Pa m^(1/2), to two digits."""
    return float(f"{k**2 * (1 - poisson**2) / young:.2g}")


# M22 gives E, nu, rho, strength and yield stress of its materials, and no fracture energies
MATERIALS: dict[str, NamedMaterial] = {
    "soda-lime glass": NamedMaterial(
        7.0e10, 0.22, 2500.0, 4.5e7, _fracture_energy(7.5e5, 7.0e10, 0.22),
        "E, nu, rho, f_t (annealed float, characteristic): EN 572-1; K_c 0.75 MPa m^1/2: Lawn (1993)",
    ),
    "borosilicate glass": NamedMaterial(
        6.4e10, 0.20, 2230.0, 2.5e7, _fracture_energy(7.7e5, 6.4e10, 0.20),
        "E, nu, rho: ISO 3585; f_t as ground: DIN EN 1595; K_c 0.77 MPa m^1/2: Wiederhorn (1969)",
    ),
    "fused silica": NamedMaterial(
        7.25e10, 0.17, 2203.0, 5.0e7, _fracture_energy(7.5e5, 7.25e10, 0.17),
        "E, nu, rho, f_t: Heraeus data sheet; K_c 0.75 MPa m^1/2: Wiederhorn (1969)",
    ),
    "porcelain": NamedMaterial(
        7.0e10, 0.22, 2400.0, 3.5e7, _fracture_energy(1.1e6, 7.0e10, 0.22),
        "quartz porcelain C 110: IEC 60672-3 (f_t unglazed, tension); K_c about 1.1 MPa m^1/2: Ashby & Jones. "
        "M22 has E = 1e10, rho = 1000, 5e7",
    ),
    "alumina": NamedMaterial(
        4.16e11, 0.231, 3984.0, 2.67e8, _fracture_energy(3.5e6, 4.16e11, 0.231),
        "sintered, 99.5 %: Munro, J. Am. Ceram. Soc. 80 (1997)",
    ),
    "granite": NamedMaterial(
        4.5e10, 0.33, 2750.0, 9.56e6, _fracture_energy(1.6e6, 4.5e10, 0.33),
        "E, nu, rho, f_t: M22 after Ghouli et al. (2021); K_c 1.6 MPa m^1/2: Westerly, Atkinson & Meredith (1987)",
    ),
    "marble": NamedMaterial(
        4.9e10, 0.23, 2710.0, 6.9e6, _fracture_energy(8.5e5, 4.9e10, 0.23),
        "Carrara: f_t (Brazilian) and K_c 0.85 MPa m^1/2: Atkinson & Meredith (1987); E: Wong & Einstein (2009)",
    ),
    "concrete": NamedMaterial(
        3.3e10, 0.20, 2400.0, 2.9e6, 140.0,
        "C30/37: EN 1992-1-1 (E, f_ctm); G_F = 73 f_cm^0.18 N/m: fib Model Code 2010",
    ),
    "ice": NamedMaterial(
        9.3e9, 0.33, 917.0, 1.5e6, _fracture_energy(1.0e5, 9.3e9, 0.33),
        "freshwater, -10 C: Petrovic, J. Mater. Sci. 38 (2003): f_t 0.7 to 3.1 MPa, K_c 0.05 to 0.15 MPa m^1/2",
    ),
    "steel A516 Gr.70 at -40 C": NamedMaterial(
        2.2e11, 0.28, 7700.0, 6.55e8, _fracture_energy(4.0e7, 2.2e11, 0.28),
        "E, nu, rho, f_t: M22 after Tronskar et al. (2002); K_c 40 MPa m^1/2: ferritic steel on its lower shelf, "
        "ASTM E1921 (20 to 60)",
    ),
    "steel NVE 36 at 23 C": NamedMaterial(
        1.9e11, 0.28, 7700.0, 5.4e8, _fracture_energy(2.0e8, 1.9e11, 0.28),
        "E, nu, rho, f_t, yield: M22 after Tronskar et al. (2002) (it is sold with a yield stress of 3.55e8); "
        "K_Jc 200 MPa m^1/2: ship plate on its upper shelf",
        yield_stress=8.3e7,
    ),
    "steel S355": NamedMaterial(
        2.1e11, 0.30, 7850.0, 5.1e8, _fracture_energy(1.7e8, 2.1e11, 0.30),
        "f_t, yield: EN 10025-2; K_Jc 170 MPa m^1/2: mild steel, Ashby & Jones (100 kJ/m^2 and more)",
        yield_stress=3.55e8,
    ),
    "maraging steel": NamedMaterial(
        1.9e11, 0.30, 8000.0, 1.9e9, 2.213e4,
        "18Ni1900: Kalthoff, Int. J. Fract. 101 (2000), G_c of K_c 68 MPa m^1/2",
        yield_stress=1.72e9,
    ),
    "aluminium 7075-T6": NamedMaterial(
        7.17e10, 0.33, 2810.0, 5.72e8, _fracture_energy(2.9e7, 7.17e10, 0.33),
        "ASM; K_c 29 MPa m^1/2 (L-T)",
        yield_stress=5.03e8,
    ),
    "grey cast iron": NamedMaterial(
        1.1e11, 0.26, 7150.0, 2.0e8, _fracture_energy(1.5e7, 1.1e11, 0.26),
        "EN-GJL-200: EN 1561 (f_t); K_c 15 MPa m^1/2: Ashby & Jones (6 to 20)",
    ),
    "PMMA": NamedMaterial(
        3.0e9, 0.36, 1190.0, 7.0e7, _fracture_energy(1.05e6, 3.0e9, 0.36),
        "ISO 7823-1 sheet (E, f_t); K_c 1.05 MPa m^1/2: Ashby & Jones (300 to 400 J/m^2)",
    ),
    "epoxy": NamedMaterial(
        3.0e9, 0.38, 1200.0, 6.5e7, 200.0,
        "unfilled: Ashby & Jones (G_c 100 to 300 J/m^2)",
    ),
    "natural rubber": NamedMaterial(
        1.5e6, 0.45, 930.0, 2.0e7, 1.0e4,
        "unfilled, f_t of the section at rest: Treloar; G_c: tearing, Rivlin & Thomas (1953), 3 to 30 kJ/m^2",
    ),
    "bone": NamedMaterial(
        1.7e10, 0.30, 1900.0, 1.33e8, _fracture_energy(5.0e6, 1.7e10, 0.30),
        "cortical, human, along the shaft: Reilly & Burstein (1975); K_c 5 MPa m^1/2 across the osteons: "
        "Koester, Ager & Ritchie (2008), where cracks are short",
    ),
    "wood along its grain": NamedMaterial(
        1.1e10, 0.40, 420.0, 8.0e7, 1.0e4,
        "softwood pulled along its grain: E, rho: EN 338, C24; f_t clear, G_c of cracks across the grain "
        "(8 to 20 kJ/m^2): Ashby & Jones",
    ),
    "wood across its grain": NamedMaterial(
        3.7e8, 0.40, 420.0, 2.5e6, 290.0,
        "softwood split along its grain: E, rho: EN 338, C24; G_f = 1.07 rho - 162 J/m^2: Larsen & Gustafsson (1990)",
    ),
    "bread": NamedMaterial(1.0e7, 0.35, 1000.0, 4.0e6, None, "M22: figures of a picture, not measured", 1.0e6),
    "gelatine": NamedMaterial(
        1.8e4, 0.45, 1020.0, 1.0e4, 1.1,
        "10 % by weight: E: Bonavia (2025), 4 to 277 kPa by water; G_c, slow: Forte et al. (2015); f_t an estimate, "
        "at half of E",
    ),
}  # fmt: skip

_ELASTIC_KEYS = ("young", "poisson", "density")


def find_material(name: str, key: str) -> NamedMaterial:
    """Returns a material by its name; `key` is the path of the name in the study.

    Raises:
        ValueError: if there is no such material, with the nearest name.
    """
    if name not in MATERIALS:
        near = difflib.get_close_matches(name, MATERIALS, n=1, cutoff=0.5)
        hint = f"did you mean {near[0]}?" if near else "`fracsim list materials` shows them"
        raise ValueError(f'{key} = "{name}" is not in the table of materials; {hint}')
    return MATERIALS[name]


def fill_from_library(data: dict[str, Any]) -> dict[str, Any]:
    """Returns the tables of a study with the values of named materials for keys that are left out.

    `fracture.energy = true` takes the fracture energy of the material.

    Raises:
        ValueError: if a name is unknown, or a requested fracture energy is not known.
    """
    material, fracture = data.get("material"), data.get("fracture")
    if not isinstance(material, dict):
        return data
    data = data | {"material": _fill_material(data, material)}
    like = material.get("like")
    named = find_material(like, "material.like") if isinstance(like, str) else None
    if isinstance(fracture, dict):
        data["fracture"] = _fill_fracture(fracture, named)
    plasticity = data.get("plasticity")
    if named is not None and isinstance(plasticity, dict) and named.yield_stress is not None:
        data["plasticity"] = {"yield_stress": named.yield_stress} | plasticity
    return data


def _fill_material(data: dict[str, Any], material: dict[str, Any]) -> dict[str, Any]:
    """[material] and its regions with the values of named materials."""
    result = dict(material)
    regions = result.get("regions") if isinstance(result.get("regions"), dict) else None
    # regions are tables inside [material], or in `regions` once a study is validated
    inner = result if regions is None else dict(regions)
    for name, region in list(inner.items()):
        if isinstance(region, dict) and isinstance(region.get("like"), str) and name != "regions":
            named = find_material(region["like"], f"material.{name}.like")
            values = {key: getattr(named, key) for key in _ELASTIC_KEYS}
            if "fracture" in data:
                values["strength"] = named.strength
            if "plasticity" in data and named.yield_stress is not None:
                values["yield_stress"] = named.yield_stress
            inner[name] = values | region
    if regions is not None:
        result["regions"] = inner
    if isinstance(result.get("like"), str):
        named = find_material(result["like"], "material.like")
        result = {key: getattr(named, key) for key in _ELASTIC_KEYS} | result
    return result


def _fill_fracture(table: dict[str, Any], named: NamedMaterial | None) -> dict[str, Any]:
    """[fracture] with strength and fracture energy of a named material."""
    result = dict(table)
    if named is not None:
        result = {"strength": named.strength} | result
    if result.get("energy") is True:
        if named is None or named.energy is None:
            why = "material.like says which" if named is None else "nothing is known of that of material.like"
            raise ValueError(f"fracture.energy = true takes the fracture energy of a material by name, and {why}: "
                             "give G_c in J/m^2")  # fmt: skip
        result["energy"] = named.energy
    elif result.get("energy") is False:
        del result["energy"]
    return result
