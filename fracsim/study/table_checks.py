"""Conditions between the tables of a study, checked in order."""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise
from typing import TYPE_CHECKING, Any

from .body import RegionSettings
from .fracture import FractureSettings
from .quadratic_checks import check_displacement_order
from .rigid_bodies import check_rigid
from .solver_options import check_options
from .time_and_output import FRACTURE_FIELDS

if TYPE_CHECKING:
    from .study import Study


def check_tables(study: Study) -> None:
    """Check all conditions between tables.

    Raises:
        ValueError: with the first condition that does not hold.
    """
    check_options(study.solver)
    for check in CHECKS:
        check(study)


def _check_fields(study: Study) -> None:
    wanted = [name for name in study.output.fields or [] if name in FRACTURE_FIELDS]
    # without [fracture] there is neither a graph nor a degradation to write
    if wanted and study.fracture is None:
        raise ValueError(f'output.fields has "{wanted[0]}", which needs a [fracture] table')


def _check_region_strengths(study: Study) -> None:
    special = [name for name, region in study.material.regions.items() if region.strength is not None]
    if special and study.fracture is None:
        raise ValueError(f"material.{special[0]}.strength needs a [fracture] table")
    special = [name for name, region in study.material.regions.items() if region.fracture_energy is not None]
    if special and (study.fracture is None or study.fracture.energy is None):
        raise ValueError(f"material.{special[0]}.fracture_energy needs fracture.energy, that of the other regions")


def _check_region_yield_stresses(study: Study) -> None:
    if study.plasticity is None:
        special = [name for name, region in study.material.regions.items() if region.yield_stress is not None]
        if special:
            raise ValueError(f"material.{special[0]}.yield_stress needs a [plasticity] table")
        if "plastic_strain" in (study.output.fields or []):
            raise ValueError('output.fields has "plastic_strain", which needs a [plasticity] table')


def _check_plasticity(study: Study) -> None:
    table, material = study.plasticity, study.material
    if table is None:
        return
    if study.time.scheme == "rigid":  # see check_rigid
        return
    if material.energy == "linear":
        raise ValueError(
            "[plasticity] splits the deformation gradient, which the energy linear does not tell from small "
            'strain; choose energy = "corotated", the same law at small strain'
        )
    if material.plane == "stress":
        raise ValueError('[plasticity] is for 3D and plane strain; choose plane = "strain"')
    if study.fracture is not None and study.fracture.approach == "edge":
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


def _check_crack_surfaces(study: Study) -> None:
    if study.brittle is None:
        return
    if study.fracture is None:
        raise ValueError("[brittle] needs a [fracture] table: its strength decides where surfaces start")
    if study.fracture.cap is not None:
        raise ValueError("fracture.cap is a share of edges, [brittle] breaks surfaces: set brittle.per_pass instead")
    if study.output.cut == "forces":
        raise ValueError('output.cut = "forces" is for single edges; surfaces of [brittle] say where they cut: remove')


def _check_energy_criterion(study: Study) -> None:
    table = study.fracture
    if table is not None and table.branching:
        if table.energy is None:
            raise ValueError("fracture.branching needs fracture.energy: tips branch where that of two cracks flows")
        if study.time.scheme == "quasi-static":
            raise ValueError(
                "fracture.branching needs inertia: a slow crack is given no more than it takes; remove it, or "
                'choose time.scheme = "explicit" or "newmark"'
            )
    if table is not None and table.law == "cohesive":
        _check_cohesive(study, table)
    if table is None or table.energy is None:
        return
    # a crack with an energy has its own average, growth by cells and cuts
    conflicts = {
        "fracture.approach": (table.approach != "chi", 'cells that a crack cuts fade: choose approach = "chi"'),
        "fracture.radius": (table.radius > 0, "stress is averaged over 3 h, and tips go by energy: remove radius"),
        "fracture.kernel": (table.kernel != "linear", "stress is averaged over 3 h: remove kernel"),
        "fracture.cap": (table.cap is not None, "a tip advances by one cell a pass: remove cap"),
        'output.cut = "forces"': (study.output.cut == "forces", "cracks say where they cut: remove it"),
        "[brittle]": (study.brittle is not None, "surfaces take no energy: remove [brittle], or fracture.energy"),
    }
    for name, (present, why) in conflicts.items():
        if present:
            raise ValueError(f"fracture.energy does not go with {name}: {why}")


