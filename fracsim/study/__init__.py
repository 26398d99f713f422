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

from .body import DampingSettings, ElasticSettings, MaterialSettings, MeshSettings, RegionSettings
from .boundary_conditions import (
    CONDITIONS,
    MOTIONS,
    BoundarySettings,
    BoxSelector,
    InitialSettings,
    LoadSettings,
    PlaneSelector,
)
from .contact import ContactSettings, HingeSettings, ObstacleSettings
from .fracture import (
    BrittleSettings,
    CrackSettings,
    FibreSettings,
    FractureSettings,
    GrainSettings,
    HeterogeneitySettings,
    PlasticitySettings,
)
from .rigid_bodies import BodySettings
from .study import Study
from .time_and_output import FIELDS, ColourSettings, OutputSettings, ProbeSettings, TimeSettings
from .values import StudyTable, TimeTable

__all__ = [
    "CONDITIONS", "FIELDS", "MOTIONS", "BodySettings", "BoundarySettings", "BoxSelector", "BrittleSettings",
    "ColourSettings", "ContactSettings", "CrackSettings", "DampingSettings", "ElasticSettings", "FibreSettings",
    "FractureSettings", "GrainSettings", "HeterogeneitySettings", "HingeSettings", "InitialSettings", "LoadSettings",
    "MaterialSettings", "MeshSettings", "ObstacleSettings", "OutputSettings", "PlaneSelector", "PlasticitySettings",
    "ProbeSettings", "RegionSettings", "Study", "StudyTable", "TimeSettings", "TimeTable",
]  # fmt: skip
