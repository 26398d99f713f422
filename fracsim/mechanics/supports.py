"""Whether a quasi-static study holds every body: without inertia a free rigid motion has no answer."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from ..errors import InputError
from ..mesh.bodies import bodies_of, free_motion, not_held
from ..mesh.domain import Domain
from ..mesh.ranks import on_root
from ..meshes.data import MeshData
from ..meshes.words import middle_of
from .prescribed_motion import PrescribedMotion


def check_supports(domain: Domain, motion: PrescribedMotion) -> None:
    """InputError where a body of the mesh keeps a rigid motion that no prescribed component stops (collective)."""
    held = np.zeros(domain.node_count * domain.dim, bool)
    held[motion.owned] = True
    flags = domain.gather_nodes(held.reshape(-1, domain.dim))
    on_root(domain.comm, lambda: _check(domain.source, flags))


def _check(mesh: MeshData | None, held: npt.NDArray[np.bool_] | None) -> None:
    assert mesh is not None and held is not None
    bodies, body = bodies_of(mesh)
    for number in range(bodies):
        nodes = body == number
        free = free_motion(mesh.points[nodes], held[: len(body)][nodes])
        if free:
            where = f"the body around {middle_of(mesh.points, nodes)}"
            which = f"{where} (one of {bodies})" if bodies > 1 else "the body"
            raise InputError(not_held(which, free))
