"""Schema of [fracture], [[crack]], [plasticity] and [brittle]."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, field_validator, model_validator

from .plugins import or_plugin
from .values import Finite, Flag, NonNegative, Positive, Seed, Strength, StudyTable, Unbounded, Vector, key


class HeterogeneitySettings(StudyTable):
    """Weibull distribution of the strength of edges with mean 1. It does not depend on the number of ranks."""

    modulus: Annotated[Finite, Field(ge=0.1)] = key(
        "Weibull modulus: 5 scatters like stone, 50 hardly at all.", example=8.0
    )
    seed: Seed = key("Seed of the random numbers.", default=0, example=1)


class FibreSettings(StudyTable):
    """Strength that depends on the direction of an edge."""

    direction: Vector = key("Direction of the fibres, of any length.", example=[1.0, 0.0, 0.0])
    ratio: Positive = key("Strength along the fibres over strength across them.", default=1.0, example=2.0)

    @field_validator("direction")
    @classmethod
    def _is_not_zero(cls, direction: list[float]) -> list[float]:
        if not any(direction):
            raise ValueError("a direction must not be zero")
        return direction


class FractureSettings(StudyTable):
    """Criterion of fracture and degradation.

    Without `energy` an edge breaks when its averaged normal stress reaches `strength`; with it, cracks advance when
    they release the fracture energy.
    """

    strength: Strength = key("Normal stress at which an edge breaks; inf: it never breaks.", "Pa", example=3e4)
    energy: Positive | None = key(
        "Fracture energy G_c. true takes that of `material.like` "
        "([cracks](fracture.md#cracks-with-a-fracture-energy)).",
        "J/m^2", default=None, example=20.0, otherwise="edges break one by one",
    )  # fmt: skip
    criterion: Annotated[Literal["normal-stress"], or_plugin("criteria")] = key(
        "Load of an edge without `energy`: its normal stress over its strength, or the name of a "
        "[plug-in](python.md#plug-ins).",
        default="normal-stress", example="normal-stress",
    )  # fmt: skip
    edge_law: Annotated[Literal["brittle"], or_plugin("edge_laws")] = key(
        "Integrity of an edge without `energy` as a function of its load: brittle, or the name of a "
        "[plug-in](python.md#plug-ins).",
        default="brittle", example="brittle",
    )  # fmt: skip
    law: Literal["griffith", "cohesive"] = key(
        "Law of a crack with `energy`: sharp, or cohesive with exponential softening.",
        default="griffith", example="cohesive",
    )  # fmt: skip
    branching: Flag = key(
        "Limit cracks with `energy` to half the Rayleigh speed, and branch a tip that receives 2 G_c. 2D, with "
        "inertia.",
        default=False, example=True,
    )  # fmt: skip
    approach: Literal["chi", "edge"] = key(
        "Effect of broken edges on a cell: chi multiplies its energy by the remaining share of edge stress; edge "
        "projects the strain on the intact edges (energies linear and corotated).",
        default="chi", example="edge",
    )  # fmt: skip
    radius: NonNegative = key("Radius of the non-local average of stress; 0: local.", "m", default=0.0, example=0.03)
    kernel: Literal["linear", "constant", "gaussian", "neighbours"] = key(
        "Weight of the average by distance; neighbours averages over the cells that share a node, without a radius.",
        default="linear", example="constant",
    )  # fmt: skip
    tie_break: Annotated[Finite, Field(ge=0, lt=0.1)] = key(
        "Relative change of the strength of each edge by a hash of its position, so that no two edges are equal.",
        default=1e-6, example=1e-6,
    )  # fmt: skip
    unilateral: Flag = key(
        "Crack closure: a broken edge that is shorter than at rest carries pressure.", default=False, example=True
    )
    passes: Annotated[int, Field(ge=1, strict=True)] | None = key(
        "Maximum number of times that a step is solved and evaluated for fracture.", default=None, example=10,
        otherwise="in quasi-static studies, and in implicit steps of cohesive cracks, until nothing changes; with "
        "inertia as many as a crack with `energy` needs to run as fast as a Rayleigh wave, without `energy` 1",
    )  # fmt: skip
    cap: Annotated[Finite, Field(gt=0, le=1)] | None = key(
        "Maximum share of all edges that break in one pass, in the order of their load.", default=None, example=0.01,
        otherwise="no limit",
    )  # fmt: skip
    crumbs: Flag = key(
        "Whether fragments of a single node may form. false: a node that would lose its last unsplit cell stays "
        "attached to its neighbours.",
        default=True, example=False,
    )  # fmt: skip
    heterogeneity: HeterogeneitySettings | None = key("Scatter of the strength.", default=None)
    fibre: FibreSettings | None = key("Direction of higher strength.", default=None)

    def retains_nodes(self, energy: str) -> bool:
        """Returns whether nodes without an unsplit cell stay attached to one edge, for an elastic energy of that name.

        Not for approach "edge" with the corotated energy: one edge leaves a rotation undetermined, and steps fail.
        """
        return not (self.crumbs or (self.approach == "edge" and energy == "corotated"))

    @model_validator(mode="after")
    def _neighbours_have_no_radius(self) -> FractureSettings:
        if self.kernel == "neighbours" and self.radius:
            raise ValueError(
                f'kernel = "neighbours" averages over the cells that share a node, whatever their size, and radius = '
                f"{self.radius:g} m does not matter to it: remove radius, or choose another kernel"
            )
        return self


class CrackPlaneSettings(StudyTable):
    """A plane (2D: a line) through the whole section of the body."""

    point: Vector = key("A point of the plane.", "m", example=[0.1, 0.0, 0.0])
    normal: Vector = key("Normal of the plane, of any length.", example=[1.0, 0.0, 0.0])


class CrackSettings(StudyTable):
    """An initial crack. Give exactly one of segment, polygon and plane."""

    segment: Annotated[list[Vector], Field(min_length=2, max_length=2)] | None = key(
        "End points, in a 2D mesh.", "m", default=None, example=[[0.0, 0.05], [0.1, 0.05]]
    )
    polygon: Annotated[list[Vector], Field(min_length=3)] | None = key(
        "Corners of a plane polygon, in a 3D mesh.", "m", default=None,
        example=[[0.0, 0.0, 0.05], [0.1, 0.0, 0.05], [0.1, 0.1, 0.05], [0.0, 0.1, 0.05]],
    )  # fmt: skip
    plane: CrackPlaneSettings | None = key("A plane through the whole section.", default=None)

    @model_validator(mode="after")
    def _one_shape(self) -> CrackSettings:
        present = [name for name in ("segment", "polygon", "plane") if getattr(self, name) is not None]
        if len(present) != 1:
            raise ValueError(f"give exactly one of segment, polygon, plane; found {' and '.join(present) or 'none'}")
        return self


class PlasticitySettings(StudyTable):
    """Plastic flow where the stress exceeds the yield stress, F = F_e F_p with det F_p = 1.

    Not with the energy linear, plane stress or approach edge. Rigid bodies are dented: they have yield_stress and
    hardening only.
    """

    yield_stress: Strength = key("Yield stress (Cauchy); inf: never yields.", "Pa", example=2e4)
    measure: Literal["von-mises", "frobenius"] = key(
        "Norm of stress that is compared with the yield stress; frobenius includes pressure.",
        default="von-mises", example="frobenius",
    )  # fmt: skip
    flow_rate: Unbounded = key(
        "Rate at which stress beyond yield relaxes; inf: independent of the rate.", "1/s", default=float("inf"),
        example=100.0,
    )  # fmt: skip
    hardening: Finite = key(
        "Increase of the yield stress per unit of accumulated plastic strain; negative values soften, down to 1 % of "
        "the yield stress.",
        "Pa", default=0.0, example=1e4,
    )  # fmt: skip
    update: Literal["extrapolated", "implicit", "staggered"] = key(
        "Plastic flow used in the solution of a step: extrapolated from the step before, implicit, or none.",
        default="extrapolated", example="implicit",
    )  # fmt: skip


class GrainSettings(StudyTable):
    """Grains: regions of nodes nearest to seeded points by weighted distance.

    They do not depend on the number of ranks.
    """

    count: Annotated[int, Field(ge=2, le=1_000_000, strict=True)] = key("Number of grains.", example=50)
    seed: Seed = key("Seed of the points.", default=0, example=1)
    spread: Annotated[Finite, Field(ge=0, lt=1)] = key(
        "Spread of the weights, from 1 - spread to 1 + spread; 0: equal weights.", default=0.0, example=0.2
    )
    mode: Literal["replace", "bias"] = key(
        "replace: a surface is the boundary of the grain where it starts; bias: it follows the nearest grain "
        "boundaries.",
        default="replace", example="bias",
    )  # fmt: skip
    stretch: Annotated[list[Positive], Field(min_length=2, max_length=3)] | None = key(
        "Lengths of a grain along x, y, z, relative to one another: long grains for wood.",
        default=None, example=[8, 1, 1], otherwise="equal lengths",
    )  # fmt: skip


class BrittleSettings(StudyTable):
    """Crack surfaces instead of single edges.

    They start in the cells of highest averaged principal stress and use strength, radius and kernel of [fracture].
    """

    surfaces: Annotated[int, Field(ge=1, strict=True)] = key(
        "Maximum number of surfaces in the run; of each body with rigid bodies.", example=20
    )
    spacing: Positive | None = key(
        "Minimum distance between the starts of surfaces.", "m", default=None, example=0.04, otherwise="two mesh edges"
    )
    shape: Literal["planar", "curved"] = key(
        "Planar, or curved with the principal direction.", default="planar", example="curved"
    )
    seed: Seed = key("Seed of the direction where principal stresses are equal.", default=0, example=1)
    per_pass: Annotated[int, Field(ge=1, strict=True)] | None = key(
        "Maximum number of surfaces that start in one pass.", default=None, example=3, otherwise="no limit"
    )
    grains: GrainSettings | None = key("Grain boundaries that surfaces follow.", default=None)

    @model_validator(mode="after")
    def _grains_have_their_shape(self) -> BrittleSettings:
        if self.grains is not None and self.grains.mode == "replace" and self.shape == "curved":
            raise ValueError(
                'shape = "curved" does nothing where grains.mode = "replace": surfaces are grain boundaries; '
                'remove shape, or set grains.mode = "bias"'
            )
        return self
