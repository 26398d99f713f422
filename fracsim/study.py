"""The study file: its tables, their defaults, units and limits (SI throughout). No DOLFINx here."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from pydantic import BaseModel, BeforeValidator, ConfigDict, Discriminator, Field, Tag, field_validator, model_validator

# Strict: "3" is not taken for 3, nor true for 1. Tags of unions are in <>: they name no key of the file.
Finite = Annotated[float, Field(allow_inf_nan=False, strict=True)]
Positive = Annotated[Finite, Field(gt=0)]
NonNegative = Annotated[Finite, Field(ge=0)]
Strength = Annotated[float, Field(gt=0, strict=True)]  # Pa; inf never breaks
Poisson = Annotated[Finite, Field(gt=-1, lt=0.5)]
Flag = Annotated[bool, Field(strict=True)]
Vector = Annotated[list[Finite], Field(min_length=2, max_length=3)]


def _kind(value: Any) -> str:
    """Tag of a component of a motion."""
    return "<word>" if isinstance(value, str) else "<number>"


Component = Annotated[
    Annotated[Finite, Tag("<number>")] | Annotated[Literal["free"], Tag("<word>")], Discriminator(_kind)
]
Motion = Annotated[list[Component], Field(min_length=2, max_length=3)]


class Table(BaseModel):
    """A table of the study file: unknown keys are refused."""

    model_config = ConfigDict(extra="forbid", frozen=True, ser_json_inf_nan="constants")


class TimeTable[Value](Table):
    """Values at times in s, linear in between and constant outside."""

    time: Annotated[list[Finite], Field(min_length=1)]
    value: list[Value]

    @model_validator(mode="after")
    def _increasing(self) -> TimeTable[Value]:
        if len(self.time) != len(self.value):
            raise ValueError(f"{len(self.time)} times but {len(self.value)} values; give one value for each time")
        if any(b <= a for a, b in zip(self.time, self.time[1:], strict=False)):
            raise ValueError("times must increase")
        return self


def _shape(value: Any) -> str:
    """Tag of a value that may be constant or tabulated."""
    return "<table>" if isinstance(value, dict | TimeTable) else "<constant>"


if TYPE_CHECKING:
    type InTime[Value] = Value | TimeTable[Value]
else:
    type InTime[Value] = Annotated[
        Annotated[Value, Tag("<constant>")] | Annotated[TimeTable[Value], Tag("<table>")], Discriminator(_shape)
    ]


class Mesh(BaseModel):
    """`builder` with its own parameters, or `file` with named groups, or a closed `surface` filled at size `h`."""

    model_config = ConfigDict(extra="allow", frozen=True)

    builder: str | None = None
    file: Path | None = None
    surface: Path | None = None

    @model_validator(mode="after")
    def _one_source(self) -> Mesh:
        given = [key for key in ("builder", "file", "surface") if getattr(self, key) is not None]
        if len(given) != 1:
            found = " and ".join(given) or "none of them"
            raise ValueError(f"give exactly one of builder, file, surface; found {found}")
        return self

    @property
    def parameters(self) -> dict[str, Any]:
        """Everything besides the source: the builder's parameters, or h of a surface."""
        return dict(self.model_extra or {})


class Elastic(Table):
    """What may differ between the named regions of a mesh."""

    young: Positive  # Pa
    poisson: Poisson
    density: Positive  # kg/m^3


class Region(Table):
    """[material.NAME]: what differs from [material] in the region NAME of the mesh."""

    young: Positive | None = None
    poisson: Poisson | None = None
    density: Positive | None = None
    strength: Strength | None = None
    yield_stress: Strength | None = None


