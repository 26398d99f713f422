"""`fracsim check`: everything that can be known of a study without solving, and what its scene will build.

Names, dimensions and places are compared with what the builder says of itself, or with the mesh file. No DOLFINx: the
answer comes in a second.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from math import prod
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ..errors import InputError
from ..mesh.connected_bodies import bodies_of, not_held
from ..mesh.selectors import Group, Selector, check_group, check_regions
from ..meshes.data import MeshData, MeshError
from ..meshes.parameters import MOST_CELLS as CELLS
from ..meshes.text import AXES, format_point
from ..meshes.topology import boundary_facets, edges_of, signed_measures
from . import BrittleSettings, ContactSettings, FractureSettings, ObstacleSettings, Study
from .conditions import (
    boundary_conditions,
    check_size,
    fibre_direction,
    find_selector,
    initial_cracks,
    initial_motion,
    obstacle_placements,
    volume_loads,
)
from .energy_checks import check_branching_dimension, energy_criterion_notes
from .length_checks import MAX_LINEAR_ROTATION, estimated_rotation, length_scale_notes, small_strain_notes
from .load_resultants import MAX_CHECK_CELLS, facet_loads, resultant_lines
from .mesh_source import build_mesh, estimate_filled_cells, find_builder, open_surface, read_obstacle_surface
from .quadratic_checks import has_curved_cells, with_curved_boundary
from .step_checks import time_step_lines
from .unit_checks import unit_questions

if TYPE_CHECKING:
    from ..meshes.surfaces.closed import ClosedSurface


@dataclass(frozen=True)
class MeshSummary:
    """What is known of a mesh before it is built."""

    dim: int
    groups: tuple[str, ...]
    regions: tuple[str, ...]
    lower: tuple[float, ...]
    upper: tuple[float, ...]
    cell_count: int  # about how many
    size_text: str  # how many cells, in words
    h: float  # of a builder's finest cells; the mean edge of a mesh that was read, or of a builder without h, m
    surface_text: Callable[[], str]  # how many facets, in words; counted when asked
    volume: float | None = None  # m^d, where it is known
    notes: tuple[str, ...] = ()  # what was mended while reading
    mesh: MeshData | None = None  # where it was read or built


def check_study(study: Study) -> list[str]:
    """Lines that tell what the scene will build. InputError where the study cannot run."""
    anatomy = _words_of(study, open_surface(study.mesh)) or summarise_mesh(build_mesh(study.mesh))
    _check(study, anatomy)
    near = _near(study, anatomy)
    if anatomy.mesh is None and (near or facet_loads(study, anatomy.dim)) and anatomy.cell_count <= MAX_CHECK_CELLS:
        anatomy = _built(anatomy, build_mesh(study.mesh))
    if near and anatomy.mesh is not None:
        _check_room(study, anatomy.mesh)
    return list(_description(study, anatomy, near))


def build_checked_mesh(study: Study) -> MeshData:
    """The mesh of a study that fits it. InputError; from what is known beforehand before anything is built."""
    surface = open_surface(study.mesh)
    words = _words_of(study, surface)
    if words is not None:
        _check(study, words)
        _near(study, words)
    mesh = build_mesh(study.mesh, surface)
    if words is None:
        _check(study, summarise_mesh(mesh))
    if study.obstacle:
        _check_room(study, mesh)
    return with_curved_boundary(study, mesh, find_builder(study.mesh))


def _near(study: Study, anatomy: MeshSummary) -> list[str]:
    """Names of obstacles that may overlap the body. InputError where one is no shape, or overlaps another one."""
    if not study.obstacle:
        return []
    from .overlap_checks import find_near_obstacles

    return find_near_obstacles(study, np.array(anatomy.lower), np.array(anatomy.upper))


def _check_room(study: Study, mesh: MeshData) -> None:
    from .overlap_checks import check_initial_overlap

    check_initial_overlap(study, mesh)


def _words_of(study: Study, surface: ClosedSurface | None) -> MeshSummary | None:
    """What a builder says of itself, or a surface that is not filled yet. None where the mesh has to be read."""
    builder = find_builder(study.mesh)
    if builder is not None:
        try:
            (lower, upper), count = builder.bounds(), builder.cells_estimate()
        except MeshError as error:
            raise InputError(f"mesh: {error}") from None
        size, facets = f"about {count:,} cells", partial(_at_least, count, len(lower))
        h = _finest(builder)
        return MeshSummary(
            len(lower), builder.groups, builder.regions, tuple(lower), tuple(upper), count, size, h, facets
        )
    if surface is not None:
        count = estimate_filled_cells(study.mesh, surface)
        size, facets = f"about {count:,} cells in {len(surface.triangles):,} triangles", partial(_at_least, count, 3)
        lower, upper = (tuple(corner.tolist()) for corner in (surface.points.min(axis=0), surface.points.max(axis=0)))
        h = float(study.mesh.parameters["h"])
        return MeshSummary(3, ("surface",), (), lower, upper, count, size, h, facets, surface.volume, surface.notes)
    return None


def summarise_mesh(mesh: MeshData) -> MeshSummary:
    """What a mesh turned out to be."""
    count = bodies_of(mesh)[0]
    size = f"{len(mesh.cells):,} cells, {len(mesh.points):,} nodes, {count} {'body' if count == 1 else 'bodies'}"
    lower, upper = (tuple(corner.tolist()) for corner in (mesh.points.min(axis=0), mesh.points.max(axis=0)))
    volume = float(signed_measures(mesh.points, mesh.cells).sum())
    groups, regions, facets = tuple(mesh.facet_groups), tuple(mesh.regions), partial(_counted, mesh)
    h, cells = mean_edge_length(mesh), len(mesh.cells)
    return MeshSummary(mesh.dim, groups, regions, lower, upper, cells, size, h, facets, volume, mesh.notes, mesh)


def _built(anatomy: MeshSummary, mesh: MeshData) -> MeshSummary:
    """What a builder says of its mesh, with the mesh; its mean edge where the builder has no size of cells."""
    return replace(anatomy, mesh=mesh, h=anatomy.h if np.isfinite(anatomy.h) else mean_edge_length(mesh))


MAX_SAMPLED_CELLS = 50_000  # cells of a large mesh that are looked at


def mean_edge_length(mesh: MeshData) -> float:
    """The mean length of the edges of a mesh, m; of a large one, of the edges of every so many cells."""
    edges = edges_of(mesh.cells[:: 1 + len(mesh.cells) // MAX_SAMPLED_CELLS])
    return float(np.linalg.norm(mesh.points[edges[:, 1]] - mesh.points[edges[:, 0]], axis=1).mean())


def _finest(builder: Any) -> float:
    """The least of a builder's sizes of cells, m; h at a notch or a hole is h / 4 where it is left out. Infinite
    where it has none."""
    sizes = {name: size for name, size in vars(builder).items() if name == "h" or name.startswith("h_")}
    return float(min((builder.h / 4 if size is None else size for size in sizes.values()), default=np.inf))


def _counted(mesh: MeshData) -> str:
    return f"{len(boundary_facets(mesh.cells)):,} facets"


# facets of the surface over cells^((d-1)/d): 2.3 to 4 of the 2D builders; 2.8 to 4.8 of the 3D ones, but 10 to 12 of a
# thin plate and the vase
MIN_FACET_RATIO = {2: 2.3, 3: 2.8}


def _at_least(cells: int, dim: int) -> str:
    """The facets of a mesh that is not there yet, to two digits."""
    count = int(MIN_FACET_RATIO[dim] * cells ** ((dim - 1) / dim))
    unit = 10 ** max(0, len(str(count)) - 2)
    return f"{count // unit * unit:,} facets or more"


def _check(study: Study, anatomy: MeshSummary) -> None:
    _check_groups(study, anatomy)
    _check_dimensions(study, anatomy)
    if not study.time.scheme_class.inertia:
        _check_held(study, anatomy.dim)


def _check_held(study: Study, dim: int) -> None:
    """A motion along an axis that no entry holds. Turning and single bodies need the mesh: the run finds them."""
    held = np.zeros(dim, bool)
    for condition in boundary_conditions(study, dim):
        held |= condition.components
    if not held.all():
        raise InputError(not_held("the body", f"moving along {AXES[int(np.argmin(held))]}"))


def _check_groups(study: Study, anatomy: MeshSummary) -> None:
    places = [(f"boundary.{i}.on", entry.on) for i, entry in enumerate(study.boundary)]
    places += [(f"probe.{i}.on", probe.on) for i, probe in enumerate(study.probe) if probe.on is not None]
    for key, where in places:
        _check_place(key, find_selector(where, anatomy.dim, key), anatomy)
    check_regions(study.material.regions, anatomy.regions)


def _check_place(key: str, place: Selector, anatomy: MeshSummary) -> None:
    """Whether the mesh has the group, or a box or plane meets the body's bounding box at all."""
    if isinstance(place, Group):
        check_group(place.name, anatomy.groups, key)
    elif not place.intersects_box(np.array(anatomy.lower), np.array(anatomy.upper)):
        raise InputError(f"{key} selects no node; the body lies in {_extent(anatomy)}")


