# ---
# jupyter:
#   jupytext:
#     formats: py:percent
# ---

# %% [markdown]
# # A criterion of one's own
#
# A bar is pulled until it breaks, by the built-in criterion and by one that is given in Python: the greatest shear
# stress (Tresca). The results are arrays.

# %%
import numpy as np

import fracsim

strength = 2e4  # Pa


def tresca(stress, edges, strengths):
    """Return the load of each edge: the greatest shear stress of its cell over its strength.

    `stress` is (n, d, d), `edges` are unit vectors (n, k, d), `strengths` are (n, k).
    """
    principal = np.linalg.eigvalsh(stress)
    shear = (principal[:, -1] - principal[:, 0]) / 2
    return shear[:, None] / strengths


# %% [markdown]
# ## The bar
#
# It is 0.4 m long and in plane strain, held by rollers, so that its stress is the same everywhere: $\sigma_x = E
# \varepsilon_x / (1 - \nu^2)$ and $\sigma_y = 0$. The greatest shear stress in the plane is $\sigma_x / 2$: by Tresca
# the bar breaks at $\sigma_x = 2 f$. The built-in criterion compares the stress along each edge with its strength:
# edges along the bar break at $\sigma_x = f$.

# %%
young, poisson, length = 1e6, 0.3, 0.4  # Pa, 1, m
bar = {
    "title": "A bar pulled apart",
    "mesh": {"builder": "box", "size": [length, 0.1], "h": 0.05},
    "material": {"energy": "linear", "young": young, "poisson": poisson, "density": 1000.0},
    "fracture": {"strength": strength, "passes": 1},
    "boundary": [
        {"on": "left", "fix": "x"},
        {"on": "bottom", "fix": "y"},
        {"on": "right", "displacement": {"time": [0.0, 1.0], "value": [[0.0, "free"], [0.02, "free"]]}},
    ],
    "probe": [{"name": "grip", "on": "right"}],
    "time": {"scheme": "quasi-static", "step": 0.02, "end": 1.0},
}


def stress_at_break(criterion=None):
    """Return the stress before the first edges break and in the step that breaks them, Pa, and the damage of cells."""
    with fracsim.Simulation(bar, criterion=criterion) as simulation:
        while not simulation.step()["broken_edges"]:
            pass
        strain = simulation.history["motion_grip_x"][-2:] / length
        damage = simulation.damage.x.array.copy()
    return young * strain / (1 - poisson**2), damage


stresses = {}
for name, criterion, exact in (("along edges", None, strength), ("Tresca", tresca, 2 * strength)):
    stresses[name], damage = stress_at_break(criterion)
    before, at = stresses[name]
    print(f"{name}: breaks between {before:.0f} and {at:.0f} Pa, closed form {exact:.0f} Pa")
    print(f"  share of broken edges of a cell: {damage.min():.2f} to {damage.max():.2f}")

# %% [markdown]
# ## Arrays of results
#
# `run` takes the criterion as well. Columns of the output are arrays: the mass of the pieces of each frame adds up to
# that of the bar, and no edge heals.

# %%
output = fracsim.run("bar-2d", out="out/own-criterion", overrides={"mesh.h": 0.02, "time.end": 0.2}, criterion=tresca)
history, pieces = output.history, output.pieces
frames = np.unique(pieces["time"])
masses = np.array([pieces["mass"][pieces["time"] == time].sum() for time in frames])  # kg
exact_mass = 1000.0 * 0.4 * 0.1  # kg: density times length and height, 1 m thick
broken = np.cumsum(history["broken_edges"])
print(f"{broken[-1]:.0f} broken edges, {history['pieces'][-1]:.0f} pieces")
print(f"mass {masses.min():.6f} to {masses.max():.6f} kg, exactly {exact_mass:g} kg")

# %% [markdown]
# ## Curves

# %%
import matplotlib.pyplot as plt

figure, axes = plt.subplots()
axes.plot(history["time"], history["elastic"], label="elastic energy / J")
axes.plot(history["time"], history["kinetic"], label="kinetic energy / J")
axes.set(xlabel="time / s")
axes.twinx().plot(history["time"], broken, "k--", label="broken edges")
axes.legend()
