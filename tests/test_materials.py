"""[material] like: values by name, each of which may be overridden; what does not fit together is told."""

from __future__ import annotations

import tomllib
from typing import Any

import pytest

from cases import STRIP, changed, fracsim, study
from fracsim.errors import InputError
from fracsim.study.check import check_study
from fracsim.study.material_library import MATERIALS
from fracsim.study.reader import study_text, validate

pytestmark = pytest.mark.any_release

GLASS = MATERIALS["soda-lime glass"]


def like(name: str, fracture: dict[str, Any] | None = None, **more: Any) -> dict[str, Any]:
    data = changed(STRIP, fracture=None, probe=[], output={"fields": []})
    data["material"] = {"energy": "linear", "like": name} | more
    return data | ({"fracture": fracture} if fracture is not None else {})


def test_what_is_left_out_is_that_of_the_name_and_what_is_given_stays() -> None:
    glass = study(like("soda-lime glass", {}, density=2600.0))
    assert (glass.material.young, glass.material.poisson, glass.material.density) == (7e10, 0.22, 2600.0)
    assert glass.fracture is not None and (glass.fracture.strength, glass.fracture.energy) == (4.5e7, None)
    torn = study(like("soda-lime glass", {"energy": True, "strength": 3e7}))
    assert torn.fracture is not None and (torn.fracture.strength, torn.fracture.energy) == (3e7, GLASS.energy)
    ductile = study(like("steel NVE 36 at 23 C", {}) | {"plasticity": {}} | {"material": {
        "energy": "corotated", "like": "steel NVE 36 at 23 C"}})  # fmt: skip
    assert ductile.plasticity is not None and ductile.plasticity.yield_stress == 8.3e7
    assert study(like("granite")).fracture is None  # a name does not break a body by itself


def test_the_study_as_run_reads_the_same() -> None:
    once = study(like("PMMA", {"energy": True}))
    again = validate(tomllib.loads(study_text(once)), "again")
    assert again.material == once.material and again.fracture == once.fracture


def test_regions_have_names_too() -> None:
    two = study(like("PMMA", {}, crust={"like": "alumina", "poisson": 0.2}))
    crust = two.material.regions["crust"]
    assert (crust.young, crust.poisson, crust.density, crust.strength) == (4.16e11, 0.2, 3984.0, 2.67e8)
    assert study(like("PMMA", crust={"like": "alumina"})).material.regions["crust"].strength is None


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (like("soda lime glas"), 'like = "soda lime glas" is not in the table of materials; did you mean soda-lime'),
        (like("unobtainium, 3"), "`fracsim list materials` shows them"),
        (like("bread", {"energy": True}), "nothing is known of that of material.like: give G_c in J/m^2"),
        (changed(STRIP, fracture={"energy": True}), "material.like says which: give G_c in J/m^2"),
        (changed(STRIP, material={"crust": {"like": "glas"}}), 'material.crust.like = "glas" is not in the table'),
    ],
)  # fmt: skip
def test_names_that_are_not_known_are_refused(data: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError) as refusal:
        validate(data, "test.toml")
    assert message in str(refusal.value)


@pytest.mark.parametrize("name", MATERIALS)
def test_the_table_holds_together(name: str) -> None:
    """Units: a slip by a thousand shows in l_ch, which of all solids lies between an atom's size and metres, in the
    strain at failure, and in the speed of sound (steel and ceramics 5 to 11 km/s, gels 2 m/s)."""
    each = MATERIALS[name]
    assert each.source and -1 < each.poisson < 0.46 and 300 < each.density < 9000
    assert 1 < (each.young / each.density) ** 0.5 < 1.2e4
    assert each.strength < each.young or name == "natural rubber"
    if each.energy is not None and each.length is not None and name != "natural rubber":
        assert 1e-4 < each.length < 1.0
        assert 0.5 < each.energy < 1e6
    assert each.yield_stress is None or each.yield_stress < each.strength


def test_it_is_listed() -> None:
    lines = fracsim("list", "materials").stdout.splitlines()
    assert len(lines) == 2 + len(MATERIALS) >= 22
    glass = next(line for line in lines if "soda-lime" in line).split()
    assert glass[2:8] == ["7e+10", "0.22", "2500", "4.5e+07", "7.6", "0.000276"]
    assert fracsim("list", "nothing").returncode == 2


def notes(data: dict[str, Any]) -> str:
    return "\n".join(check_study(validate(data, "test.toml")))


def test_check_says_what_does_not_fit_together() -> None:
    """PMMA: l_ch = 0.23 mm. A strip of 1 m x 0.25 m with cells of 125 mm; one of 10 mm with cells of 0.1 mm."""
    coarse = notes(like("PMMA", {"energy": True}))
    assert "l_ch = E' G_c / f_t^2 = 0.000225 m" in coarse and "note: that is less than h" in coarse
    assert "tips need 6 h on every side, the body is 2 h across: h below 0.021 m" in coarse
    small = like("concrete", {"energy": True}) | {"mesh": {"builder": "box", "size": [0.04, 0.01], "h": 2e-4}}
    assert "note: that is over a fifth of the body" in notes(small)
    fits = like("PMMA", {"energy": True}) | {"mesh": {"builder": "box", "size": [0.04, 0.01], "h": 1e-4}}
    assert notes(fits).count("note:") == notes(fits).count('note: with energy = "linear" fragments') == 1
    # by edges: f_t^2 h / 2 E' of granite with cells of 125 mm is 113 J/m^2 in plane strain, its own 51
    assert "a crack takes about f_t^2 h / 2 E' = 1.1e+02 J/m^2" in notes(like("granite", {}))
    assert "note: soda-lime glass takes 7.6 J/m^2: give fracture.energy = true (2D), or h = 0.00055 m" in notes(
        like("soda-lime glass", {})
    )
    assert "strength is 0.5 of young" in notes(changed(STRIP, fracture={"strength": 5e5}))
