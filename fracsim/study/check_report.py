"""Lines of `fracsim check`: what the scene of a study will build, with notes and questions. No DOLFINx here.

Questions on units: users have meshes in mm, moduli in MPa or GPa, densities in g/cm^3 or t/mm^3, strengths in MPa and
fracture energies in N/mm. The thresholds are far from all materials of `material_library`.
"""

from __future__ import annotations

import textwrap
from collections.abc import Iterator
from math import inf, sqrt
from pathlib import Path

import numpy as np

from . import BrittleSettings, ContactSettings, FractureSettings, ObstacleSettings, Study
from .body import RegionSettings
from .check_limits import LIMITS
from .conditions import condition_notes
from .length_checks import (
    check_branching_dimension,
    energy_criterion_notes,
    estimated_rotation,
    length_scale_notes,
    plane_modulus,
    small_strain_notes,
)
from .load_resultants import resultant_lines
from .mesh_source import find_builder, read_obstacle_surface
from .mesh_summary import MeshSummary
from .quadratic_checks import corner_contact_note, has_curved_cells
from .step_checks import time_step_lines

# nodes of a mesh with quadratic displacement over those with linear displacement: edges have nodes, too
_NODE_RATIO = {2: "4 times", 3: "7 to 8 times"}
# Measured with boxes of 25,000 and 207,000 tetrahedra without contact and with two obstacles.
_WITH_CRACK_FACES = "and of cracks that open"
_OBSTACLE_COST = "nothing is gathered; about 2 % of a step without contact"
_MESH_OBSTACLE_COST = "each rank detects contact of its part of the body, within two edge lengths"
# measured with a box of 43,000 tetrahedra in motion, on one rank and on two
_CONTACT_COST = {
    implicit: f"each rank detects contact of its part of the body: {cost} while nothing is near"
    for implicit, cost in ((True, "about a third of a step"), (False, "up to a fifth of an explicit step"))
}
_INDENT = " " * 12
# builders of shells, and of solid bodies with flat faces
_SHELLS = ("boat", "ornament")
_FLAT = ("box", "l-panel", "notched-bar", "notched-plate", "stones")


def report_lines(study: Study, summary: MeshSummary, near: list[str]) -> Iterator[str]:
    """Yield the lines of `fracsim check`.

    Args:
        study: a valid study.
        summary: of its mesh.
        near: names of obstacles that may overlap the body.

    Raises:
        InputError: if a file of an obstacle, or a load, turns out to be invalid.
    """
    if study.time.scheme == "rigid":
        yield from _rigid_lines(study, summary)
        return
    yield from _mesh_lines(study, summary)
    yield from _fracture_lines(study, summary)
    yield f"plasticity  {_plasticity(study)}"
    for line in _staggered_note(study):
        yield f"{_INDENT}{line}"
    if study.brittle is not None:
        yield f"brittle     {_brittle(study.brittle)}"
    if study.crack:
        yield f"cracks      {len(study.crack)}, broken before the start"
    yield f"damping     {_damping(study)}"
    yield from _load_lines(study, summary)
    yield from _contact_lines(study, summary)
    yield from _time_lines(study, summary)
    if near and summary.mesh is None:
        yield f"{_INDENT}whether the body overlaps {' or '.join(near)} is not checked for meshes of more than"
        yield f"{_INDENT}{LIMITS.max_built_cells:,} cells that are not built yet; the run checks it"
    options = ", ".join(f"{name}={value}" for name, value in study.solver.items())
    yield f"solver      {options or 'defaults (Newton with line search, CG, algebraic multigrid)'}"
    yield f"probes      {', '.join(f'{probe.name} ({probe.quantity})' for probe in study.probe) or 'none'}"


def _mesh_lines(study: Study, summary: MeshSummary) -> Iterator[str]:
    """Mesh, size, questions on units, and material."""
    groups = ", ".join(summary.groups) or "none"
    yield f"mesh        {study.mesh.source}: {summary.dim}D, {summary.size_text}; groups {groups}"
    if study.mesh.order == 2:
        nodes, ratio = 6 if summary.dim == 2 else 10, _NODE_RATIO[summary.dim]
        sides = ", round sides" if has_curved_cells(study, find_builder(study.mesh)) else ""
        yield f"{_INDENT}quadratic displacement: cells of {nodes} nodes{sides}, {ratio} as many nodes"
    yield f"size        {_size(summary)}"
    for note in summary.notes:
        yield f"{_INDENT}note: {note}"
    for line in (*_cell_count_question(study, summary), *unit_questions(study, summary.max_side)):
        yield f"{_INDENT}{line}"
    plane = f", plane {study.material.plane}{_thickness(study)}" if summary.dim == 2 else ""
    regions = f"; regions {', '.join(study.material.regions)}" if study.material.regions else ""
    like = f"; like {study.material.like}" if study.material.like else ""
    yield f"material    {study.material.energy}{plane}{regions}{like}"
    for line in _locking_note(study, summary.dim):
        yield f"{_INDENT}{line}"