def _check_cohesive(study: Study, table: FractureSettings) -> None:
    if table.energy is None:
        raise ValueError('fracture.law = "cohesive" needs fracture.energy: what a crack takes as it opens')
    conflicts = {
        "fracture.branching": (table.branching, "its tips have no speed of their own: remove it"),
        "fracture.unilateral": (
            table.unilateral, "cells that are cut and pressed keep what stiffness they have left: remove it"
        ),
        "[plasticity]": (study.plasticity is not None, "the law of the crack is that of an elastic body: remove it"),
        "fracture.crumbs = false": (not table.crumbs, "no node is held while cells are half open: remove crumbs"),
        "fracture.passes in quasi-static steps": (
            table.passes is not None and not study.time.scheme_class.inertia,
            "a crack that has not softened to its end in a step carries many times its strength: remove passes"
        ),
    }  # fmt: skip
    for name, (present, why) in conflicts.items():
        if present:
            raise ValueError(f'fracture.law = "cohesive" does not go with {name}: {why}')


def _check_initial_cracks(study: Study) -> None:
    if study.crack and study.fracture is None:
        raise ValueError("[[crack]] needs a [fracture] table: without it no edge can be broken (strength = inf)")


def _check_edge_approach(study: Study) -> None:
    if study.fracture is None or study.fracture.approach != "edge":
        return
    if study.material.energy not in ("linear", "corotated"):
        raise ValueError(
            f'fracture.approach = "edge" is for the energies linear and corotated, not {study.material.energy}: '
            'with a nonlinear strain split cells blow up; choose approach = "chi" or energy = "corotated"'
        )
    # projected strain has no degradation of cells
    if "chi" in (study.output.fields or []):
        raise ValueError('output.fields has "chi", which fracture.approach = "edge" does not have; remove it')


def _check_passes(study: Study) -> None:
    if not study.time.scheme_class.implicit and study.fracture is not None and (study.fracture.passes or 1) > 1:
        raise ValueError("fracture.passes solves a step again, which explicit steps do not; set passes = 1")


def _check_contact(study: Study) -> None:
    scheme = f'time.scheme = "{study.time.scheme}"'
    if study.contact is not None and not study.time.scheme_class.implicit and study.contact.creep is not None:
        raise ValueError(f"contact.creep is for implicit schemes: with {scheme} friction sticks; remove it")
    if study.contact is not None and not study.contact.itself and not study.obstacle:
        raise ValueError("[contact] has itself = false and there is no [[obstacle]]: nothing can touch; remove it")


def _check_free_obstacles(study: Study) -> None:
    free = [number for number, obstacle in enumerate(study.obstacle) if obstacle.is_free]
    if free and not study.time.scheme_class.inertia:
        raise ValueError(
            f"obstacle.{free[0]} has a mass and moves freely, which takes inertia: a quasi-static study has none; "
            'choose time.scheme = "backward-euler", or drive it by displacement'
        )


def _check_spins(study: Study) -> None:
    spins = [(f"body.{number}", body.spin) for number, body in enumerate(study.body)]
    spins += [(f"obstacle.{i}", obstacle.spin) for i, obstacle in enumerate(study.obstacle) if obstacle.spin]
    if study.initial is not None and study.initial.spin:
        spins.append(("initial", study.initial.spin))
    # larger angles in a step lose their digits
    max_rotation = 1e3  # rad
    for name, spin in spins:
        if (rotation := max(map(abs, spin)) * study.time.max_step) > max_rotation:
            raise ValueError(
                f"{name}.spin turns it by {rotation:.3g} rad in a step of {study.time.max_step:g} s; at most "
                f"{max_rotation:g} rad are followed: give a slower spin or a shorter time.step"
            )


