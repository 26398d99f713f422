"""[fracture], [plasticity] and [brittle]: how the body breaks and flows."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, field_validator, model_validator

from .values import Finite, Flag, NonNegative, Positive, Seed, Strength, StudyTable, Unbounded, Vector


class HeterogeneitySettings(StudyTable):
    """Scatter of the strength from edge to edge, Weibull-distributed with mean 1; the same at any number of ranks."""

    modulus: Annotated[Finite, Field(ge=0.1)]  # Weibull's m: 5 scatters like stone, 50 hardly at all
    seed: Seed = 0


class FibreSettings(StudyTable):
    """Strength that depends on direction: `ratio` times as high along the fibre as across it."""

    direction: Vector
    ratio: Positive = 1.0

    @field_validator("direction")
    @classmethod
    def _has_a_direction(cls, direction: list[float]) -> list[float]:
        if not any(direction):
            raise ValueError("a direction must not be zero")
        return direction


class FractureSettings(StudyTable):
    """[fracture]: edges break where the averaged normal stress along them reaches `strength`."""

    strength: Strength
    energy: Positive | None = None  # G_c, J/m^2: cracks advance where they release it; None: edges break one by one
    # with energy: a tip goes by the energy that it releases; or cracks hold on while they open (l_ch >= 8 h: concrete)
    law: Literal["griffith", "cohesive"] = "griffith"
    branching: Flag = False  # with energy, in the plane, with inertia: up to c_R / 2, and two where 2 G_c flows
    approach: Literal["chi", "edge"] = "chi"  # degraded energy; edge-projected strain (linear and corotated)
    radius: NonNegative = 0.0  # m, of the non-local average; 0: local
    # neighbours: no radius, one average over the cells that share a node
    kernel: Literal["linear", "constant", "gaussian", "neighbours"] = "linear"
    tie_break: Annotated[Finite, Field(ge=0, lt=0.1)] = 1e-6  # relative perturbation of the strength of each edge
    unilateral: Flag = False  # a broken edge shorter than at rest carries pressure: cracks close
    # most times that a step is solved and broken; default: 1, in quasi-static studies until nothing changes
    passes: Annotated[int, Field(ge=1, strict=True)] | None = None
    cap: Annotated[Finite, Field(gt=0, le=1)] | None = None  # share of all edges that may break in one pass
    crumbs: Flag = True  # false: a node that would lose its last whole cell stays with the neighbours that hold it best
    heterogeneity: HeterogeneitySettings | None = None
    fibre: FibreSettings | None = None

    def retains_nodes(self, energy: str) -> bool:
        """Whether nodes without a whole cell stay joined. Not with crumbs, nor where cells are turned back before their
        strain is projected: what hangs on one edge is held along it alone, has no rotation, and steps fail."""
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
    """All of the body's section with a plane (2D: a line)."""

    point: Vector
    normal: Vector


class CrackSettings(StudyTable):
    """[[crack]]: broken before the start, with the places of its cuts. Give exactly one of the three."""

    segment: Annotated[list[Vector], Field(min_length=2, max_length=2)] | None = None  # m, 2D
    polygon: Annotated[list[Vector], Field(min_length=3)] | None = None  # m, 3D, flat
    plane: CrackPlaneSettings | None = None

    @model_validator(mode="after")
    def _one_shape(self) -> CrackSettings:
        given = [key for key in ("segment", "polygon", "plane") if getattr(self, key) is not None]
        if len(given) != 1:
            raise ValueError(f"give exactly one of segment, polygon, plane; found {' and '.join(given) or 'none'}")
        return self


class PlasticitySettings(StudyTable):
    """[plasticity]: cells flow where their stress exceeds the yield stress; F = F_e F_p with det F_p = 1.

    Rigid bodies have yield_stress and hardening alone, see rigid.denting.
    """

    yield_stress: Strength  # Pa, of the Cauchy stress
    measure: Literal["von-mises", "frobenius"] = "von-mises"  # what is compared with it; the latter counts pressure too
    flow_rate: Unbounded = float("inf")  # 1/s; inf: independent of the rate
    hardening: Finite = 0.0  # K in Pa: what yield_stress gains with accumulated plastic strain; < 0 softens
    # what a step is solved with: the flow of the step before; its own; none, flow follows it (small steps)
    update: Literal["extrapolated", "implicit", "staggered"] = "extrapolated"


class GrainSettings(StudyTable):
    """Grain boundaries: regions of seeded points p_i by least k_i |x - p_i|, the same at any number of ranks."""

    count: Annotated[int, Field(ge=2, le=1_000_000, strict=True)]
    seed: Seed = 0
    spread: Annotated[Finite, Field(ge=0, lt=1)] = 0.0  # k_i from 1 - spread to 1 + spread; 0: all grains alike
    mode: Literal["replace", "bias"] = "replace"  # a surface frees a grain; or runs along the boundaries nearest to it


class BrittleSettings(StudyTable):
    """[brittle]: instead of single edges, surfaces from the cells of highest averaged principal stress break."""

    surfaces: Annotated[int, Field(ge=1, strict=True)]  # most of the run, of each rigid body: more, more debris
    spacing: Positive | None = None  # m between places where surfaces start; default: about two mesh edges
    shape: Literal["planar", "curved"] = "planar"  # curved: turns with the principal direction
    seed: Seed = 0  # of the direction where several principal stresses are equal
    per_pass: Annotated[int, Field(ge=1, strict=True)] | None = None  # most that start in one pass; default: no limit
    grains: GrainSettings | None = None

    @model_validator(mode="after")
    def _grains_have_their_shape(self) -> BrittleSettings:
        if self.grains is not None and self.grains.mode == "replace" and self.shape == "curved":
            raise ValueError(
                'shape = "curved" does nothing where grains.mode = "replace": surfaces are grain boundaries; '
                'remove shape, or set grains.mode = "bias"'
            )
        return self
