"""The study file: its tables, their defaults, units and limits (SI throughout). No DOLFINx here.

body            [mesh], [material], [damping]
breaking        [fracture], [plasticity], [brittle]
loading         [[boundary]], [load], [initial]
touching        [[obstacle]], [contact]
moving          [[body]], and what rigid studies may say
running         [time], [[probe]], [output]
solver_options  [solver]
whole           a study, and what its tables ask of one another
values          what a key may hold
file            a study read by path or name, overridden, and written with every default
explain         what is wrong, in one sentence
check           `fracsim check`
at_start        whether the body and obstacles overlap at the start
lengths         whether strength, energy, mesh and body fit together
units           questions about figures that look like those of other units
steps           how many time steps there are, and how long stable ones are
resultants      areas and resultants of loads
mesh_source     from [mesh] to arrays
catalogue       `fracsim list`
materials       materials by name, and where their values come from
"""

from .body import Damping, Elastic, Material, Mesh, Region
from .breaking import Brittle, Crack, Fibre, Fracture, Grains, Heterogeneity, Plasticity
from .loading import CONDITIONS, MOTIONS, Boundary, Box, Initial, Load, Plane
from .moving import Body
from .running import FIELDS, Output, Probe, Time
from .touching import Contact, Hinge, Obstacle
from .values import Table, TimeTable
from .whole import Study

__all__ = [
    "CONDITIONS", "FIELDS", "MOTIONS", "Body", "Boundary", "Box", "Brittle", "Contact", "Crack", "Damping", "Elastic",
    "Fibre",
    "Fracture", "Grains", "Heterogeneity", "Hinge", "Initial", "Load", "Material", "Mesh", "Obstacle", "Output",
    "Plane", "Plasticity", "Probe", "Region", "Study", "Table", "Time", "TimeTable",
]  # fmt: skip