def _check_obstacle_motions(study: Study) -> None:
    step = study.time.max_step
    # longer motions in a step lose the digits of gaps
    max_motion = 1e6  # m
    for number, obstacle in enumerate(study.obstacle):
        motions = {
            "velocity": step * _largest(_values_over_time(obstacle.velocity)[1]),
            "displacement": _largest_motion(*_values_over_time(obstacle.displacement), step),
        }
        for name, motion in motions.items():
            if motion > max_motion:
                raise ValueError(
                    f"obstacle.{number}.{name} moves it by {motion:.3g} m in a step of {step:g} s; at most "
                    f"{max_motion:g} m are followed: give a slower motion or a shorter time.step"
                )


def _values_over_time(value: Any) -> tuple[list[float], list[list[float]]]:
    """Return times, s, and vectors of a value that may be constant or tabulated; None: no vectors."""
    if value is None:
        return [], []
    return ([0.0], [value]) if isinstance(value, list) else (value.time, value.value)


def _largest(vectors: list[list[float]]) -> float:
    return max((abs(number) for vector in vectors for number in vector), default=0.0)


def _largest_motion(times: list[float], vectors: list[list[float]], step: float) -> float:
    """Return the largest motion along an axis in a step, m, of displacements that are linear between times."""
    spans = zip(pairwise(times), pairwise(vectors), strict=True)
    return max(
        (min(1.0, step / (t1 - t0)) * abs(b - a) for (t0, t1), (v0, v1) in spans for a, b in zip(v0, v1, strict=True)),
        default=0.0,
    )


def _check_stop_criterion(study: Study) -> None:
    if study.time.until is None:
        return
    names, name = study.load_names, study.time.until.of
    # a single probe or obstacle needs no name
    if (len(names) == 1 and name is None) or name in names:
        return
    which = f"of = {name!r} is none of them" if name is not None else "say which, of = NAME"
    available = ", ".join(names) or "none: add a [[probe]] with on = the group that is driven"
    raise ValueError(f"time.until watches the force on a probed group or an obstacle: {which}; there are: {available}")


def _check_initial_velocity(study: Study) -> None:
    if not study.time.scheme_class.inertia and study.initial is not None:
        raise ValueError("[initial] sets a velocity, which a quasi-static study does not have; remove it")


def _check_plugins(study: Study) -> None:
    names = study.plugin_names
    if unused := sorted(study.plugin.keys() - {name for _, name in names}):
        listed = ", ".join(name for _, name in names) or "none"
        raise ValueError(
            f"plugin.{unused[0]} has parameters of a plug-in that the study does not name; it names {listed}"
        )
    groups = {group for group, _ in names}
    if "energies" in groups and study.plasticity is not None:
        raise ValueError(
            f'[plasticity] is for built-in energies, not for material.energy = "{study.material.energy}": choose '
            'energy = "neo-hookean"'
        )
    criterion = sorted(
        {"criteria": "criterion", "edge_laws": "edge_law"}[group]
        for group in groups
        if group in ("criteria", "edge_laws")
    )
    if criterion and study.fracture is not None and study.fracture.energy is not None:
        raise ValueError(f"fracture.{criterion[0]} is for edges that break one by one: remove it, or fracture.energy")
    if criterion and study.brittle is not None:
        raise ValueError(f"fracture.{criterion[0]} is for edges that break one by one: remove it, or [brittle]")
    if study.time.scheme == "rigid" and groups - {"builders"}:
        raise ValueError(f'time.scheme = "rigid" takes no plug-ins but mesh builders: remove {names[0][1]}')


CHECKS: tuple[Callable[[Study], None], ...] = (
    _check_fields,
    _check_region_strengths,
    _check_region_yield_stresses,
    _check_plasticity,
    _check_crack_surfaces,
    _check_energy_criterion,
    _check_initial_cracks,
    _check_edge_approach,
    _check_passes,
    _check_contact,
    _check_free_obstacles,
    _check_spins,
    _check_obstacle_motions,
    check_displacement_order,
    check_rigid,
    _check_stop_criterion,
    _check_initial_velocity,
    _check_plugins,
)