class Material(Elastic):
    """[material]; tables inside it are regions."""

    energy: Literal["linear", "corotated", "stvk", "neo-hookean"] = "neo-hookean"
    plane: Literal["strain", "stress"] = "strain"  # of a 2D mesh
    regions: dict[str, Region] = {}

    @model_validator(mode="before")
    @classmethod
    def _tables_are_regions(cls, data: Any) -> Any:
        if not isinstance(data, dict) or "regions" in data:
            return data
        regions = {key: value for key, value in data.items() if isinstance(value, dict)}
        rest = {key: value for key, value in data.items() if key not in regions}
        return rest | ({"regions": regions} if regions else {})

    @model_validator(mode="after")
    def _plane_stress_needs_a_form(self) -> Material:
        if self.plane == "stress" and self.energy not in ("linear", "stvk"):
            raise ValueError(f'plane = "stress" is offered by the energies linear and stvk, not by {self.energy}')
        return self


class Damping(Table):
    """Rayleigh damping a M + b K."""

    mass: NonNegative = 0.0  # a, 1/s
    stiffness: NonNegative = 0.0  # b, s


class Heterogeneity(Table):
    """Scatter of the strength from edge to edge, Weibull-distributed with mean 1; the same at any number of ranks."""

    modulus: Positive  # Weibull's m: 5 scatters like stone, 50 hardly at all
    seed: Annotated[int, Field(ge=0)] = 0


class Fibre(Table):
    """Strength that depends on direction: `ratio` times as high along the fibre as across it."""

    direction: Vector
    ratio: Positive = 1.0

    @field_validator("direction")
    @classmethod
    def _has_a_direction(cls, direction: list[float]) -> list[float]:
        if not any(direction):
            raise ValueError("a direction must not be zero")
        return direction


class Fracture(Table):
    """[fracture]: edges break where the averaged normal stress along them reaches `strength`."""

    strength: Strength
    approach: Literal["chi", "edge"] = "chi"  # degraded energy; edge-projected strain (linear and corotated)
    radius: NonNegative = 0.0  # m, of the non-local average; 0: local
    kernel: Literal["linear", "constant", "gaussian"] = "linear"
    tie_break: Annotated[Finite, Field(ge=0, lt=0.1)] = 1e-6  # relative perturbation of the strength of each edge
    unilateral: Flag = False  # a broken edge shorter than at rest carries pressure: cracks close
    passes: Annotated[int, Field(ge=1, strict=True)] = 1  # solve and break again within a step until nothing new breaks
    cap: Annotated[Finite, Field(gt=0, le=1)] | None = None  # share of all edges that may break in one pass
    heterogeneity: Heterogeneity | None = None
    fibre: Fibre | None = None


class Plasticity(Table):
    """[plasticity]: cells flow where their stress exceeds the yield stress; F = F_e F_p with det F_p = 1."""

    yield_stress: Strength  # Pa, of the Cauchy stress
    measure: Literal["von-mises", "frobenius"] = "von-mises"  # what is compared with it; the latter counts pressure too
    flow_rate: Annotated[float, Field(gt=0, strict=True)] = float("inf")  # 1/s; inf: independent of the rate
    hardening: Finite = 0.0  # K in Pa: what yield_stress gains with accumulated plastic strain; < 0 softens
    update: Literal["implicit", "staggered"] = (
        "implicit"  # solve a step with its flow; let flow follow it (small steps)
    )


class Grains(Table):
    """Grain boundaries: regions of seeded points p_i by least k_i |x - p_i|, the same at any number of ranks."""

    count: Annotated[int, Field(ge=2, strict=True)]
    seed: Annotated[int, Field(ge=0, strict=True)] = 0
    spread: Annotated[Finite, Field(ge=0, lt=1)] = 0.0  # k_i from 1 - spread to 1 + spread; 0: all grains alike
    mode: Literal["replace", "bias"] = "replace"  # a surface frees a grain; or runs along the boundaries nearest to it


