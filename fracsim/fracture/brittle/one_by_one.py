"""Nodes that are left without a cell whose corners are all on their side, moved one after the other.

Where nodes are moved over all at once, each with its own cell in mind, neighbours undo one another's: where grains are
2.5 edges wide in a slab of two cells, one node in two hundred stays alone. Taken alone each finds a cell that leaves
fewer.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

Ints = npt.NDArray[np.int64]
Flags = npt.NDArray[np.bool_]

ROUNDS = 3


def one_by_one[Label: (Ints, Flags)](cells: Ints, label: Label, movable: Flags) -> Label:
    """Labels (N,) of nodes, grains or sides, with all corners of one cell of each lost node given one label of those
    around it, where that leaves fewer nodes lost; of several ways the one that moves fewest.

    `cells` (m, k): all those of the nodes that are `movable` (N,); others keep their labels, and do not count. The loop
    is over lost nodes, what each could do is looked at at once.
    """
    label = label.copy()
    around = _Around(cells, len(label))
    for _ in range(ROUNDS):
        held = np.bincount(cells[_whole(label[cells])].ravel(), minlength=len(label))
        lost = np.flatnonzero((held == 0) & movable & around.any)
        if not len(lost) or not any([_moved(cells, label, movable, held, around, int(node)) for node in lost]):
            break
    return label


class _Around:
    """Cells of nodes.

    Attributes:
        any: (N,) whether a node has any.
    """

    def __init__(self, cells: Ints, count: int) -> None:
        flat = cells.ravel()
        self._order = np.argsort(flat, kind="stable")
        self._start = np.searchsorted(flat[self._order], np.arange(count + 1))
        self._corners, self.any = cells.shape[1], np.diff(self._start) > 0

    def __call__(self, nodes: Ints) -> Ints:
        """Of any of some nodes, ascending."""
        parts = [self._order[self._start[node] : self._start[node + 1]] for node in nodes]
        return np.unique(np.concatenate(parts) // self._corners)


def _whole(label: npt.NDArray[Any]) -> Flags:
    """(..., m) whether all corners (..., m, k) have one label."""
    return np.asarray(np.all(label == label[..., :1], axis=-1))


def _moved(cells: Ints, label: Ints | Flags, movable: Flags, held: Ints, around: _Around, node: int) -> bool:
    """Whether a lost node has found a cell; labels and how many whole cells nodes have (N,) are brought up to date."""
    if held[node]:
        return False
    near = cells[around(np.array([node]))]
    corners = np.unique(near)
    local = cells[around(corners)]
    nodes, place = np.unique(local, return_inverse=True)
    place = place.reshape(local.shape)
    kinds = np.unique(label[corners])
    ways = np.repeat(near, len(kinds), axis=0)
    trial = np.tile(np.asarray(label[nodes]), (len(ways), 1))
    np.put_along_axis(trial, np.searchsorted(nodes, ways), np.tile(kinds, len(near))[:, None], axis=1)
    changed = trial != label[nodes]
    allowed = np.flatnonzero(~np.any(changed & ~movable[nodes], axis=1))
    trial, changed = trial[allowed], changed[allowed]
    incidence = np.zeros((len(local), len(nodes)), np.int64)
    incidence[np.arange(len(local))[:, None], place] = 1
    outside = held[nodes] - _whole(label[local]) @ incidence
    now = outside + _whole(trial[:, place]) @ incidence
    left = np.count_nonzero((now == 0) & movable[nodes], axis=1)
    before = np.count_nonzero((held[nodes] == 0) & movable[nodes])
    best = np.lexsort((np.arange(len(left)), changed.sum(axis=1), left))[:1]
    if not len(best) or left[best[0]] >= before:
        return False
    label[nodes], held[nodes] = trial[best[0]], now[best[0]]
    return True
