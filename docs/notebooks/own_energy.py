# ---
# jupyter:
#   jupytext:
#     formats: py:percent
# ---

# %% [markdown]
# # An energy of one's own
#
# A plate of rubber is pulled. Its energy is that of Yeoh, given in Python, and its curve is compared with a closed
# form.
#
# The energy is $\psi = c_1 i + c_2 i^2 + c_3 i^3 + \frac{K}{2} (J - 1)^2$ with $i = J^{-2/3} \mathrm{tr}(F^T F) - 3$
# and $c_1 = \mu / 2$, so that the plate has the moduli of the study at rest (O. H. Yeoh, 1993).

# %%
from dataclasses import dataclass

import numpy as np
import ufl
from scipy.optimize import brentq

import fracsim

young, poisson = 1e6, 0.45  # Pa, 1
mu, bulk = young / (2 * (1 + poisson)), young / (3 * (1 - 2 * poisson))  # Pa
c2, c3 = -0.05 * mu, 0.01 * mu  # Pa


@dataclass(frozen=True)
class Yeoh:
    """Energy density for the 3 x 3 deformation gradient F, J/m^3."""

    mu: float  # Pa

    def psi(self, F):
        """Return psi(F)."""
        J = ufl.det(F)
        i = J ** (-2 / 3) * ufl.inner(F, F) - 3
        return self.mu / 2 * i + c2 * i**2 + c3 * i**3 + bulk / 2 * (J - 1) ** 2


# %% [markdown]
# ## The plate
#
# It is 0.2 m long, 0.1 m high and in plane strain. Three sides have rollers: the left and the bottom side are held,
# and the right side moves. The upper side is free.


# %%
def pull(t):
    """Displacement of the right side, m: the plate is twice as long at t = 1 s."""
    return [0.2 * t, 0.0]


plate = {
    "title": "A plate of rubber",
    "mesh": {"builder": "box", "size": [0.2, 0.1], "h": 0.05},
    "material": {"young": young, "poisson": poisson, "density": 1000.0},
    "boundary": [{"on": "left", "fix": "x"}, {"on": "bottom", "fix": "y"}],
    "probe": [{"name": "grip", "on": "right"}],
    "time": {"scheme": "quasi-static", "step": 0.1, "end": 1.0},
}
with fracsim.Simulation(
    plate, energy=Yeoh(mu), boundary=[{"on": "right", "displacement": pull, "components": "x"}]
) as simulation:
    while not simulation.ended:
        simulation.step()
    history = simulation.history

stretch = 1 + history["motion_grip_x"] / 0.2
force = history["reaction_grip_x"]  # N, of a plate 1 m thick

# %% [markdown]
# ## The closed form
#
# The deformation is the same everywhere: $F = \mathrm{diag}(\lambda, \lambda_2, 1)$. The free side bears no stress,
# $\partial \psi / \partial \lambda_2 = 0$, which gives $\lambda_2$. The force is $\partial \psi / \partial \lambda$
# times the area at rest. With $a = \lambda^2 + \lambda_2^2 + 1$ and $J = \lambda \lambda_2$, $\partial i / \partial
# \lambda_k = J^{-2/3} (2 \lambda_k - \frac{2 a}{3 \lambda_k})$.


# %%
def nominal_stress(first, second):
    """Derivatives of psi by both stretches, Pa."""
    J, a = first * second, first**2 + second**2 + 1
    i = J ** (-2 / 3) * a - 3
    slope = mu / 2 + 2 * c2 * i + 3 * c3 * i**2
    by_stretch = [J ** (-2 / 3) * (2 * s - 2 * a / (3 * s)) for s in (first, second)]
    return slope * by_stretch[0] + bulk * (J - 1) * second, slope * by_stretch[1] + bulk * (J - 1) * first


def exact_force(first):
    """Force on the right side at a stretch, N."""
    second = brentq(lambda side: nominal_stress(first, side)[1], 0.1, 1.5, xtol=1e-14)
    return nominal_stress(first, second)[0] * 0.1


exact = np.array([exact_force(value) for value in stretch])
error = np.abs(force / exact - 1).max()
print(f"largest error of the force: {error:.1e}")

# %% [markdown]
# ## The curve

# %%
import matplotlib.pyplot as plt

figure, axes = plt.subplots()
axes.plot(stretch, exact / 1e3, label="closed form")
axes.plot(stretch, force / 1e3, "o", label="plate")
axes.set(xlabel="stretch", ylabel="force / kN")
axes.legend()