class Brittle(Table):
    """[brittle]: instead of single edges, surfaces from the cells of highest averaged principal stress break."""

    surfaces: Annotated[int, Field(ge=1, strict=True)]  # most surfaces of the run: more of them, more debris
    spacing: Positive | None = None  # m between places where surfaces start; default: about two mesh edges
    shape: Literal["planar", "curved"] = "planar"  # curved: turns with the principal direction
    seed: Annotated[int, Field(ge=0, strict=True)] = 0  # of the direction where several principal stresses are equal
    per_pass: Annotated[int, Field(ge=1, strict=True)] | None = None  # most that start in one pass; default: no limit
    grains: Grains | None = None

    @model_validator(mode="after")
    def _grains_have_their_shape(self) -> Brittle:
        if self.grains is not None and self.grains.mode == "replace" and self.shape == "curved":
            raise ValueError(
                'shape = "curved" does nothing where grains.mode = "replace": surfaces are grain boundaries; '
                'remove shape, or set grains.mode = "bias"'
            )
        return self


class Box(Table):
    """Nodes inside a box (m)."""

    box: Annotated[list[Vector], Field(min_length=2, max_length=2)]

    @model_validator(mode="after")
    def _corners(self) -> Box:
        lower, upper = self.box
        if any(a > b for a, b in zip(lower, upper, strict=False)):
            raise ValueError(f"box = {self.box}: give the lower corner first, then the upper one")
        return self


class Plane(Table):
    """Nodes on a plane, within `within` (m; default 1e-6 of the body's size)."""

    point: Vector
    normal: Vector
    within: Positive | None = None


def _selector(value: Any) -> str:
    """Tag of a place: a group's name, a box or a plane."""
    if isinstance(value, Box) or (isinstance(value, dict) and "box" in value):
        return "<box>"
    return "<plane>" if isinstance(value, dict | Plane) else "<group>"


Where = Annotated[
    Annotated[str, Tag("<group>")] | Annotated[Box, Tag("<box>")] | Annotated[Plane, Tag("<plane>")],
    Discriminator(_selector),
]


class Boundary(Table):
    """[[boundary]]: one condition on a group of facets, a box or a plane. Give exactly one of the six."""

    on: Where
    fix: Annotated[str, Field(pattern="^[xyz]+$")] | None = None  # components held at zero
    displacement: InTime[Motion] | None = None  # m; "free" leaves a component alone
    velocity: InTime[Motion] | None = None  # m/s
    traction: InTime[Vector] | None = None  # Pa of the reference area
    pressure: InTime[Finite] | None = None  # Pa, pushes where > 0, follows the surface

    @model_validator(mode="after")
    def _one_condition(self) -> Boundary:
        if len(given := self._given()) != 1:
            kinds = ", ".join(CONDITIONS)
            raise ValueError(f"give exactly one of {kinds}; found {' and '.join(given) or 'none'}")
        return self

    def _given(self) -> list[str]:
        return [key for key in CONDITIONS if getattr(self, key) is not None]

    @property
    def kind(self) -> str:
        """Which of the conditions it is."""
        return self._given()[0]


CONDITIONS = ("fix", "displacement", "velocity", "traction", "pressure")
MOTIONS = ("fix", "displacement", "velocity")


class Load(Table):
    """[load]: forces on the whole body."""

    gravity: Vector | None = None  # m/s^2
    body_force: InTime[Vector] | None = None  # N/m^3


class Initial(Table):
    """[initial]: velocity at the start, v = velocity + spin x (X - centre of mass)."""

    velocity: Vector | None = None  # m/s
    spin: Annotated[list[Finite], Field(min_length=1, max_length=3)] | None = None  # rad/s; one number in 2D


