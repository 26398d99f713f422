# ---
# jupyter:
#   jupytext:
#     formats: py:percent
# ---

# %% [markdown]
# # Coupling with another form of DOLFINx
#
# A plate is heated at one end. DOLFINx solves the heat equation on a mesh of its own. The temperature becomes an
# eigenstrain in fracsim, on the same mesh handed over, and the plate bends as a closed form says.

# %%
import numpy as np
import ufl
from dolfinx import fem, mesh
from mpi4py import MPI
from scipy.sparse.linalg import spsolve
from scipy.spatial import cKDTree

import fracsim

length, height, heating = 0.2, 0.1, 100.0  # m, m, K
expansion, young, poisson = 1e-5, 1e9, 0.3  # 1/K, Pa, 1

# %% [markdown]
# ## The heat equation
#
# The left end is kept at 0 K and the right end at 100 K above the temperature without stress; the other sides are
# insulated.

# %%
plate = mesh.create_rectangle(MPI.COMM_WORLD, [[0, 0], [length, height]], (32, 16), mesh.CellType.triangle)
plate.topology.create_connectivity(1, 2)
ends = [mesh.locate_entities_boundary(plate, 1, lambda x, at=at: np.isclose(x[0], at)) for at in (0.0, length)]
space = fem.functionspace(plate, ("Lagrange", 1))
fixed = [
    fem.dirichletbc(value, fem.locate_dofs_topological(space, 1, end), space)
    for end, value in zip(ends, (0.0, heating), strict=True)
]
u, v = ufl.TrialFunction(space), ufl.TestFunction(space)
form = fem.form(ufl.inner(ufl.grad(u), ufl.grad(v)) * ufl.dx)
matrix = fem.assemble_matrix(form, bcs=fixed)
load = fem.Function(space).x.array  # no sources
fem.apply_lifting(load, [form], [fixed])
for condition in fixed:
    condition.set(load)
temperature = spsolve(matrix.to_scipy().tocsc(), load)  # K, by dof

# %% [markdown]
# ## The eigenstrain
#
# The elastic part of the deformation gradient is $F / (1 + \alpha T)$. Its energy is that of Saint Venant and
# Kirchhoff. The temperature is a function on the mesh of the simulation. It is zero while the energy is checked.

# %%
fields = {}


def heated(mu, lmbda, mesh):
    """Return the energy; `mesh` is that of the simulation."""
    fields["T"] = fem.Function(fem.functionspace(mesh, ("Lagrange", 1)))

    class Heated:
        def psi(self, F):
            elastic = F / (1 + expansion * fields["T"])
            E = (elastic.T * elastic - ufl.Identity(3)) / 2
            return mu * ufl.inner(E, E) + lmbda / 2 * ufl.tr(E) ** 2

    return Heated()


# %% [markdown]
# ## The plate
#
# Three components at two corners are held, so that the plate moves freely otherwise. `node_numbers` says which node
# of the plate each node of the simulation is: the temperature is copied from node to node.

# %%
corner = 1e-6  # m
study = {
    "title": "A plate heated at one end",
    "material": {"young": young, "poisson": poisson, "density": 1000.0},
    "boundary": [
        {"on": {"box": [[-corner, -corner], [corner, corner]]}, "fix": "xy"},
        {"on": {"box": [[length - corner, -corner], [length + corner, corner]]}, "fix": "y"},
    ],
    "time": {"scheme": "quasi-static", "step": 1.0, "end": 1.0},
}
dofs = cKDTree(space.tabulate_dof_coordinates()).query(plate.geometry.x)[1]  # of the nodes of the plate
by_number = np.empty(len(dofs))
by_number[plate.geometry.input_global_indices] = temperature[dofs]

with fracsim.Simulation(study, mesh=plate, energy=heated) as simulation:
    fields["T"].x.array[:] = by_number[simulation.node_numbers]
    row = simulation.step()
    displacement = simulation.displacement
    x, y = displacement.function_space.tabulate_dof_coordinates()[:, :2].T  # m
    found = displacement.x.array.reshape(-1, 2)  # m

# %% [markdown]
# ## The closed form
#
# A temperature that is linear in $x$, $T = g x$, leaves a free plate without stress in its plane. In plane strain the
# strain is $\varepsilon_x = \varepsilon_y = a x$ with $a = (1 + \nu) \alpha g$, which is the displacement $u_x = a
# (x^2 - y^2) / 2$, $u_y = a x y$ (S. P. Timoshenko and J. N. Goodier, Theory of elasticity, 1951, chapter 14). The
# plate bends, though nothing bends it. The support at the lower right corner does not alter it, since $u_y = 0$ at $y
# = 0$.
#
# The stress $\sigma_z = - E \alpha T$ that keeps the plate from growing in thickness is left. Its energy is $\int
# \frac{1}{2} E (\alpha T)^2 \mathrm{d}V = \frac{1}{6} E (\alpha g)^2 l^3 h$ for a thickness of 1 m.

# %%
a = (1 + poisson) * expansion * heating / length  # 1/m
exact = np.stack([a * (x**2 - y**2) / 2, a * x * y], axis=1)
error = np.abs(found - exact).max() / np.abs(exact).max()
print(f"largest error of the displacement: {error:.1e} of its largest value")
exact_energy = young * (expansion * heating) ** 2 * length * height / 6  # J
print(f"elastic energy: {row['elastic']:.4f} J, closed form {exact_energy:.4f} J")

# %% [markdown]
# ## A picture

# %%
import matplotlib.pyplot as plt

figure, axes = plt.subplots()
enlarged = np.stack([x, y], axis=1) + 100 * found
drawn = axes.scatter(*enlarged.T, c=by_number[simulation.node_numbers])
axes.set(aspect="equal", title="displacement 100 times as large, temperature / K")
figure.colorbar(drawn)