def _check_dimensions(study: Study, anatomy: MeshSummary) -> None:
    dim = anatomy.dim
    if study.time.scheme == "rigid" and dim != 3:
        raise InputError(f'time.scheme = "rigid" is for bodies in space; this mesh has {dim} dimensions')
    _check_copies(study, anatomy.cell_count)
    boundary_conditions(study, dim)
    volume_loads(study, dim)
    initial_motion(study, dim)
    obstacle_placements(study, dim)
    fibre_direction(study, dim)
    for crack in initial_cracks(study, dim):
        if not crack.intersects_box(np.array(anatomy.lower), np.array(anatomy.upper)):
            raise InputError(f"{crack.name} lies outside the body, which spans {_extent(anatomy)}")
    for i, probe in enumerate(study.probe):
        if probe.point is not None:
            _check_inside(probe.point, anatomy, f"probe.{i}.point")
    if dim == 3 and study.material.thickness is not None:
        raise InputError("material.thickness is that of 2D meshes; this one has 3 dimensions: remove it")
    if dim == 3 and study.material.plane == "stress":
        raise InputError('material.plane = "stress" is for 2D meshes; this one has 3 dimensions')


MAX_BODIES = 100_000


def _check_copies(study: Study, cells: int) -> None:
    """InputError where [[body]] asks for more bodies, or cells of them, than can be held."""
    copies = sum(prod(each.copies) for each in study.body)
    for count, most, what in ((copies, MAX_BODIES, "bodies"), (copies * cells, CELLS, "cells in all")):
        if count > most:
            raise InputError(
                f"body.N.copies: {copies:.3g} copies of a mesh of about {cells:,} cells are {count:.3g} {what}, and at "
                f"most {most:.0e} can be held; take fewer copies, such as copies = [10, 10, 10], or a larger mesh.h"
            )