class Time(Table):
    """[time]: scheme and steps."""

    scheme: Literal["backward-euler", "newmark", "generalized-alpha", "explicit", "quasi-static"] = "backward-euler"
    step: Positive  # s
    end: Positive  # s
    adapt: Flag = True  # halve a step that fails, grow back after easy ones
    smallest: Positive | None = None  # s; default step / 1024
    mass: Literal["lumped", "consistent"] = "lumped"
    beta: Annotated[Finite, Field(gt=0, le=0.5)] = 0.25  # Newmark
    gamma: Annotated[Finite, Field(ge=0.5, le=1)] = 0.5  # Newmark
    rho: Annotated[Finite, Field(ge=0, le=1)] = 0.8  # generalized-alpha: what is left of the fastest modes after a step

    @model_validator(mode="after")
    def _order(self) -> Time:
        if self.step > self.end:
            raise ValueError(f"step = {self.step:g} s is longer than the run: end = {self.end:g} s")
        if self.smallest is not None and self.smallest > self.step:
            raise ValueError(f"smallest = {self.smallest:g} s is longer than step = {self.step:g} s")
        if self.scheme == "newmark" and 4 * self.beta < self.gamma + 0.5 - 1e-12:
            raise ValueError("newmark is stable for every step where beta >= (gamma + 1/2) / 4; raise beta")
        if self.scheme == "explicit" and self.mass == "consistent":
            raise ValueError('mass = "consistent" is for implicit schemes; explicit steps need mass = "lumped"')
        return self


class Probe(Table):
    """[[probe]]: what history.csv records at a point (nearest node) or over a group."""

    name: Annotated[str, Field(pattern=r"^[A-Za-z][A-Za-z0-9-]*$")]
    point: Vector | None = None  # m, reference configuration
    on: Where | None = None
    record: Literal["displacement", "reaction"] | None = None  # default: reaction over a group, displacement at a point

    @model_validator(mode="after")
    def _place(self) -> Probe:
        if (self.point is None) == (self.on is None):
            raise ValueError("give either point or on")
        if self.point is not None and self.record == "reaction":
            raise ValueError("a reaction is summed over a group or selection: give on instead of point")
        return self

    @property
    def quantity(self) -> str:
        """What is recorded."""
        return self.record or ("displacement" if self.point is not None else "reaction")


FIELDS = (
    "velocity",
    "damage",
    "chi",
    "piece",
    "stress",
    "von_mises",
    "energy_density",
    "strain",
    "region",
    "plastic_strain",
)
FRACTURE_FIELDS = ("damage", "chi", "piece")


class Output(Table):
    """[output]: what is written, and how often."""

    every: Annotated[int, Field(ge=1, strict=True)] | None = None  # steps
    interval: Positive | None = None  # s
    fields: list[Literal[FIELDS]] | None = None  # type: ignore[valid-type]
    surface: Flag | None = None  # the split surface and pieces.csv; default: where the study has [fracture]
    cut: Literal["middle", "forces"] = "middle"  # where broken edges are cut: in proportion to the nodal forces
    picture: Flag = True  # a PNG of the last frame
    checkpoint: Positive | None = None  # s of wall time between checkpoints; default: only where a run ends early

    @model_validator(mode="after")
    def _one_clock(self) -> Output:
        if self.every is not None and self.interval is not None:
            raise ValueError("give every (in steps) or interval (in s), not both")
        return self


def _is_setting(value: Any) -> Any:
    if not isinstance(value, bool | int | float | str):
        raise ValueError(f"{value!r} is not a PETSc option, which is a number, a text, true or false")
    return value


Setting = Annotated[bool | int | float | str, BeforeValidator(_is_setting)]


def _moduli(material: Material) -> list[tuple[float, float]]:
    """(Young, Poisson) of the material and of every region."""
    regions = [(each.young or material.young, each.poisson) for each in material.regions.values()]
    regions = [(young, material.poisson if poisson is None else poisson) for young, poisson in regions]
    return [(material.young, material.poisson), *regions]  # type: ignore[list-item]


