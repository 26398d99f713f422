"""The study file: its tables, their defaults, units and limits (SI throughout). No DOLFINx here.

body                 [mesh], [material], [damping]
fracture             [fracture], [plasticity], [brittle]
boundary_conditions  [[boundary]], [load], [initial]
contact              [[obstacle]], [contact]
rigid_bodies         [[body]], and what rigid studies may say
time_and_output      [time], [[probe]], [output]
solver_options       [solver]
study                a study, and what its tables ask of one another
values               what a key may hold
reader               a study read by path or name, overridden, and written with every default
error_messages       what is wrong, in one sentence
check                `fracsim check`
overlap_checks       whether the body and obstacles overlap at the start
length_checks        whether strength, energy, mesh and body fit together
unit_checks          questions about figures that look like those of other units
step_checks          how many time steps there are, and how long stable ones are
load_resultants      areas and resultants of loads
mesh_source          from [mesh] to arrays
catalogue            `fracsim list`
material_library     materials by name, and where their values come from
"""

from .body import Damping, Elastic, Material, Mesh, Region
from .boundary_conditions import CONDITIONS, MOTIONS, Boundary, Box, Initial, Load, Plane
from .contact import Contact, Hinge, Obstacle
from .fracture import Brittle, Crack, Fibre, Fracture, Grains, Heterogeneity, Plasticity
from .rigid_bodies import Body
from .study import Study
from .time_and_output import FIELDS, Output, Probe, Time
from .values import Table, TimeTable

__all__ = [
    "CONDITIONS", "FIELDS", "MOTIONS", "Body", "Boundary", "Box", "Brittle", "Contact", "Crack", "Damping", "Elastic",
    "Fibre",
    "Fracture", "Grains", "Heterogeneity", "Hinge", "Initial", "Load", "Material", "Mesh", "Obstacle", "Output",
    "Plane", "Plasticity", "Probe", "Region", "Study", "Table", "Time", "TimeTable",
]  # fmt: skip