def _check_inside(point: list[float], anatomy: MeshSummary, key: str) -> None:
    at, lower, upper = check_size(point, anatomy.dim, key), np.array(anatomy.lower), np.array(anatomy.upper)
    slack = 1e-9 * float(np.linalg.norm(upper - lower))
    if np.any(at < lower - slack) or np.any(at > upper + slack):
        raise InputError(f"{key} = {point} lies outside the body, which spans {_extent(anatomy)}")


def _extent(anatomy: MeshSummary) -> str:
    return f"{format_point(anatomy.lower)} to {format_point(anatomy.upper)}"


NODES = {2: "4 times", 3: "7 to 8 times"}  # of a mesh with linear displacement: its edges have nodes, too


def _description(study: Study, anatomy: MeshSummary, near: list[str]) -> Iterator[str]:
    if study.time.scheme == "rigid":
        yield from _rigid_description(study, anatomy)
        return
    source = study.mesh.source
    yield f"mesh        {source}: {anatomy.dim}D, {anatomy.size_text}; groups {', '.join(anatomy.groups) or 'none'}"
    if study.mesh.order == 2:
        nodes = 6 if anatomy.dim == 2 else 10
        sides = ", round sides" if has_curved_cells(study, find_builder(study.mesh)) else ""
        yield f"            quadratic displacement: cells of {nodes} nodes{sides}, {NODES[anatomy.dim]} as many nodes"
    yield f"size        {_size(anatomy)}"
    for note in anatomy.notes:
        yield f"            note: {note}"
    for line in unit_questions(study, float(np.max(np.subtract(anatomy.upper, anatomy.lower)))):
        yield f"            {line}"
    plane = f", plane {study.material.plane}{_thick(study)}" if anatomy.dim == 2 else ""
    regions = f"; regions {', '.join(study.material.regions)}" if study.material.regions else ""
    like = f"; like {study.material.like}" if study.material.like else ""
    yield f"material    {study.material.energy}{plane}{regions}{like}"
    if study.fracture is not None and study.fracture.energy is not None:
        check_branching_dimension(study, anatomy.dim)
        first, *others = energy_criterion_notes(
            study, anatomy.h, float(np.max(np.subtract(anatomy.upper, anatomy.lower)))
        )
        yield f"fracture    {first}"
        yield from (f"            {line}" for line in others)
    else:
        yield f"fracture    {_fracture(study)}"
        table = study.fracture
        if table is not None and not table.crumbs and not table.retains_nodes(study.material.energy):
            yield '            note: crumbs = false holds no node with approach = "edge" and the corotated energy;'
            yield '            energy = "linear" or approach = "chi" keeps them'
    for line in (
        *length_scale_notes(study, anatomy.h, _least_side(anatomy)),
        *small_strain_notes(study),
        *_prefers(study, anatomy),
    ):
        yield f"            {line}"
    yield f"plasticity  {_plasticity(study)}"
    if study.brittle is not None:
        yield f"brittle     {_brittle(study.brittle)}"
    if study.crack:
        yield f"cracks      {len(study.crack)}, broken before the start"
    yield f"damping     {_damping(study)}"
    kinds = [entry.kind for entry in study.boundary]
    yield f"boundary    {', '.join(kinds) if kinds else 'none: the body is free'}"
    yield f"load        {', '.join(study.load.model_dump(exclude_none=True)) if study.load else 'none'}"
    for line in resultant_lines(study, anatomy.dim, anatomy.mesh):
        yield f"            {line}"
    if study.obstacle:
        yield f"obstacles   {', '.join(f'{each.name} ({_motion(each)} {each.shape})' for each in study.obstacle)}"
        if any(each.shape != "mesh" for each in study.obstacle):
            yield f"            touched by the points of {anatomy.surface_text()}, {_MORE}; {_PRICE_OF_OBSTACLES}"
        for i, each in enumerate(study.obstacle):
            if each.file is not None:
                yield f"            {each.name}: {_solid(each.file, each.scale or 1.0, f'obstacle.{i}')}"
        if (
            len(study.obstacle) > 1
            and any(each.is_free for each in study.obstacle)
            and not study.time.scheme_class.implicit
        ):
            yield "            note: in explicit steps obstacles do not feel, and pass through each other"
        if any(each.is_free for each in study.obstacle) and any(each.shape == "mesh" for each in study.obstacle):
            yield "            note: obstacles that move freely do not feel those from files; free ones from files feel"
            yield "            shapes that are held or driven, with their points"
    if study.contact is not None and study.contact.itself:
        of = "of pieces alone with one another" if study.contact.itself == "pieces" else "of the body with itself"
        price = _PRICE_OF_CONTACT[study.time.scheme_class.implicit]
        yield f"contact     {of}, friction {study.contact.friction:g}; {price}"
        yield f"            its surface has {anatomy.surface_text()}, {_MORE}"
    yield from time_step_lines(study, anatomy.dim, anatomy.h, anatomy.mesh)
    yield from _frames(study)
    if (until := study.time.until) is not None:
        yield f"            ends where the force on {study.monitored_load} has fallen by {until.drop:.0%} from its peak"
    if (
        study.material.energy == "linear"
        and estimated_rotation(study, anatomy.dim, _least_side(anatomy)) > MAX_LINEAR_ROTATION
    ):
        yield '            note: with energy = "linear" pieces that come off and turn swell by 1/cos of their angle;'
        yield '            "corotated" costs little more, and turns them as they are'
    if near and anatomy.mesh is None:
        yield f"            whether the body lies in {' or '.join(near)} is not looked at in meshes of more than"
        yield f"            {MAX_CHECK_CELLS:,} cells that are not built yet; the run does"
    options = ", ".join(f"{key}={value}" for key, value in study.solver.items())
    yield f"solver      {options or 'defaults (Newton with line search, CG, algebraic multigrid)'}"
    yield f"probes      {', '.join(f'{probe.name} ({probe.quantity})' for probe in study.probe) or 'none'}"