class Study(Table):
    """A whole study. A table that is absent costs nothing."""

    title: str
    mesh: Mesh
    material: Material
    time: Time
    fracture: Fracture | None = None
    plasticity: Plasticity | None = None
    brittle: Brittle | None = None
    damping: Damping | None = None
    boundary: list[Boundary] = []
    load: Load | None = None
    initial: Initial | None = None
    solver: dict[str, Setting] = {}  # PETSc options, given as they are
    probe: list[Probe] = []
    output: Output = Output()

    @field_validator("probe")
    @classmethod
    def _distinct(cls, probes: list[Probe]) -> list[Probe]:
        names = [probe.name for probe in probes]
        if twice := sorted({name for name in names if names.count(name) > 1}):
            raise ValueError(f"two probes have the name {twice[0]}")
        return probes

    @model_validator(mode="after")
    def _fields_exist(self) -> Study:
        wanted = [name for name in self.output.fields or [] if name in FRACTURE_FIELDS]
        if wanted and self.fracture is None:
            raise ValueError(f'output.fields has "{wanted[0]}", which needs a [fracture] table')
        return self

    @model_validator(mode="after")
    def _strength_needs_fracture(self) -> Study:
        special = [name for name, region in self.material.regions.items() if region.strength is not None]
        if special and self.fracture is None:
            raise ValueError(f"material.{special[0]}.strength needs a [fracture] table")
        return self

    @model_validator(mode="after")
    def _flow_needs_plasticity(self) -> Study:
        if self.plasticity is None:
            special = [name for name, region in self.material.regions.items() if region.yield_stress is not None]
            if special:
                raise ValueError(f"material.{special[0]}.yield_stress needs a [plasticity] table")
            if "plastic_strain" in (self.output.fields or []):
                raise ValueError('output.fields has "plastic_strain", which needs a [plasticity] table')
        return self

    @model_validator(mode="after")
    def _plasticity_fits(self) -> Study:
        table, material = self.plasticity, self.material
        if table is None:
            return self
        if material.energy == "linear":
            raise ValueError(
                "[plasticity] splits the deformation gradient, which the energy linear does not tell from small "
                'strain; choose energy = "corotated", the same law at small strain'
            )
        if material.plane == "stress":
            raise ValueError('[plasticity] is for 3D and plane strain; choose plane = "strain"')
        if self.fracture is not None and self.fracture.approach == "edge":
            raise ValueError(
                'fracture.approach = "edge" projects strain on the edges at rest, which plastic flow leaves behind; '
                'choose approach = "chi" with [plasticity]'
            )
        for young, poisson in _moduli(material):
            if table.hardening <= (limit := -1.5 * young / (1 + poisson)):
                raise ValueError(
                    f"plasticity.hardening = {table.hardening:g}: must be greater than -3 mu = {limit:.4g} Pa; a body "
                    "that softens faster than it unloads has no equilibrium"
                )
        return self

    @model_validator(mode="after")
    def _surfaces_need_strength(self) -> Study:
        if self.brittle is None:
            return self
        if self.fracture is None:
            raise ValueError("[brittle] needs a [fracture] table: its strength decides where surfaces start")
        if self.fracture.cap is not None:
            raise ValueError(
                "fracture.cap is a share of edges, [brittle] breaks surfaces: set brittle.per_pass instead"
            )
        if self.output.cut == "forces":
            raise ValueError(
                'output.cut = "forces" is for single edges; surfaces of [brittle] say where they cut: remove'
            )
        return self

    @model_validator(mode="after")
    def _projection_is_of_small_strains(self) -> Study:
        if self.fracture is None or self.fracture.approach != "edge":
            return self
        if self.material.energy not in ("linear", "corotated"):
            raise ValueError(
                f'fracture.approach = "edge" is for the energies linear and corotated, not {self.material.energy}: '
                'with a nonlinear strain split cells blow up; choose approach = "chi" or energy = "corotated"'
            )
        if "chi" in (self.output.fields or []):
            raise ValueError('output.fields has "chi", which fracture.approach = "edge" does not have; remove it')
        return self

    @model_validator(mode="after")
    def _explicit_steps_once(self) -> Study:
        if self.time.scheme == "explicit" and self.fracture is not None and self.fracture.passes > 1:
            raise ValueError("fracture.passes solves a step again, which explicit steps do not; set passes = 1")
        return self

    @model_validator(mode="after")
    def _rest_has_no_velocity(self) -> Study:
        if self.time.scheme == "quasi-static" and self.initial is not None:
            raise ValueError("[initial] sets a velocity, which a quasi-static study does not have; remove it")
        return self
