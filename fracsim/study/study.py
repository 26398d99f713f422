"""Schema of a whole study: its tables, and the conditions between them."""

from __future__ import annotations

from typing import Any

from pydantic import ValidationInfo, field_validator, model_validator

from .body import DampingSettings, MaterialSettings, MeshSettings, RegionSettings
from .boundary_conditions import BoundarySettings, InitialSettings, LoadSettings
from .contact import ContactSettings, ObstacleSettings
from .fracture import BrittleSettings, CrackSettings, FractureSettings, PlasticitySettings
from .material_library import fill_from_library
from .quadratic_checks import check_displacement_order
from .rigid_bodies import MAX_ROTATION_PER_STEP, BodySettings, check_rigid, with_rigid_defaults
from .solver_options import Options, OptionValue, check_options, expand_print_options
from .time_and_output import FRACTURE_FIELDS, OutputSettings, ProbeSettings, TimeSettings, frame_interval, frame_notes
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
    load: Deferred[LoadSettings] | None = key("Forces on the volume.", default=None)
    initial: Deferred[InitialSettings] | None = key("Velocity at the start.", default=None)
    solver: dict[str, OptionValue] = key(
        "PETSc options by their names, without a dash. `plain = true`: PETSc and DOLFINx alone, without code that is "
        "hand-written for speed.", factory=dict, example={"ksp_rtol": 1e-6}
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
    def _options_are_data(self) -> Study:
        check_options(self.solver)
        return self

    @model_validator(mode="after")
    def _fields_exist(self) -> Study:
        wanted = [name for name in self.output.fields or [] if name in FRACTURE_FIELDS]
        # without [fracture] there is neither a graph nor a degradation to write
        if wanted and self.fracture is None:
            raise ValueError(f'output.fields has "{wanted[0]}", which needs a [fracture] table')
        return self

    @model_validator(mode="after")
    def _strength_needs_fracture(self) -> Study:
        special = [name for name, region in self.material.regions.items() if region.strength is not None]
        if special and self.fracture is None:
            raise ValueError(f"material.{special[0]}.strength needs a [fracture] table")
        special = [name for name, region in self.material.regions.items() if region.fracture_energy is not None]
        if special and (self.fracture is None or self.fracture.energy is None):
            raise ValueError(f"material.{special[0]}.fracture_energy needs fracture.energy, that of the other regions")
        return self

    @model_validator(mode="after")
    def _yield_needs_plasticity(self) -> Study:
        if self.plasticity is None:
            special = [name for name, region in self.material.regions.items() if region.yield_stress is not None]
            if special:
                raise ValueError(f"material.{special[0]}.yield_stress needs a [plasticity] table")
            if "plastic_strain" in (self.output.fields or []):
                raise ValueError('output.fields has "plastic_strain", which needs a [plasticity] table')
        return self

    @model_validator(mode="after")
    def _check_plasticity(self) -> Study:
        table, material = self.plasticity, self.material
        if table is None:
            return self
        if self.time.scheme == "rigid":  # see check_rigid
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
        for region in (RegionSettings(), *material.regions.values()):
            young, poisson, _ = material.elastic_constants(region)
            # the tangent of plastic flow, 3 mu + K, must be positive
            if table.hardening <= (limit := -1.5 * young / (1 + poisson)):
                raise ValueError(
                    f"plasticity.hardening = {table.hardening:g}: must be greater than -3 mu = {limit:.4g} Pa; a body "
                    "that softens faster than it unloads has no equilibrium"
                )
        return self

    @model_validator(mode="after")
    def _check_surfaces(self) -> Study:
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
    def _check_energy_criterion(self) -> Study:
        table = self.fracture
        if table is not None and table.branching:
            if table.energy is None:
                raise ValueError("fracture.branching needs fracture.energy: tips branch where that of two cracks flows")
            if self.time.scheme == "quasi-static":
                raise ValueError(
                    "fracture.branching needs inertia: a slow crack is given no more than it takes; remove it, or "
                    'choose time.scheme = "explicit" or "newmark"'
                )
        if table is not None and table.law == "cohesive":
            self._check_cohesive(table)
        if table is None or table.energy is None:
            return self
        # a crack with an energy has its own average, growth by cells and cuts
        conflicts = {
            "fracture.approach": (table.approach != "chi", 'cells that a crack cuts fade: choose approach = "chi"'),
            "fracture.radius": (table.radius > 0, "stress is averaged over 3 h, and tips go by energy: remove radius"),
            "fracture.kernel": (table.kernel != "linear", "stress is averaged over 3 h: remove kernel"),
            "fracture.cap": (table.cap is not None, "a tip advances by one cell a pass: remove cap"),
            'output.cut = "forces"': (self.output.cut == "forces", "cracks say where they cut: remove it"),
            "[brittle]": (self.brittle is not None, "surfaces take no energy: remove [brittle], or fracture.energy"),
            "[plasticity]": (self.plasticity is not None, "the force on a tip is that of an elastic body: remove it"),
        }
        for name, (present, why) in conflicts.items():
            if present:
                raise ValueError(f"fracture.energy does not go with {name}: {why}")
        return self

    def _check_cohesive(self, table: FractureSettings) -> None:
        if table.energy is None:
            raise ValueError('fracture.law = "cohesive" needs fracture.energy: what a crack takes as it opens')
        conflicts = {
            f'time.scheme = "{self.time.scheme}"': (
                self.time.scheme != "quasi-static", 'cohesive cracks are slow ones: choose "quasi-static"'
            ),
            "fracture.unilateral": (
                table.unilateral, "cells that are cut and pressed keep what stiffness they have left: remove it"
            ),
            "fracture.crumbs = false": (not table.crumbs, "no node is held while cells are half open: remove crumbs"),
        }  # fmt: skip
        for name, (present, why) in conflicts.items():
            if present:
                raise ValueError(f'fracture.law = "cohesive" does not go with {name}: {why}')

    @model_validator(mode="after")
    def _cracks_need_fracture(self) -> Study:
        if self.crack and self.fracture is None:
            raise ValueError("[[crack]] needs a [fracture] table: without it no edge can be broken (strength = inf)")
        return self

    @model_validator(mode="after")
    def _check_projection(self) -> Study:
        if self.fracture is None or self.fracture.approach != "edge":
            return self
        if self.material.energy not in ("linear", "corotated"):
            raise ValueError(
                f'fracture.approach = "edge" is for the energies linear and corotated, not {self.material.energy}: '
                'with a nonlinear strain split cells blow up; choose approach = "chi" or energy = "corotated"'
            )
        # projected strain has no degradation of cells
        if "chi" in (self.output.fields or []):
            raise ValueError('output.fields has "chi", which fracture.approach = "edge" does not have; remove it')
        return self

    @model_validator(mode="after")
    def _explicit_steps_have_one_pass(self) -> Study:
        if not self.time.scheme_class.implicit and self.fracture is not None and (self.fracture.passes or 1) > 1:
            raise ValueError("fracture.passes solves a step again, which explicit steps do not; set passes = 1")
        return self

    @model_validator(mode="after")
    def _check_contact(self) -> Study:
        scheme = f'time.scheme = "{self.time.scheme}"'
        if self.contact is not None and not self.time.scheme_class.implicit and self.contact.creep is not None:
            raise ValueError(f"contact.creep is for implicit schemes: with {scheme} friction sticks; remove it")
        from_files = [number for number, obstacle in enumerate(self.obstacle) if obstacle.shape == "mesh"]
        if from_files and not self.time.scheme_class.implicit:
            raise ValueError(
                f"obstacle.{from_files[0]} is read from a file, which needs an implicit scheme, not {scheme}; choose "
                '"backward-euler", or another shape'
            )
        if self.contact is not None and not self.contact.itself and not self.obstacle:
            raise ValueError("[contact] has itself = false and there is no [[obstacle]]: nothing can touch; remove it")
        return self

    @model_validator(mode="after")
    def _free_obstacles_have_inertia(self) -> Study:
        free = [number for number, obstacle in enumerate(self.obstacle) if obstacle.is_free]
        if free and not self.time.scheme_class.inertia:
            raise ValueError(
                f"obstacle.{free[0]} has a mass and moves freely, which takes inertia: a quasi-static study has none; "
                'choose time.scheme = "backward-euler", or drive it by displacement'
            )
        return self

    @model_validator(mode="after")
    def _check_spins(self) -> Study:
        spins = [(f"body.{number}", body.spin) for number, body in enumerate(self.body)]
        spins += [(f"obstacle.{i}", obstacle.spin) for i, obstacle in enumerate(self.obstacle) if obstacle.spin]
        if self.initial is not None and self.initial.spin:
            spins.append(("initial", self.initial.spin))
        for name, spin in spins:
            if (rotation := max(map(abs, spin)) * self.time.max_step) > MAX_ROTATION_PER_STEP:
                raise ValueError(
                    f"{name}.spin turns it by {rotation:.3g} rad in a step of {self.time.max_step:g} s; at most "
                    f"{MAX_ROTATION_PER_STEP:g} rad are followed: give a slower spin or a shorter time.step"
                )
        return self

    @model_validator(mode="after")
    def _check_order(self) -> Study:
        check_displacement_order(self)
        return self

    @model_validator(mode="after")
    def _check_rigid(self) -> Study:
        check_rigid(self)
        return self

    @model_validator(mode="after")
    def _check_stop_criterion(self) -> Study:
        if self.time.until is None:
            return self
        names, name = self._load_names(), self.time.until.of
        # a single probe or obstacle needs no name
        if (len(names) == 1 and name is None) or name in names:
            return self
        which = f"of = {name!r} is none of them" if name is not None else "say which, of = NAME"
        available = ", ".join(names) or "none: add a [[probe]] with on = the group that is driven"
        raise ValueError(
            f"time.until watches the force on a probed group or an obstacle: {which}; there are: {available}"
        )

    @property
    def monitored_load(self) -> str:
        """Name of the probe or obstacle whose load ends the run (time.until)."""
        assert self.time.until is not None
        return self.time.until.of or self._load_names()[0]

    def _load_names(self) -> list[str]:
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

    @model_validator(mode="after")
    def _initial_velocity_needs_inertia(self) -> Study:
        if not self.time.scheme_class.inertia and self.initial is not None:
            raise ValueError("[initial] sets a velocity, which a quasi-static study does not have; remove it")
        return self
