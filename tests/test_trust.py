"""Steps of trust regions: against dense algebra."""

from __future__ import annotations

import numpy as np
from scipy.sparse import block_diag, csr_array

from fracsim.solvers.nonlinear_elimination import steihaug_step

RANDOM = np.random.default_rng(11)


def problem(nodes: int, lowest: float) -> tuple[np.ndarray, np.ndarray]:
    """A symmetric K whose least eigenvalue is `lowest`, the others between 1 and 2, and a force, of nodes in space."""
    n = 3 * nodes
    vectors = np.linalg.qr(RANDOM.normal(size=(n, n)))[0]
    values = RANDOM.uniform(1.0, 2.0, n)
    values[0] = lowest
    return (vectors * values) @ vectors.T, RANDOM.normal(size=(nodes, 3))


def test_several_problems_at_once() -> None:
    """A convex one whose minimum is within reach is solved; one whose minimum is not, and one that has none, end on the
    border, as low as the steepest descent within it at least; what each promises is what its model says. One that
    nothing pulls at stays."""
    parts = [problem(5, 1.0), problem(4, 1.0), problem(6, -1.0), problem(2, 1.0)]
    parts[3] = parts[3][0], np.zeros((2, 3))
    radius = np.array([10.0, 0.1, 0.5, 1.0])
    K, g = csr_array(block_diag([part[0] for part in parts])), np.concatenate([part[1] for part in parts])
    of = np.repeat(np.arange(4), [len(part[1]) for part in parts])
    z, promised = steihaug_step(K, np.tile(np.eye(3), (len(g), 1, 1)), g, of, radius)
    for each, (A, force) in enumerate(parts):
        step, pull = z[of == each].reshape(-1), force.reshape(-1)
        assert np.isclose(promised[each], -(pull @ step + step @ A @ step / 2))
        if each == 0:
            np.testing.assert_allclose(A @ step, -pull, atol=0.05 * np.linalg.norm(pull))
        elif each < 3:
            assert np.isclose(np.linalg.norm(step), radius[each])
            curved, long = pull @ A @ pull, pull @ pull
            share = min(long / curved, radius[each] / np.sqrt(long)) if curved > 0 else radius[each] / np.sqrt(long)
            assert promised[each] >= share * long - share**2 * curved / 2 - 1e-12
        else:
            assert not step.any() and not promised[each]
