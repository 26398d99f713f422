"""Groups of facets on the distributed mesh: those of the input, wherever its nodes went."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from dolfinx import mesh
from mpi4py import MPI

from fracsim.mesh.domain import distribute
from fracsim.meshes.builders.box import Box


def test_groups_that_overlap_have_their_facets_each() -> None:
    """35 groups, more than one number has bits: sides, all of them, none, and what lies left of one x after another."""
    body = Box(size=(1.0, 0.5, 0.5), h=0.25).build()
    every = np.concatenate(list(body.facet_groups.values()))
    middle = body.points[every].mean(axis=1)[:, 0]
    cuts = {f"to-{x:.3f}": every[middle < x] for x in np.linspace(0.04, 1.05, 27)}
    groups = body.facet_groups | {"every": every, "none": every[:0]} | cuts
    domain = distribute(MPI.COMM_SELF, replace(body, facet_groups=groups))
    assert len(groups) > 31

    nodes = mesh.entities_to_geometry(domain.mesh, 2, np.arange(domain.mesh.topology.index_map(2).size_local))
    given = np.sort(domain.mesh.geometry.input_global_indices[nodes], axis=1)
    for name, facets in groups.items():
        assert {tuple(row) for row in given[domain.facets.groups[name]]} == {
            tuple(row) for row in np.sort(facets, axis=1)
        }
        assert len(domain.facets.groups[name]) == len(facets)