def _rigid_description(study: Study, anatomy: MeshSummary) -> Iterator[str]:
    """What there is of a study of rigid bodies."""
    source = study.mesh.source
    yield f"mesh        {source}: {anatomy.dim}D, {anatomy.size_text}"
    yield f"size        {_size(anatomy)}"
    for line in unit_questions(study, float(np.max(np.subtract(anatomy.upper, anatomy.lower)))):
        yield f"            {line}"
    copies = sum(int(np.prod(each.copies)) for each in study.body) or 1
    yield f"bodies      {copies} times the mesh; motion on one rank, no fields.xdmf"
    if study.brittle is not None and study.fracture is not None:
        yield f"fracture    strength {study.fracture.strength:g} Pa, {_average(study.fracture)}"
        yield f"brittle     {'of each body, ' if copies > 1 else ''}{_brittle(study.brittle)}"
    elif study.plasticity is not None:
        table = study.plasticity
        much = f"{table.yield_stress:g} Pa, hardening {table.hardening:g} Pa"
        yield f"plasticity  what is struck keeps a dent where von Mises stress exceeds {much}"
    else:
        yield "fracture    off: nothing is analysed"
    yield f"obstacles   {', '.join(f'{each.name} ({_motion(each)} {each.shape})' for each in study.obstacle) or 'none'}"
    contact = study.contact or ContactSettings()
    lasting = "Hertz's time" if contact.contact_time is None else f"{contact.contact_time:g} s"
    restitution = contact.restitution or 0.0
    yield f"contact     friction {contact.friction:g}, restitution {restitution:g}, a blow lasts {lasting}"
    yield f"time        rigid, {study.time.end / study.time.max_step:.0f} steps of {study.time.max_step:g} s"
    yield from _frames(study)


