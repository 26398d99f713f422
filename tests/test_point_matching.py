"""Rows that identify points are matched by integer keys as by a comparison of all pairs of rows."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest

from fracsim.mesh.split_surface import point_matching
from fracsim.mesh.split_surface.point_matching import match_points

Values = npt.NDArray[np.float64]


def rows_to_match(seed: int) -> tuple[Values, Values]:
    """Rows of small whole numbers, some of them equal, of which half of the old ones are new ones."""
    random = np.random.default_rng(seed)
    new = random.integers(-3, 4, (60, 5)).astype(float)
    new[50:] = new[:10]
    return np.concatenate([new[random.permutation(60)[:30]], random.integers(-3, 4, (30, 5))]), new


def first_equal_rows(old: Values, new: Values) -> list[int]:
    """The first equal row of `new` for each row of `old`, -1 without one, by all pairs."""
    equal = (old[:, None] == new[None]).all(axis=2)
    return [int(np.argmax(row)) if row.any() else -1 for row in equal]


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("with_equal_keys", [False, True])
def test_points_are_matched_as_by_all_pairs(seed: int, with_equal_keys: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """Also where unequal rows have the same key."""
    old, new = rows_to_match(seed)
    if with_equal_keys:
        monkeypatch.setattr(point_matching, "_row_keys", lambda rows: np.abs(rows).sum(axis=1).astype(np.int64) % 7)
    assert match_points(old, new).tolist() == first_equal_rows(old, new)


def test_nothing_matches_nothing() -> None:
    """Without old rows there is no match, and without new ones none is found."""
    assert len(match_points(np.empty((0, 5)), np.ones((3, 5)))) == 0
    assert match_points(np.ones((2, 5)), np.empty((0, 5))).tolist() == [-1, -1]
