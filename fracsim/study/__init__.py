"""Schema of the study file and checks without DOLFINx. SI units throughout.

=====================  ====================================================================
body                   schema of [mesh], [material], [damping]
fracture               schema of [fracture], [[crack]], [plasticity], [brittle]
boundary_conditions    schema of [[boundary]], [load], [initial], and selectors
contact                schema of [[obstacle]], [contact]
rigid_bodies           schema of [[body]], and the limits of rigid studies
time_and_output        schema of [time], [[probe]], [output]
solver_options         schema of [solver]
study                  schema of a whole study
table_checks           conditions between the tables of a study
values                 types of values, and the documentation of a key
material_library       named materials with their sources
documentation          docs/study-file.md and the JSON schema of study files, for editors
reader                 read a study by path or name, override values, write all defaults
error_messages         errors of validation as sentences
conditions             boundary conditions, loads, obstacles and cracks for a dimension
mesh_source            from [mesh] to arrays
quadratic_checks       limits of quadratic displacement, and its curved cells
check                  validation of a study against its mesh
mesh_summary           size, extent and groups of a mesh, before it is built if possible
check_report           lines of `fracsim check`, and questions on values of another unit
check_limits           thresholds of its notes and questions
length_checks          strength, fracture energy, cell size and body against each other
step_checks            number and stability of time steps
load_resultants        areas and resultants of loads
overlap_checks         overlap of body and obstacles at the start
catalogue              contents of `fracsim list`
=====================  ====================================================================
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