def _frames(study: Study) -> Iterator[str]:
    """How far apart frames are."""
    every, interval = study.output.every, study.frame_interval
    if every is not None:
        yield f"            a frame every {f'{every} steps' if every > 1 else 'step'}"
        return
    steps = round(interval / study.time.max_step) if study.time.has_constant_steps else 0
    yield f"            a frame every {interval:g} s" + (f", {steps} step{'s'[: steps != 1]}" if steps else "")
    for note in study.frame_notes:
        yield f"            note: {note}"


# Measured of boxes of 25,000 and 207,000 tetrahedra, of which nothing touched anything: two obstacles and a body alone.
_MORE = "and of cracks as they open"
_PRICE_OF_OBSTACLES = "nothing is gathered; some 2 % of a step until they touch"
_PRICE_OF_SOLIDS = "gathered and detected on one rank, from two edges' length on"
_PRICE_OF_CONTACT = {
    implicit: f"gathered and detected on one rank: some {share} until something touches, on n ranks n times that share"
    for implicit, share in ((True, "tenth of a step"), (False, "two fifths of an explicit step (12,000 cells)"))
}


def _motion(obstacle: ObstacleSettings) -> str:
    if obstacle.is_free:
        much = f"{obstacle.mass:g} kg" if obstacle.mass is not None else f"{obstacle.density:g} kg/m^3"
        how = " on a hinge" if obstacle.hinge is not None else f" along {obstacle.guide}" if obstacle.guide else ""
        return f"free{how}, {much},"
    return "fixed" if obstacle.displacement is None and obstacle.velocity is None else "driven"