def _locking_note(study: Study, dim: int) -> Iterator[str]:
    """Yield a note on linear cells of a nearly incompressible material."""
    table = study.material
    ratios = [table.elastic_constants(region)[1] for region in (RegionSettings(), *table.regions.values())]
    is_plane_stress = dim == 2 and table.plane == "stress"
    if study.mesh.order == 1 and not is_plane_stress and max(ratios) >= LIMITS.max_linear_poisson:
        yield f"note: linear cells lock at a Poisson's ratio of {max(ratios):g}: bodies that bend are too stiff;"
        yield "mesh.order = 2 does not lock"


def _cell_count_question(study: Study, summary: MeshSummary) -> Iterator[str]:
    """Yield a question on a mesh of more cells than most computers hold."""
    cells = summary.cell_count
    if cells > LIMITS.max_expected_cells:
        coarser = summary.h * (cells / 1e6) ** (1 / summary.dim)
        gigabytes = cells * LIMITS.bytes_per_cell / 1e9
        memory = "" if study.time.scheme == "rigid" else f" take about {gigabytes:.0f} GB of memory"
        yield f"question: {cells:,} cells{memory}: are so many meant? Cells of {coarser:.2g} m are a million"


def _fracture_lines(study: Study, summary: MeshSummary) -> Iterator[str]:
    """Criterion of fracture, and notes on lengths and directions of the mesh."""
    table = study.fracture
    if table is not None and table.energy is not None:
        check_branching_dimension(study, summary.dim)
        first, *following = energy_criterion_notes(study, summary.h, summary.max_side)
        yield f"fracture    {first}"
        yield from (f"{_INDENT}{line}" for line in following)
    else:
        yield f"fracture    {_fracture(study)}"
        if table is not None and not table.crumbs and not table.retains_nodes(study.material.energy):
            yield f'{_INDENT}note: crumbs = false retains no node with approach = "edge" and the corotated energy;'
            yield f'{_INDENT}energy = "linear" or approach = "chi" does'
    notes = length_scale_notes(study, summary.h, summary.min_side, summary.max_side)
    for line in (*notes, *small_strain_notes(study), *_direction_notes(study, summary)):
        yield f"{_INDENT}{line}"


def _load_lines(study: Study, summary: MeshSummary) -> Iterator[str]:
    """Boundary conditions, and loads with their resultants."""
    kinds = [entry.kind for entry in study.boundary]
    yield f"boundary    {', '.join(kinds) if kinds else 'none: the body is free'}"
    yield f"load        {', '.join(study.load.model_dump(exclude_none=True)) if study.load else 'none'}"
    for line in (*resultant_lines(study, summary.dim, summary.mesh), *_condition_lines(study, summary.dim)):
        yield f"{_INDENT}{line}"


def _condition_lines(study: Study, dim: int) -> Iterator[str]:
    """Yield notes on tables over time and displacements at the start."""
    for note in condition_notes(study, dim):
        yield from textwrap.wrap(f"note: {note}", 96)


def _contact_lines(study: Study, summary: MeshSummary) -> Iterator[str]:
    """Obstacles and self-contact, with what they cost."""
    if study.obstacle:
        yield f"obstacles   {_obstacle_list(study)}"
        shapes = [obstacle.shape for obstacle in study.obstacle]
        if any(shape != "mesh" for shape in shapes):
            surface = summary.surface_text()
            yield f"{_INDENT}acts on the points of {surface}, {_WITH_CRACK_FACES}; {_OBSTACLE_COST}"
        for i, obstacle in enumerate(study.obstacle):
            if obstacle.file is not None:
                text = _mesh_obstacle(obstacle.file, obstacle.scale or 1.0, f"obstacle.{i}")
                yield f"{_INDENT}{obstacle.name}: {text}"
    if study.contact is not None and study.contact.itself:
        between_fragments = study.contact.itself == "pieces"
        partners = "of fragments with each other" if between_fragments else "of the body with itself"
        implicit = study.time.scheme_class.implicit
        cost = _CONTACT_COST[implicit]
        yield f"contact     {partners}, friction {study.contact.friction:g}; {cost}"
        yield f"{_INDENT}its surface has {summary.surface_text()}, {_WITH_CRACK_FACES}"
        if study.fracture is not None and implicit and not between_fragments:
            yield f"{_INDENT}note: where a soft body tears, contact of cracks inside a fragment takes 30 to 65 times"
            yield f'{_INDENT}the rest of a step; contact.itself = "pieces" leaves it out, and takes up to a third'
        if study.crack:
            yield f"{_INDENT}note: crack faces follow cells and interlock under pressure, so that they hardly slide;"
            yield f"{_INDENT}for a plane that slides give two bodies in one mesh file, with a gap between them"
    if note := corner_contact_note(study):
        yield from (f"{_INDENT}{line}" for line in textwrap.wrap(f"note: {note}", 96))


