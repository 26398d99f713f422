"""`[solver] plain = true`: PETSc and DOLFINx alone, to the same motion as with what is hand-written for speed."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from fracsim.errors import InputError
from fracsim.scene import Scene
from fracsim.solvers.plain_solver import PlainPreconditioner
from fracsim.solvers.preconditioner import Preconditioner
from fracsim.study.reader import validate
from support.scenes import Walk, make_scene
from support.solver_policy import set_policy


def bent(**solver: Any) -> tuple[Scene, Walk]:
    """A beam of rubber after two steps of being bent."""
    scene, walk = make_scene(
        mesh={"builder": "box", "size": [1.0, 0.25, 0.25], "h": 0.125},
        material={"energy": "neo-hookean", "young": 1e6, "poisson": 0.3, "density": 1000.0},
        boundary=[{"on": "left", "fix": "xyz"}, {"on": "right", "velocity": ["free", 0.0, 1.0]}],
        time={"scheme": "backward-euler", "step": 0.02, "end": 1.0}, solver={"snes_rtol": 1e-10} | solver,
    )  # fmt: skip
    for _ in range(2):
        walk.advance()
    return scene, walk


@pytest.mark.parametrize(("dofs", "method", "kind"), [(10**6, "cg", "cholesky"), (0, "cg", "gamg")])
def test_it_finds_the_same_motion(dofs: int, method: str, kind: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """By factors of small systems and by CG with GAMG of large ones, where the default has blocks and its own cycle."""
    set_policy(monkeypatch, min_block_dofs=0, max_plain_direct_dofs=dofs)
    (fast, fast_walk), (plain, plain_walk) = bent(plain=False), bent(plain=True)
    np.testing.assert_allclose(plain_walk.u, fast_walk.u, rtol=0, atol=1e-7 * np.abs(fast_walk.u).max())
    assert plain.solver is not None and fast.solver is not None
    linear = plain.solver.linear
    assert isinstance(linear.preconditioner, PlainPreconditioner) and linear.operators.block_operator is None
    assert (linear.ksp.getType(), linear.preconditioner.pc.getType()) == (method, kind)
    assert plain.balance.stress.kernels.plain and not fast.balance.stress.kernels.plain
    assert isinstance(fast.solver.linear.preconditioner, Preconditioner)


def test_it_is_true_or_false() -> None:
    data: dict[str, Any] = {
        "title": "plain",
        "mesh": {"builder": "box", "size": [1.0, 1.0], "h": 0.5}, "solver": {"plain": 1},
        "material": {"energy": "linear", "young": 1.0, "poisson": 0.3, "density": 1.0},
        "time": {"scheme": "quasi-static", "step": 1.0, "end": 1.0},
    }  # fmt: skip
    with pytest.raises(InputError, match=r"solver\.plain = 1: true or false"):
        validate(data, "plain.toml")
