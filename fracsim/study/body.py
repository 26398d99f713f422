"""[mesh], [material] and [damping]: the body and what it is made of."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field, field_validator, model_validator

from .values import LONGEST_REGION, NonNegative, Poisson, Positive, Strength, StudyTable

SOURCES = ("builder", "file", "surface", "outline", "shell")


class MeshSettings(BaseModel):
    """`builder` with its own parameters, or `file` with named groups, or a closed `surface` or a plane `outline` filled
    at size `h`, or a `shell` of some thickness."""

    model_config = ConfigDict(extra="allow", frozen=True)

    builder: str | None = None
    file: Path | None = None
    surface: Path | None = None
    outline: Path | None = None
    shell: Path | None = None
    order: Literal[1, 2] = 1  # of the displacement in a cell: linear or quadratic

    @model_validator(mode="after")
    def _one_source(self) -> MeshSettings:
        given = [key for key in SOURCES if getattr(self, key) is not None]
        if len(given) != 1:
            found = " and ".join(given) or "none of them"
            raise ValueError(f"give exactly one of {', '.join(SOURCES)}; found {found}")
        return self

    @property
    def source(self) -> str | Path:
        """What it is made of."""
        return next(value for key in SOURCES if (value := getattr(self, key)) is not None)

    @property
    def parameters(self) -> dict[str, Any]:
        """Everything besides the source: the builder's parameters, or h of a surface, or the thickness of a shell."""
        return dict(self.model_extra or {})


class ElasticSettings(StudyTable):
    """What may differ between the named regions of a mesh."""

    young: Positive  # Pa
    poisson: Poisson
    density: Positive  # kg/m^3


class RegionSettings(StudyTable):
    """[material.NAME]: what differs from [material] in the region NAME of the mesh."""

    like: str | None = None  # name of a material that says what else differs: see materials
    young: Positive | None = None
    poisson: Poisson | None = None
    density: Positive | None = None
    strength: Strength | None = None
    fracture_energy: Positive | None = None  # J/m^2, in place of fracture.energy
    yield_stress: Strength | None = None


class MaterialSettings(ElasticSettings):
    """[material]; tables inside it are regions."""

    like: str | None = None  # name of a material whose values those left out are: see materials
    energy: Literal["linear", "corotated", "stvk", "neo-hookean"] = "neo-hookean"
    plane: Literal["strain", "stress"] = "strain"  # of a 2D mesh
    thickness: Positive | None = None  # m, of a 2D mesh out of its plane; None: forces and energies are those of 1 m
    regions: dict[str, RegionSettings] = Field(default_factory=dict)

    @model_validator(mode="before")
    @classmethod
    def _tables_are_regions(cls, data: Any) -> Any:
        if not isinstance(data, dict) or "regions" in data:
            return data
        regions = {key: value for key, value in data.items() if isinstance(value, dict)}
        rest = {key: value for key, value in data.items() if key not in regions}
        return rest | ({"regions": regions} if regions else {})

    @field_validator("regions")
    @classmethod
    def _names_are_short(cls, regions: dict[str, RegionSettings]) -> dict[str, RegionSettings]:
        for name in regions:
            if len(name) > LONGEST_REGION or not name.isprintable():
                raise ValueError(
                    f"the name of a region has {LONGEST_REGION} letters or fewer, and no control characters; this one "
                    f'has not: "{name}"'
                )
        return regions

    @model_validator(mode="after")
    def _plane_stress_needs_a_form(self) -> MaterialSettings:
        if self.plane == "stress" and self.energy not in ("linear", "stvk"):
            raise ValueError(f'plane = "stress" is offered by the energies linear and stvk, not by {self.energy}')
        return self


class DampingSettings(StudyTable):
    """Rayleigh damping a M + b K."""

    mass: NonNegative = 0.0  # a, 1/s
    stiffness: NonNegative = 0.0  # b, s