def _time_lines(study: Study, summary: MeshSummary) -> Iterator[str]:
    """Steps, frames and the end of the run."""
    yield from time_step_lines(study, summary.dim, summary.h, summary.mesh)
    yield from _frame_lines(study)
    if (until := study.time.until) is not None:
        yield f"{_INDENT}ends where the force on {study.monitored_load} has fallen by {until.drop:.0%} from its peak"
    linear = study.material.energy == "linear"
    if linear and estimated_rotation(study, summary.dim, summary.min_side) > LIMITS.max_linear_rotation:
        yield f'{_INDENT}note: with energy = "linear" fragments that rotate swell by 1/cos of their angle;'
        yield f'{_INDENT}"corotated" costs little more and does not'


def _rigid_lines(study: Study, summary: MeshSummary) -> Iterator[str]:
    """Lines on a study of rigid bodies."""
    source = study.mesh.source
    yield f"mesh        {source}: {summary.dim}D, {summary.size_text}"
    yield f"size        {_size(summary)}"
    for line in (*_cell_count_question(study, summary), *unit_questions(study, summary.max_side)):
        yield f"{_INDENT}{line}"
    copies = sum(int(np.prod(body.copies)) for body in study.body) or 1
    yield f"bodies      {copies} times the mesh; they move on one rank, no fields.xdmf"
    yield from (f"{_INDENT}{line}" for line in _collision_lines(study, summary, copies))
    if study.brittle is not None and study.fracture is not None:
        yield f"fracture    strength {study.fracture.strength:g} Pa, {_average(study.fracture)}"
        yield f"brittle     {'of each body, ' if copies > 1 else ''}{_brittle(study.brittle)}"
    elif study.plasticity is not None:
        table = study.plasticity
        limits = f"{table.yield_stress:g} Pa, hardening {table.hardening:g} Pa"
        yield f"plasticity  impacts leave dents where the von Mises stress exceeds {limits}"
    else:
        yield "fracture    off: no analyses"
    yield f"obstacles   {_obstacle_list(study) or 'none'}"
    yield from (f"{_INDENT}{line}" for line in _condition_lines(study, summary.dim))
    contact = study.contact or ContactSettings()
    duration = "Hertz's time" if contact.contact_time is None else f"{contact.contact_time:g} s"
    restitution = contact.restitution or 0.0
    yield f"contact     friction {contact.friction:g}, restitution {restitution:g}, an impact lasts {duration}"
    yield f"time        rigid, {study.time.end / study.time.max_step:.0f} steps of {study.time.max_step:g} s"
    yield from _frame_lines(study)


def _collision_lines(study: Study, summary: MeshSummary, copies: int) -> Iterator[str]:
    """What unbroken rigid bodies collide as; nothing for builders of solid bodies with flat faces."""
    if study.mesh.shell is not None or study.mesh.builder in _SHELLS:
        # a triangle is three cells
        if copies * summary.cell_count > 3 * LIMITS.max_shell_triangles:
            yield f"note: shells of more than {LIMITS.max_shell_triangles:,} triangles in all collide as unions of"
            yield "convex parts, which may lie some thicknesses off them; a larger mesh.h has fewer triangles"
        else:
            yield "unbroken shells touch with their triangles, fragments as convex polyhedra"
        return
    if study.mesh.builder in _FLAT:
        return
    solid = getattr(find_builder(study.mesh), "round_solid", None)
    if solid is not None:
        yield f"unbroken bodies collide as a {solid.kind}, fragments as convex polyhedra"
        return
    yield "note: bodies collide as convex polyhedra, so that round ones roll more slowly than smooth ones; the builders"
    yield "sphere, capsule and cylinder roll as such"


def _frame_lines(study: Study) -> Iterator[str]:
    """Time between frames, in steps and s."""
    steps_between, interval = study.output.every, study.frame_interval
    if steps_between is not None:
        yield f"{_INDENT}a frame every {f'{steps_between} steps' if steps_between > 1 else 'step'}"
        return
    steps = round(interval / study.time.max_step) if study.time.has_constant_steps else 0
    yield f"{_INDENT}a frame every {interval:g} s" + (f", {steps} step{'s'[: steps != 1]}" if steps else "")
    for note in study.frame_notes:
        yield f"{_INDENT}note: {note}"


