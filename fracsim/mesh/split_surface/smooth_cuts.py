"""Positions of cuts on broken edges that give a smooth crack surface in output.

The crack surface separates the ends of each broken edge. The cut c_e = x_i + s_e (x_j - x_i) of an edge moves towards
the mean of the cuts that share a cell with it:

    s_e <- (1 - w) s_e + w (mean c - x_i) . (x_j - x_i) / |x_j - x_i|^2,        s_e in [0.15, 0.85].

This is damped Laplacian smoothing along the edges: a nearly planar surface becomes planar on any mesh. The surface
stays closed and its volume is unchanged, whatever the cuts. Each cut is moved on one rank, which gets the neighbouring
cuts from others, in an order that does not depend on the number of ranks.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from mpi4py import MPI
from scipy.sparse import coo_matrix, csr_matrix

from ...meshes.topology import distinct_rows
from ..parallel import RemoteRows, RowRouting
from .mesh_part import MeshPart

Ints = npt.NDArray[np.int64]
Values = npt.NDArray[np.float64]


@dataclass(frozen=True)
class CutSmoothing:
    """Numbers of the positions of cuts on edges.

    Attributes:
        min_distance: of a cut from an end of its edge, in lengths of the edge; thinner parts have no room for contact.
        damping: w.
        iterations: of the smoothing.
    """

    min_distance: float = 0.15
    damping: float = 0.5
    iterations: int = 30


CUTS = CutSmoothing()


def smooth_cuts(part: MeshPart, broken: npt.NDArray[np.bool_], cut: Values | None = None) -> Values:
    """(E,) cuts of broken edges as shares from the lower node, NaN for intact edges (collective).

    Values in `cut` (E,) are kept. `broken`: (E,) flags of the edges of the part.
    """
    topology, comm = part.skeleton, part.comm
    result = np.full(len(broken), np.nan)
    if not comm.allreduce(bool(broken.any()), op=MPI.LOR):
        return result
    edges = np.flatnonzero(broken)
    ends = topology.points[topology.edges[edges]]
    share: Values = np.full(len(edges), 0.5)
    free = np.ones(len(edges), bool) if cut is None else np.isnan(cut[edges])
    if cut is not None:
        share[~free] = cut[edges][~free]
    # the rank that owns the lower node of an edge moves its cut
    movers = part.owner[topology.edges[edges, 0]].astype(np.int64)
    routing = RowRouting(comm, movers)
    low, high = part.node_numbers[topology.edges[edges]].T
    keys, first, row = np.unique(routing.send((low << 32) + high), return_index=True, return_inverse=True)
    start, along, share, free = (
        routing.send(values)[first] for values in (ends[:, 0], ends[:, 1] - ends[:, 0], share, free)
    )
    mean, neighbours = _neighbour_means(part, edges, movers, keys)
    per = 1.0 / np.einsum("ni,ni->n", along, along)
    for _ in range(CUTS.iterations if comm.allreduce(bool(free.any()), op=MPI.LOR) else 0):
        (cuts,) = neighbours((start + share[:, None] * along)[neighbours.requested])
        wanted = mean @ cuts
        pulled = (1 - CUTS.damping) * share + CUTS.damping * per * np.einsum("ni,ni->n", wanted - start, along)
        share = np.where(free, np.clip(pulled, CUTS.min_distance, 1 - CUTS.min_distance), share)
    result[edges] = routing.send_back(share[row])
    return result


def _neighbour_means(part: MeshPart, edges: Ints, movers: Ints, keys: Ints) -> tuple[csr_matrix, RemoteRows]:
    """Means over the broken edges that share a cell with each edge that this rank moves, itself included (collective).

    Args:
        part: part of the mesh.
        edges: (n,) broken edges of the part.
        movers: (n,) rank that moves each of them.
        keys: (m,) keys of the edges that this rank moves, ascending.

    Returns:
        The (m, k) matrix of the means, and what gets the rows of k edges from the ranks that move them.
    """
    topology, comm = part.skeleton, part.comm
    number = np.full(len(topology.edges), -1)
    number[edges] = np.arange(len(edges))
    of_cells = number[topology.cell_edges]
    cell, column = np.nonzero(of_cells >= 0)
    member = coo_matrix((np.ones(len(cell)), (cell, of_cells[cell, column])), shape=(len(of_cells), len(edges))).tocsr()
    first, second = (member.T @ member).nonzero()
    routing = RowRouting(comm, movers[first])
    low, high = part.node_numbers[topology.edges[edges]].T
    key = (low << 32) + high
    pairs = routing.send(np.stack([key[first], key[second], movers[second]], axis=1))
    # in the same order on any number of ranks
    pairs = distinct_rows(pairs)[0]
    columns, position, column = np.unique(pairs[:, 1], return_index=True, return_inverse=True)
    owners = pairs[position, 2]
    requests = RowRouting(comm, owners)
    index = requests.send_back(np.searchsorted(keys, requests.send(columns)))
    row = np.searchsorted(keys, pairs[:, 0])
    counts = np.bincount(row, minlength=len(keys))
    mean = csr_matrix((1.0 / counts[row], (row, column)), shape=(len(keys), len(columns)))
    return mean, RemoteRows(comm, owners, index)
