"""What quadratic displacement ([mesh] order = 2) goes with: everything else is refused, not answered wrongly."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

from ..meshes.data import MeshData

if TYPE_CHECKING:
    from .study import Study

ORDER = "mesh.order = 2 (quadratic displacement)"


def check_displacement_order(study: Study) -> None:
    """ValueError where a table of the study takes linear displacement."""
    if study.mesh.order == 1:
        return
    for key, given, why in _refused(study):
        if given:
            raise ValueError(f"{ORDER} does not go with {key}: {why}; choose order = 1, or leave that out")


def _refused(study: Study) -> list[tuple[str, bool, str]]:
    """(key, whether it is given, why not) of all that needs linear displacement."""
    fracture = study.fracture
    return [
        (
            'time.scheme = "rigid"',
            study.time.scheme == "rigid",
            "a body that does not deform gains nothing by it, and what breaks it takes linear displacement",
        ),
        (
            'fracture.approach = "edge"',
            fracture is not None and fracture.approach == "edge",
            "the middle of a broken edge would hold on to both of its ends",
        ),
        (
            'fracture.law = "cohesive"',
            fracture is not None and fracture.law == "cohesive",
            "beside a crack that softens other cells are cut as well, and it takes up to a fifth more than its energy",
        ),
        ('output.cut = "forces"', study.output.cut == "forces", "corners carry no share of a uniform stress"),
    ]


def has_curved_cells(study: Study, builder: Any) -> bool:
    """Whether cells of the study are bent; `builder`: of its mesh, None of a file."""
    straight = study.mesh.order == 1 or study.fracture is not None or study.plasticity is not None
    return not straight and bool(getattr(builder, "rounds", ()))


def with_curved_boundary(study: Study, mesh: MeshData, builder: Any) -> MeshData:
    """The mesh with the middles of edges on the round faces that its builder knows of, where cells are to have nodes
    there: straight sides would cost what quadratic displacement gains. What breaks or flows stays straight: energies of
    cells are sums over their volume."""
    if not has_curved_cells(study, builder):
        return mesh
    from ..meshes.curved_boundaries import middles_on

    return replace(mesh, middles=middles_on(mesh, builder.rounds))
