"""Schema of a whole study."""

from __future__ import annotations

from typing import Annotated, Any, get_args

from pydantic import ValidationInfo, field_validator, model_validator

from ..forms.schemes import SCHEMES
from ..meshes import BUILDERS
from .body import GIVEN_MESH, DampingSettings, EnergyName, MaterialSettings, MeshSettings
from .boundary_conditions import BoundarySettings, InitialSettings, LoadSettings
from .contact import ContactSettings, ObstacleSettings
from .fracture import BrittleSettings, CrackSettings, FractureSettings, PlasticitySettings
from .material_library import fill_from_library
from .plugins import PhysicsPart, find_plugin, installed
from .rigid_bodies import BodySettings, with_rigid_defaults
from .scheme_check import check_scheme
from .solver_options import Options, OptionValue, expand_print_options
from .table_checks import check_tables
from .time_and_output import OutputSettings, ProbeSettings, TimeSettings, frame_interval, frame_notes
from .values import Deferred, StudyTable, key


class Study(StudyTable):
    """A study. A table that is absent costs nothing: no field, no form, no import."""

    title: str = key("Title, in reports, pictures and summary.json.", example="A bar pulled apart")
    mesh: MeshSettings = key("Mesh.")
    material: MaterialSettings = key("Elastic material.")
    time: TimeSettings = key("Time scheme and steps.")
    fracture: Deferred[FractureSettings] | None = key("Fracture.", default=None)
    plasticity: Deferred[PlasticitySettings] | None = key("Plastic flow.", default=None)
    brittle: Deferred[BrittleSettings] | None = key("Crack surfaces.", default=None)
    crack: list[Deferred[CrackSettings]] = key("Initial cracks.", factory=list)
    damping: Deferred[DampingSettings] | None = key("Damping.", default=None)
    boundary: list[BoundarySettings] = key("Boundary conditions.", factory=list)
    terms: list[Annotated[str, installed("terms")]] = key(
        "Terms of the balance of forces beside those of the tables: names of [plug-ins](python.md#plug-ins).",
        factory=list,
    )  # fmt: skip
    loads: list[Annotated[str, installed("loads")]] = key(
        "Boundary conditions with functions of time and place: names of [plug-ins](python.md#plug-ins).",
        factory=list,
    )  # fmt: skip
    plugin: dict[str, dict[str, Any]] = key(
        "Parameters of [plug-ins](python.md#plug-ins), a table `[plugin.NAME]` each.", factory=dict,
        example={"yeoh": {"c20": -1e4}},
    )  # fmt: skip
    load: Deferred[LoadSettings] | None = key("Forces on the volume.", default=None)
    initial: Deferred[InitialSettings] | None = key("Velocity at the start.", default=None)
    solver: dict[str, OptionValue] = key(
        "PETSc options by their names, without a dash. `plain = true`: DOLFINx alone assembles and PETSc alone solves, "
        "without code that is hand-written for speed.", factory=dict, example={"ksp_rtol": 1e-6}
    )  # fmt: skip
    obstacle: list[Deferred[ObstacleSettings]] = key("Obstacles.", factory=list)
    body: list[Deferred[BodySettings]] = key("Rigid bodies.", factory=list)
    contact: Deferred[ContactSettings] | None = key("Contact.", default=None)
    probe: list[Deferred[ProbeSettings]] = key("Recorded quantities.", factory=list)
    output: OutputSettings = key("Output.", default=OutputSettings())

    @model_validator(mode="before")
    @classmethod
    def _fill_in_values(cls, data: Any) -> Any:
        return with_rigid_defaults(fill_from_library(data)) if isinstance(data, dict) else data

    @field_validator("probe", "obstacle")
    @classmethod
    def _names_are_unique[Entry: (ProbeSettings, ObstacleSettings)](
        cls, entries: list[Entry], info: ValidationInfo
    ) -> list[Entry]:
        names = [entry.name for entry in entries]
        if duplicates := sorted({name for name in names if names.count(name) > 1}):
            raise ValueError(f"two {info.field_name}s have the name {duplicates[0]}")
        return entries

    @field_validator("solver")
    @classmethod
    def _print_options_have_no_value(cls, options: Options) -> Options:
        return expand_print_options(options)

    @model_validator(mode="after")
    def _tables_fit_together(self) -> Study:
        if (part := self._scheme_plugin) is None:
            check_tables(self)
            return self
        return self.with_scheme(part)

    @property
    def _scheme_plugin(self) -> PhysicsPart | None:
        """Plug-in of the time scheme; None for a built-in one, or one that is made already."""
        name = self.time.scheme
        return None if name in SCHEMES else find_plugin("schemes", name, self.plugin.get(name))

    def with_scheme(self, part: PhysicsPart) -> Study:
        """Returns the study with a time scheme of the user.

        Raises:
            InputError: the scheme is wrong.
            ValueError: a key of the study does not go with it.
        """
        scheme = part.make()
        check_scheme(scheme, part.label)
        study = self.model_copy(update={"time": self.time.with_scheme(scheme)})
        check_tables(study)
        return study

    @property
    def plugin_names(self) -> list[tuple[str, str]]:
        """Group and name of the plug-ins that the study names."""
        names: list[tuple[str, str]] = []
        if self.material.energy not in get_args(EnergyName):
            names.append(("energies", self.material.energy))
        if self.fracture is not None:
            pairs = (("criteria", self.fracture.criterion), ("edge_laws", self.fracture.edge_law))
            names += [(group, name) for group, name in pairs if name not in ("normal-stress", "brittle")]
        names += [("terms", name) for name in self.terms] + [("loads", name) for name in self.loads]
        if self.time.scheme not in SCHEMES:
            names.append(("schemes", self.time.scheme))
        if self.mesh.builder is not None and self.mesh.builder not in (*BUILDERS, GIVEN_MESH):
            names.append(("builders", self.mesh.builder))
        return names

    @property
    def monitored_load(self) -> str:
        """Name of the probe or obstacle whose load ends the run (time.until)."""
        assert self.time.until is not None
        return self.time.until.of or self.load_names[0]

    @property
    def load_names(self) -> list[str]:
        """Names of the probes of reactions and of the obstacles."""
        reactions = [probe.name for probe in self.probe if probe.quantity == "reaction"]
        return reactions + [obstacle.name for obstacle in self.obstacle]

    @property
    def thickness(self) -> float:
        """Thickness of a 2D body, m: forces and energies per metre are multiplied by it."""
        return self.material.thickness or 1.0

    @property
    def frame_interval(self) -> float:
        """Simulated time between two frames, s; 0 if `output.every` counts steps."""
        return frame_interval(self.time, self.output)

    @property
    def frame_notes(self) -> list[str]:
        """Notes on a time between frames that differs from `output.interval`."""
        return frame_notes(self.time, self.output)

    @property
    def starts_at_rest(self) -> bool:
        """True if neither the body nor a free obstacle moves at the start."""
        moving = [obstacle.is_free and (obstacle.velocity or obstacle.spin) for obstacle in self.obstacle]
        return self.initial is None and not any(moving)