def _obstacle_list(study: Study) -> str:
    return ", ".join(f"{obstacle.name} ({_motion(obstacle)} {obstacle.shape})" for obstacle in study.obstacle)


def _motion(obstacle: ObstacleSettings) -> str:
    """Kind of motion of an obstacle: fixed, driven, or free with its mass and constraint."""
    if obstacle.is_free:
        mass = f"{obstacle.mass:g} kg" if obstacle.mass is not None else f"{obstacle.density:g} kg/m^3"
        guide = f" along {obstacle.guide}" if obstacle.guide else ""
        constraint = " on a hinge" if obstacle.hinge is not None else guide
        return f"free{constraint}, {mass},"
    return "fixed" if obstacle.displacement is None and obstacle.velocity is None else "driven"


def _mesh_obstacle(file: Path, scale: float, key: str) -> str:
    """Size of an obstacle from a file. InputError if the file is invalid."""
    surface = read_obstacle_surface(file, scale, key)
    return f"{len(surface.triangles):,} triangles, {surface.extent}, {surface.volume:.4g} m^3; {_MESH_OBSTACLE_COST}"


def _thickness(study: Study) -> str:
    return "" if study.material.thickness is None else f", {study.material.thickness:g} m thick"


def _direction_notes(study: Study, summary: MeshSummary) -> Iterator[str]:
    """Notes on preferred directions of the edges of a mesh that was read or built: cracks run along edges."""
    if study.fracture is None or study.brittle is not None or summary.mesh is None:
        return
    from ..meshes.directions import preferred_directions

    mesh = summary.mesh
    if len(mesh.points) < LIMITS.min_direction_nodes[summary.dim]:
        return
    ratio, limit = max(preferred_directions(mesh, LIMITS.max_sampled_cells).values()), LIMITS.max_edge_direction_ratio
    if ratio > limit and study.fracture.energy is None:
        yield f"note: the mesh has {ratio:.2g} times as many edges along its commonest directions as one without any,"
        yield "and cracks run along edges: take random points (builders, surface, outline), or fracture.energy"
    elif ratio > limit:
        yield f"the mesh has {ratio:.2g} times as many edges along its commonest directions as one without any; cracks"
        yield "with a fracture energy go through cells, in any direction"


def _size(summary: MeshSummary) -> str:
    """Side lengths and extent of the body, and its volume or area if it is known."""
    sides = " x ".join(f"{side:.4g}" for side in np.subtract(summary.upper, summary.lower))
    names = {2: "area", 3: "volume"}
    measure = f"; {names[summary.dim]} {summary.volume:.4g} m^{summary.dim}" if summary.volume is not None else ""
    return f"{sides} m, from {summary.extent}{measure}"


def _fracture(study: Study) -> str:
    if study.fracture is None:
        return "off: no damage field, no graph, no average"
    fracture = study.fracture
    approach = "degraded energy (chi)" if fracture.approach == "chi" else "strain projected on intact edges (edge)"
    closure = ", cracks close" if fracture.unilateral else ""
    return f"{approach}, strength {fracture.strength:g} Pa, {_average(fracture)}{closure}"


def _average(fracture: FractureSettings) -> str:
    if fracture.kernel == "neighbours":
        return "average over neighbouring cells"
    return f"average over {fracture.radius:g} m ({fracture.kernel})" if fracture.radius else "local, no average"


def _plasticity(study: Study) -> str:
    if study.plasticity is None:
        return "off: no plastic strain, no flow"
    table = study.plasticity
    rate = "independent of the rate" if np.isinf(table.flow_rate) else f"flow rate {table.flow_rate:g} 1/s"
    return (
        f"{table.measure} stress above {table.yield_stress:g} Pa, {rate}, "
        f"hardening {table.hardening:g} Pa, {table.update}"
    )


def _staggered_note(study: Study) -> Iterator[str]:
    """Yield a note on flow that follows the steps."""
    table = study.plasticity
    if table is not None and table.update == "staggered":
        yield "note: in a step of strain d the stress is up to 3 G d above that of yield, G being the shear modulus;"
        yield 'update = "implicit" has no such error'


def _brittle(brittle: BrittleSettings) -> str:
    count = f"{brittle.surfaces} surfaces" if brittle.surfaces > 1 else "1 surface"
    spacing = f"starts {brittle.spacing:g} m apart" if brittle.spacing else "starts two mesh edges apart"
    per_pass = f", {brittle.per_pass} a pass" if brittle.per_pass else ""
    return f"up to {count}{per_pass}, {_surface_kind(brittle)}, {spacing}; single edges do not break"


