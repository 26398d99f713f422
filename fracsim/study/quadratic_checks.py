"""Limits of quadratic displacement (`mesh.order = 2`), and its curved cells."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

from ..meshes.data import MeshData

if TYPE_CHECKING:
    from .study import Study

_ORDER = "mesh.order = 2 (quadratic displacement)"


def check_displacement_order(study: Study) -> None:
    """Check that no key of the study needs linear displacement.

    Raises:
        ValueError: with the first such key.
    """
    if study.mesh.order == 1:
        return
    for key, present, why in _unsupported_keys(study):
        if present:
            raise ValueError(f"{_ORDER} does not go with {key}: {why}; choose order = 1, or leave that out")


def _unsupported_keys(study: Study) -> list[tuple[str, bool, str]]:
    """Key, whether the study has it, and the reason, for all keys that need linear displacement."""
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


def corner_contact_note(study: Study) -> str:
    """Returns a sentence if surfaces are in contact by corners alone, so that midside nodes penetrate; else ""."""
    with_itself = study.contact is not None and bool(study.contact.itself)
    from_file = any(obstacle.shape == "mesh" for obstacle in study.obstacle)
    if study.mesh.order == 1 or study.fracture is None or not (with_itself or from_file):
        return ""
    return (
        "mesh.order = 2 with [fracture]: contact of the body with itself and with obstacles from files acts on corners "
        "alone, and may lack an eighth of its force"
    )


def has_curved_cells(study: Study, builder: Any) -> bool:
    """Returns whether boundary cells of the study are curved; `builder` is that of its mesh, None for a file."""
    straight = study.mesh.order == 1 or study.fracture is not None or study.plasticity is not None
    return not straight and bool(getattr(builder, "curved_boundaries", ()))


def with_curved_boundary(study: Study, mesh: MeshData, builder: Any) -> MeshData:
    """Returns the mesh with midside nodes on the curved faces of its builder.

    Straight sides would lose the accuracy of quadratic displacement. Bodies that break or yield keep straight sides,
    since energies of their cells are sums over the volume. `builder` is that of the mesh, None for a file.
    """
    if not has_curved_cells(study, builder):
        return mesh
    from ..meshes.parameters import curved_midside_points

    return replace(mesh, middles=curved_midside_points(mesh, builder.curved_boundaries))
