"""The study file: its tables, their defaults, units and limits (SI throughout). No DOLFINx here."""

from .body import Damping, Elastic, Material, Mesh, Region
from .breaking import Brittle, Fibre, Fracture, Grains, Heterogeneity, Plasticity
from .loading import CONDITIONS, MOTIONS, Boundary, Box, Initial, Load, Plane
from .running import FIELDS, Output, Probe, Time
from .values import Table, TimeTable
from .whole import Study

__all__ = [
    "CONDITIONS", "FIELDS", "MOTIONS", "Boundary", "Box", "Brittle", "Damping", "Elastic", "Fibre", "Fracture",
    "Grains", "Heterogeneity", "Initial", "Load", "Material", "Mesh", "Output", "Plane", "Plasticity", "Probe",
    "Region", "Study", "Table", "Time", "TimeTable",
]  # fmt: skip