def _solid(file: Path, scale: float, key: str) -> str:
    surface = read_obstacle_surface(file, scale, key)
    return f"{len(surface.triangles):,} triangles, {surface.extent}, {surface.volume:.4g} m^3; {_PRICE_OF_SOLIDS}"


def _thick(study: Study) -> str:
    return "" if study.material.thickness is None else f", {study.material.thickness:g} m thick"


# Edges near the commonest directions, relative to a mesh without preferred directions: random points have 1.1 to 3.7.
MAX_EDGE_DIRECTION_RATIO = 4.0
EDGES = {2: 100, 3: 1000}  # fewer tell nothing


def _prefers(study: Study, anatomy: MeshSummary) -> Iterator[str]:
    """How much edges prefer some directions, of a mesh that was read or built, where cracks run along them."""
    if study.fracture is None or study.brittle is not None or anatomy.mesh is None:
        return
    from ..meshes.directions import preferred

    mesh = anatomy.mesh
    if len(mesh.points) < EDGES[anatomy.dim]:
        return
    found = max(preferred(mesh, MAX_SAMPLED_CELLS).values())
    if found > MAX_EDGE_DIRECTION_RATIO and study.fracture.energy is None:
        yield f"note: the mesh has {found:.2g} times as many edges along its commonest directions as one without any,"
        yield "and cracks run along edges: take random points (builders, surface, outline), or fracture.energy"
    elif found > MAX_EDGE_DIRECTION_RATIO:
        yield f"the mesh has {found:.2g} times as many edges along its commonest directions as one without any; cracks"
        yield "that take an energy go through cells, and cross edges in any direction"


def _least_side(anatomy: MeshSummary) -> float:
    """Of the body's box, m."""
    return float(np.min(np.subtract(anatomy.upper, anatomy.lower)))


def _size(anatomy: MeshSummary) -> str:
    """The body's sides, where it lies, and its volume or area."""
    sides = " x ".join(f"{side:.4g}" for side in np.subtract(anatomy.upper, anatomy.lower))
    names = {2: "area", 3: "volume"}
    measure = f"; {names[anatomy.dim]} {anatomy.volume:.4g} m^{anatomy.dim}" if anatomy.volume is not None else ""
    return f"{sides} m, from {_extent(anatomy)}{measure}"


def _fracture(study: Study) -> str:
    if study.fracture is None:
        return "off: no damage field, no graph, no average"
    fracture = study.fracture
    approach = "degraded energy (chi)" if fracture.approach == "chi" else "strain projected on intact edges (edge)"
    closing = ", cracks close" if fracture.unilateral else ""
    return f"{approach}, strength {fracture.strength:g} Pa, {_average(fracture)}{closing}"


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


def _brittle(brittle: BrittleSettings) -> str:
    many = f"{brittle.surfaces} surfaces" if brittle.surfaces > 1 else "1 surface"
    apart = f"starts {brittle.spacing:g} m apart" if brittle.spacing else "starts two mesh edges apart"
    at_once = f", {brittle.per_pass} a pass" if brittle.per_pass else ""
    return f"up to {many}{at_once}, {_kind_of(brittle)}, {apart}; edges do not break by themselves"


def _kind_of(brittle: BrittleSettings) -> str:
    grains = brittle.grains
    if grains is None:
        return brittle.shape
    how = "each frees one of" if grains.mode == "replace" else f"{brittle.shape} along the boundaries of"
    return f"{how} {grains.count} grains (seed {grains.seed}, spread {grains.spread:g})"


def _damping(study: Study) -> str:
    if study.damping is None:
        return "off"
    return f"Rayleigh, {study.damping.mass:g} M + {study.damping.stiffness:g} K"
