"""Schema of [mesh], [material] and [damping]."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, field_validator, model_validator

from .plugins import or_plugin
from .values import NonNegative, Poisson, Positive, Strength, StudyTable, key

EnergyName = Literal["linear", "corotated", "stvk", "neo-hookean"]
# builder of a study whose mesh is handed over in Python; study.toml of its run has the name
GIVEN_MESH = "given"
SOURCES = ("builder", "file", "surface", "outline", "shell")


class MeshSettings(BaseModel):
    """The mesh, from exactly one source.

    Sources are a builder, a mesh file, a closed surface or a plane outline that is filled with cells, and a shell.
    Parameters of a builder are keys of this table, too.
    """

    model_config = ConfigDict(extra="allow", frozen=True)

    builder: str | None = key(
        "Name of a builder (`fracsim list`). Its parameters are further keys of this table.",
        default=None,
        example="box",
    )
    file: Path | None = key("Path of a mesh file, relative to the study file.", default=None, example="part.msh")
    surface: Path | None = key(
        "Path of a closed surface of triangles that gmsh fills with tetrahedra.", default=None, example="part.stl"
    )
    outline: Path | None = key(
        "Path of a CSV file with polygons that are filled with triangles between random points. A line `x, y` is a "
        "corner, `x, y, group` names the side that begins there, an empty line ends a polygon. Inner polygons are "
        "holes.",
        default=None, example="part.csv",
    )  # fmt: skip
    shell: Path | None = key(
        'Path of a surface of triangles with a `thickness`, for `time.scheme = "rigid"`.',
        default=None,
        example="hull.stl",
    )
    order: Literal[1, 2] = key(
        "Polynomial order of the displacement in a cell: 1 linear, 2 quadratic "
        "([limits](accuracy.md#quadratic-displacement)).",
        default=1, example=2,
    )  # fmt: skip

    @model_validator(mode="after")
    def _one_source(self) -> MeshSettings:
        present = [name for name in SOURCES if getattr(self, name) is not None]
        if len(present) != 1:
            listed = " and ".join(present) or "none of them"
            raise ValueError(f"give exactly one of {', '.join(SOURCES)}; found {listed}")
        return self

    @property
    def source(self) -> str | Path:
        """Name of the builder or path of the file."""
        return next(value for name in SOURCES if (value := getattr(self, name)) is not None)

    @property
    def parameters(self) -> dict[str, Any]:
        """Keys beside the source: parameters of the builder, or those of `SOURCE_KEYS`."""
        return dict(self.model_extra or {})


@dataclass(frozen=True)
class SourceKey:
    """A key of [mesh] that belongs to one kind of source.

    Attributes:
        meaning: what the key is, for the error message.
        description: for the documentation.
        unit: of its values.
        default: as in a study file; None if the key may be left out without a default.
        required: whether the source needs it.
        boolean: whether its values are true and false.
        integer: whether its values are whole numbers.
        example: a valid value.
    """

    meaning: str
    description: str
    unit: str = ""
    default: float | bool | None = None
    required: bool = False
    boolean: bool = False
    integer: bool = False
    example: float | bool | None = None


_SCALE = SourceKey(
    "metres for each unit of length of the file, a number > 0", "Metres per unit of length of the file.", "m", 1.0,
    example=1e-3,
)  # fmt: skip
# source -> key -> what it is; [mesh] accepts these keys beside the source
SOURCE_KEYS: dict[str, dict[str, SourceKey]] = {
    "file": {
        "scale": _SCALE,
        "join": SourceKey(
            "whether nodes of different bodies at the same place become one, true or false",
            "Merge coincident nodes of different bodies, within 1e-6 of the size of the mesh.",
            default=False, boolean=True, example=True,
        ),
    },
    "surface": {
        "h": SourceKey(
            "a surface is filled with cells of size h > 0 (m)", "Cell size.", "m", required=True, example=0.01
        ),
        "scale": _SCALE,
        "time_limit": SourceKey(
            "seconds that gmsh may take, a number > 0",
            "Time limit of gmsh, and again of the repair.", "s", example=600.0
        ),
        "repair": SourceKey(
            "whether holes are filled and parts that cross are made one, true or false",
            "Close holes, remove self-intersections and merge intersecting parts, with a note on each change "
            "([repair](meshes.md#repair-of-surfaces)).",
            default=False, boolean=True, example=True,
        ),
    },
    "outline": {
        "h": SourceKey(
            "an outline is filled with cells of size h > 0 (m)", "Cell size.", "m", required=True, example=0.001
        ),
        "scale": _SCALE,
        "seed": SourceKey("of its random points, a whole number > 0", "Seed of the random points.", default=1,
                          integer=True, example=2),
    },
    "shell": {
        "thickness": SourceKey("a shell has a thickness > 0 (m)", "Thickness of the shell.", "m", required=True,
                               example=2e-3),
        "scale": _SCALE,
    },
}  # fmt: skip


class ElasticSettings(StudyTable):
    """Elastic constants and density."""

    young: Positive = key("Young's modulus.", "Pa", example=1e5)
    poisson: Poisson = key("Poisson's ratio.", example=0.35)
    density: Positive = key("Mass density of the body at rest.", "kg/m^3", example=300.0)


class RegionSettings(StudyTable):
    """[material.NAME]: values that differ in the region NAME of the mesh."""

    like: str | None = key("Named material whose values apply in the region.", default=None, example="granite")
    young: Positive | None = key("Young's modulus.", "Pa", default=None, example=4e5)
    poisson: Poisson | None = key("Poisson's ratio.", default=None, example=0.3)
    density: Positive | None = key("Mass density.", "kg/m^3", default=None, example=500.0)
    strength: Strength | None = key("Replaces `fracture.strength`.", "Pa", default=None, example=5e4)
    fracture_energy: Positive | None = key("Replaces `fracture.energy`.", "J/m^2", default=None, example=40.0)
    yield_stress: Strength | None = key("Replaces `plasticity.yield_stress`.", "Pa", default=None, example=5e4)


class MaterialSettings(ElasticSettings):
    """The elastic material. Tables inside are regions of the mesh: `[material.crust]`."""

    like: str | None = key(
        "Named material (`fracsim list materials`). It supplies young, poisson, density and `fracture.strength` where"
        " the study does not give them.",
        default=None, example="soda-lime glass",
    )  # fmt: skip
    energy: Annotated[EnergyName, or_plugin("energies")] = key(
        "Elastic energy: Hooke's law for small strains and rotations, Hooke's law with the rotation of each cell, "
        "Saint Venant-Kirchhoff, or stable neo-Hookean; or the name of a [plug-in](python.md#plug-ins). Rigid bodies "
        "have `linear` only, which is their default.",
        default="neo-hookean", example="corotated",
    )  # fmt: skip
    plane: Literal["strain", "stress"] = key(
        "Plane strain or plane stress of a 2D mesh. Plane stress has the energies linear and stvk.",
        default="strain", example="stress",
    )  # fmt: skip
    thickness: Positive | None = key(
        "Thickness of a 2D body.",
        "m",
        default=None,
        example=0.01,
        otherwise="forces, energies and masses are per metre",
    )
    regions: dict[str, RegionSettings] = key("Regions by name.", factory=dict)

    @model_validator(mode="before")
    @classmethod
    def _tables_are_regions(cls, data: Any) -> Any:
        if not isinstance(data, dict) or "regions" in data:
            return data
        # a table inside [material] can only be a region: no key of it holds a table
        regions = {name: value for name, value in data.items() if isinstance(value, dict)}
        values = {name: value for name, value in data.items() if name not in regions}
        return values | ({"regions": regions} if regions else {})

    @field_validator("regions")
    @classmethod
    def _names_are_short(cls, regions: dict[str, RegionSettings]) -> dict[str, RegionSettings]:
        # mesh generators choose these names
        for name in regions:
            if len(name) > 100 or not name.isprintable():
                raise ValueError(
                    f"the name of a region has 100 letters or fewer, and no control characters; this one "
                    f'has not: "{name}"'
                )
        return regions

    def elastic_constants(self, region: RegionSettings) -> tuple[float, float, float]:
        """Returns Young's modulus (Pa), Poisson's ratio and density (kg/m^3) in a region."""
        poisson = self.poisson if region.poisson is None else region.poisson
        return region.young or self.young, poisson, region.density or self.density

    @model_validator(mode="after")
    def _plane_stress_has_an_energy(self) -> MaterialSettings:
        if self.plane == "stress" and self.energy not in ("linear", "stvk"):
            raise ValueError(f'plane = "stress" is offered by the energies linear and stvk, not by {self.energy}')
        return self


class DampingSettings(StudyTable):
    """Rayleigh damping a M + b K."""

    mass: NonNegative = key("Coefficient a of the mass matrix.", "1/s", default=0.0, example=5.0)
    stiffness: NonNegative = key("Coefficient b of the stiffness matrix.", "s", default=0.0, example=1e-4)
