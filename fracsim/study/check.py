"""Validation of a study against its mesh, for `fracsim check` and before a run.

Names, dimensions and selectors are compared with the properties of the builder, or with the mesh file. No DOLFINx: the
answer takes a second.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from math import prod
from typing import Any

import numpy as np

from ..errors import InputError
from ..mesh.free_motion import unsupported_message
from ..mesh.selectors import Group, Selector, check_group, check_regions
from ..meshes.data import AXES, MeshData
from ..meshes.parameters import MAX_CELLS
from . import Study
from .check_limits import LIMITS
from .check_report import report_lines
from .conditions import (
    BoundaryCondition,
    boundary_conditions,
    check_size,
    fibre_direction,
    find_selector,
    grain_stretch,
    initial_cracks,
    initial_motion,
    obstacle_placements,
    volume_loads,
)
from .load_resultants import facet_loads
from .mesh_source import build_mesh, check_given_mesh, find_builder, open_surface
from .mesh_summary import MeshSummary, summarise_mesh, summarise_source
from .quadratic_checks import with_curved_boundary


def check_study(study: Study) -> list[str]:
    """Returns lines on what the scene of a study will build.

    Raises:
        InputError: if the study cannot run.
    """
    summary = summarise_source(study, open_surface(study.mesh)) or summarise_mesh(build_mesh(study.mesh))
    check_summary(study, summary)
    near = _find_near_obstacles(study, summary)
    # small meshes are built for the area of loads and for obstacles that may overlap the body
    needs_mesh = near or facet_loads(study, summary.dim)
    if summary.mesh is None and needs_mesh and summary.cell_count <= LIMITS.max_built_cells:
        summary = summary.with_mesh(build_mesh(study.mesh))
    if near and summary.mesh is not None:
        check_initial_overlap(study, summary.mesh)
    return list(report_lines(study, summary, near))


def build_checked_mesh(
    study: Study, given: MeshData | None = None, functions: Sequence[Mapping[str, Any]] = ()
) -> MeshData:
    """Returns the mesh of a study.

    What the source tells is checked before anything is built.

    Args:
        study: of one deformable body.
        given: mesh in place of that of [mesh].
        functions: boundary conditions with functions of the user.

    Raises:
        InputError: if the mesh and the study do not fit together.
    """
    surface = open_surface(study.mesh) if given is None else None
    summary = summarise_source(study, surface) if given is None else None
    if summary is not None:
        check_summary(study, summary, functions)
        _find_near_obstacles(study, summary)
    mesh = build_mesh(study.mesh, surface) if given is None else check_given_mesh(given)
    if summary is None:
        check_summary(study, summarise_mesh(mesh), functions)
    check_initial_overlap(study, mesh)
    return with_curved_boundary(study, mesh, find_builder(study.mesh))


def check_summary(study: Study, summary: MeshSummary, functions: Sequence[Mapping[str, Any]] = ()) -> None:
    """Checks a study against what is known of its mesh; `functions` as in `build_checked_mesh`.

    Raises:
        InputError: if the mesh and the study do not fit together.
    """
    _check_groups(study, summary)
    _check_dimensions(study, summary)
    conditions = boundary_conditions(study, summary.dim, functions)
    for condition in conditions[len(study.boundary) :]:
        _check_selector(f"{condition.key}.on", condition.selector, summary)
    if not study.time.scheme_class.inertia:
        _check_translations(conditions, summary.dim)


def check_initial_overlap(study: Study, mesh: MeshData) -> None:
    """Raises InputError if a body overlaps an obstacle at the start."""
    if study.obstacle:
        from . import overlap_checks

        overlap_checks.check_initial_overlap(study, mesh)


def _find_near_obstacles(study: Study, summary: MeshSummary) -> list[str]:
    """Names of obstacles that may overlap the body. InputError for an invalid shape, or two that overlap."""
    if not study.obstacle:
        return []
    from .overlap_checks import find_near_obstacles

    return find_near_obstacles(study, np.array(summary.lower), np.array(summary.upper))


def _check_translations(conditions: Sequence[BoundaryCondition], dim: int) -> None:
    """Raises InputError if no entry prescribes the motion along an axis.

    Rotations and the motion of separate bodies need the mesh: the run finds them.
    """
    prescribed = np.zeros(dim, bool)
    for condition in conditions:
        prescribed |= condition.components
    if not prescribed.all():
        raise InputError(unsupported_message("the body", f"moving along {AXES[int(np.argmin(prescribed))]}"))


def _check_groups(study: Study, summary: MeshSummary) -> None:
    """Raises InputError for a group, region or selector that the mesh does not have."""
    selectors = [(f"boundary.{i}.on", entry.on) for i, entry in enumerate(study.boundary)]
    selectors += [(f"probe.{i}.on", probe.on) for i, probe in enumerate(study.probe) if probe.on is not None]
    for key, selector in selectors:
        _check_selector(key, find_selector(selector, summary.dim, key), summary)
    check_regions(study.material.regions, summary.regions)


def _check_selector(key: str, place: Selector, summary: MeshSummary) -> None:
    """Raises InputError if the mesh lacks the group, or a box or plane is outside the bounding box."""
    if isinstance(place, Group):
        check_group(place.name, summary.groups, key)
    elif not place.intersects_box(np.array(summary.lower), np.array(summary.upper)):
        raise InputError(f"{key} selects no node; the body lies in {summary.extent}")


def _check_dimensions(study: Study, summary: MeshSummary) -> None:
    """Raises InputError for vectors, points and keys that do not fit the dimension or extent of the mesh."""
    dim = summary.dim
    if study.time.scheme == "rigid" and dim != 3:
        raise InputError(f'time.scheme = "rigid" is for bodies in space; this mesh has {dim} dimensions')
    _check_copies(study, summary.cell_count)
    # each of these refuses vectors of another dimension
    volume_loads(study, dim)
    initial_motion(study, dim)
    obstacle_placements(study, dim)
    fibre_direction(study, dim)
    if study.brittle is not None:
        grain_stretch(study.brittle, dim)
    for crack in initial_cracks(study, dim):
        if not crack.intersects_box(np.array(summary.lower), np.array(summary.upper)):
            raise InputError(f"{crack.name} lies outside the body, which spans {summary.extent}")
    for i, probe in enumerate(study.probe):
        if probe.point is not None:
            _check_inside(probe.point, summary, f"probe.{i}.point")
        if probe.contour is not None and study.time.scheme != "quasi-static":
            raise InputError(
                f'probe.{i}.contour: the J-integral is that of a body in equilibrium; give time.scheme = "quasi-static"'
            )
    if dim == 3 and study.material.thickness is not None:
        raise InputError("material.thickness is that of 2D meshes; this one has 3 dimensions: remove it")
    if dim == 3 and study.material.plane == "stress":
        raise InputError('material.plane = "stress" is for 2D meshes; this one has 3 dimensions')


def _check_copies(study: Study, cells: int) -> None:
    """Raises InputError if [[body]] asks for more bodies or cells than fit into memory."""
    copies = sum(prod(body.copies) for body in study.body)
    limits = ((copies, LIMITS.max_bodies, "bodies"), (copies * cells, MAX_CELLS, "cells in all"))
    for count, limit, unit in limits:
        if count > limit:
            raise InputError(
                f"body.N.copies: {copies:.3g} copies of a mesh of about {cells:,} cells are {count:.3g} {unit}, and at "
                f"most {limit:.0e} can be held; take fewer copies, such as copies = [10, 10, 10], or a larger mesh.h"
            )


def _check_inside(point: list[float], summary: MeshSummary, key: str) -> None:
    """Raises InputError if a point is outside the bounding box of the body, but for round-off."""
    x, lower, upper = check_size(point, summary.dim, key), np.array(summary.lower), np.array(summary.upper)
    slack = 1e-9 * float(np.linalg.norm(upper - lower))
    if np.any(x < lower - slack) or np.any(x > upper + slack):
        raise InputError(f"{key} = {point} lies outside the body, which spans {summary.extent}")