def _surface_kind(brittle: BrittleSettings) -> str:
    grains = brittle.grains
    if grains is None:
        return brittle.shape
    relation = "each frees one of" if grains.mode == "replace" else f"{brittle.shape} along the boundaries of"
    return f"{relation} {grains.count} grains (seed {grains.seed}, spread {grains.spread:g})"


def _damping(study: Study) -> str:
    if study.damping is None:
        return "off"
    return f"Rayleigh, {study.damping.mass:g} M + {study.damping.stiffness:g} K"


def unit_questions(study: Study, max_side: float) -> Iterator[str]:
    """Yield lines that begin with "question:", or continue such a line.

    Args:
        study: with any table.
        max_side: longest side of the body, m.
    """
    if max_side > LIMITS.max_side:
        yield f"question: the body is {max_side:.4g} m long: is the mesh in mm? {_length_remedy(study)}"
    if max_side < LIMITS.min_side:
        yield f"question: the body is {max_side:.4g} m long: {_length_remedy(study)} (lengths are in m)"
    yield from _material_questions(study, "material.", RegionSettings())
    for name, region in study.material.regions.items():
        if region.young or region.density or region.strength or region.fracture_energy:
            yield from _material_questions(study, f"material.{name}.", region)
    gravity = study.load.gravity if study.load is not None else None
    if gravity is not None and (magnitude := max(map(abs, gravity))) > LIMITS.max_gravity:
        yield f"question: gravity is {magnitude:g} m/s^2: is it in mm/s^2? On Earth it is 9.81 m/s^2"


def _length_remedy(study: Study) -> str:
    if study.mesh.builder is not None:
        return "Give mesh.h and the sizes of the builder in m"
    return "Give mesh.scale, metres for each unit of length of the file (a file in mm: mesh.scale = 1e-3)"


def _material_questions(study: Study, prefix: str, region: RegionSettings) -> Iterator[str]:
    """Yield questions on a region whose keys begin with `prefix`."""
    young, _, density = study.material.elastic_constants(region)
    si_density = _guess_density(density, young)
    if si_density != density:
        unit = "t/mm^3" if density < 1e-3 else "g/cm^3"
        yield f"question: {prefix}density = {density:g} kg/m^3: is it in {unit}? Then it is {si_density:.4g} kg/m^3"
    elif density > LIMITS.max_density:
        yield f"question: {prefix}density = {density:g} kg/m^3 is more than that of any metal: it is in kg/m^3"
    # the speed of sound tells moduli in GPa or MPa from those in Pa
    speed = sqrt(young / si_density)
    soft = young < LIMITS.soft_young and (si_density > LIMITS.soft_density or speed < LIMITS.min_sound_speed)
    if soft:
        unit, factor = ("GPa", 1e9) if young < 1000 else ("MPa", 1e6)
        yield f"question: {prefix}young = {young:g} Pa with a density of {si_density:.4g} kg/m^3 is softer than rubber:"
        yield f"is it in {unit}? Then it is {young * factor:.4g} Pa"
    elif speed > LIMITS.max_sound_speed:
        yield f"question: {prefix}young = {young:g} Pa with a density of {si_density:.4g} kg/m^3: sound would run at"
        yield f"{speed:.2g} m/s, faster than in diamond; young is in Pa"
    table = study.fracture
    if table is None:
        return
    strength, energy = region.strength or table.strength, region.fracture_energy or table.energy
    if strength < LIMITS.min_strength_share * young:
        yield f"question: strength = {strength:g} Pa is {strength / young:.1g} of young: is it in MPa?"
        yield f"Then it is {strength * 1e6:.3g} Pa"
        return
    if soft or energy is None or not strength < inf:
        return
    if plane_modulus(study, region) * energy < LIMITS.min_irwin_length * strength**2:
        yield f"question: energy = {energy:g} J/m^2: l_ch is shorter than an atom is wide: is it in N/mm or kJ/m^2?"
        yield f"Then it is {energy * 1e3:.3g} J/m^2"


def _guess_density(density: float, young: float) -> float:
    """Returns the density in kg/m^3, converted if the value looks like one in t/mm^3 or g/cm^3; `young` in Pa."""
    if density < 1e-3:
        return density * 1e12
    # foams are as light as metals in g/cm^3, but not as stiff
    light = density < LIMITS.min_density or (density < LIMITS.metal_density and young > LIMITS.metal_young)
    return density * 1e3 if light else density
