"""Thresholds of `fracsim check`: above or below which values it prints a note, asks a question or refuses a study."""

from __future__ import annotations

from dataclasses import dataclass, field

ByDimension = dict[int, float]  # values for 2D and 3D


@dataclass(frozen=True)
class CheckLimits:
    """Thresholds of all checks. None of them changes a result.

    Attributes:
        max_built_cells: a builder's mesh is built for resultants and overlaps up to this size; a few seconds.
        max_sampled_cells: cells of a large mesh whose edges are measured.
        max_expected_cells: cells without a question.
        bytes_per_cell: memory on all ranks, with fracture and without contact.
        max_bodies: rigid bodies that fit into memory.
        max_edge_direction_ratio: edges near the commonest directions over those of a mesh without preferred
            directions; random points have 1.1 to 3.7.
        min_direction_nodes: nodes below which that ratio is not significant.
        min_facet_ratio: facets of a surface over cells^((d-1)/d): 2.3 to 4 for the 2D builders; 2.8 to 4.8 in 3D, 10 to
            12 for a thin plate and the vase.
        tip_radius: radius of the domain of a crack tip, in h (`fracture.energy.tip_criterion`, whose import is slow).
        tip_clearance: distance of a tip from boundaries and other tips, in h.
        min_zone_cells: Irwin's length in h from which cells resolve the process zone.
        min_start_cells: L of the critical distance in h from which cells resolve the stress ahead of a notch.
        min_zone_share: times that Irwin's length fits into the body, below which the process zone has no space.
        max_energy_ratio: factor between the energy of single edges and that of the material without a note.
        max_small_strain: strain at the strength below which large strains do not matter.
        max_linear_rotation: rotation of a fragment in rad from which its swelling by 1/cos is visible: half a percent.
        max_linear_poisson: Poisson's ratio from which linear cells lock: with four across, a beam is a third too stiff.
        max_strength_share: strength over Young's modulus; only rubber is stronger.
        min_radius_share: radius of the average over h, below which a cell has itself alone.
        max_side, min_side: side lengths in m of bodies that break as one, and of a continuum.
        soft_young, soft_density: Pa and kg/m^3; rubber and gels are softer, and not as dense.
        min_density, max_density: kg/m^3 of foams, and of the densest metals.
        metal_density, metal_young: kg/m^3 and Pa; a metal whose density is in g/cm^3 is below the first and above the
            second.
        min_sound_speed, max_sound_speed: m/s; a few m/s in gels, 1.8e4 in diamond.
        min_strength_share: strength over Young's modulus; 1e-4 for concrete and stone.
        min_irwin_length: m, a few atoms.
        max_gravity: m/s^2.
        max_wave_passes: times that a wave passes an edge in a step, from which second-order schemes may gain energy.
        max_steps: explicit steps without a note.
        stable_share_random, stable_share_lattice: stable step over the time of a wave through the finest cells of size
            h, for meshes that are not built: 0.36 to 0.39 and 0.12 to 0.14 for random points, 0.63 and 0.48 for
            lattices.
        quadratic_frequency_factor: replaces d + 1 with quadratic displacement
            (`timestepping.stable_time_step.quadratic_gain`, whose import is slow).
        overlap_round_off: overlap of body and obstacle over the size of the body that counts as contact.
        min_inside_coordinate: least barycentric coordinate of a point inside a cell; bodies may touch.
        max_rigid_overlap: overlap of a rigid body and an obstacle over the mean edge, as convex parts may have in a
            run.
        max_shell_triangles: triangles of all rigid shells that touch as such; the search for their contacts takes some
            10 s to set up, as a study begins and where a shell breaks.
        max_overlap_pairs: pairs of cells and points that are compared at once.
    """

    max_built_cells: int = 60_000
    max_sampled_cells: int = 50_000
    max_expected_cells: int = 5_000_000
    bytes_per_cell: float = 2.5e3
    max_bodies: int = 100_000
    max_edge_direction_ratio: float = 4.0
    min_direction_nodes: ByDimension = field(default_factory=lambda: {2: 100, 3: 1000})
    min_facet_ratio: ByDimension = field(default_factory=lambda: {2: 2.3, 3: 2.8})
    tip_radius: float = 5.0
    tip_clearance: float = 6.0
    min_zone_cells: float = 8.0
    min_start_cells: float = 2.5
    min_zone_share: float = 5.0
    max_energy_ratio: float = 3.0
    max_small_strain: float = 0.005
    max_linear_rotation: float = 0.1
    max_linear_poisson: float = 0.49
    max_strength_share: float = 0.1
    max_side: float = 20.0
    min_radius_share: float = 0.3
    min_side: float = 1e-6
    soft_young: float = 1e6
    soft_density: float = 1600.0
    min_density: float = 12.0
    max_density: float = 3e4
    metal_density: float = 25.0
    metal_young: float = 1e8
    min_sound_speed: float = 1.0
    max_sound_speed: float = 2e4
    min_strength_share: float = 1e-6
    min_irwin_length: float = 1e-9
    max_gravity: float = 1000.0
    max_wave_passes: float = 2.0
    max_steps: float = 1e6
    stable_share_random: ByDimension = field(default_factory=lambda: {2: 0.37, 3: 0.13})
    stable_share_lattice: ByDimension = field(default_factory=lambda: {2: 0.63, 3: 0.48})
    quadratic_frequency_factor: ByDimension = field(default_factory=lambda: {2: 20.06, 3: 25.75})
    overlap_round_off: float = 1e-9
    min_inside_coordinate: float = 1e-6
    max_rigid_overlap: float = 0.05
    max_shell_triangles: int = 200_000
    max_overlap_pairs: int = 1 << 21


LIMITS = CheckLimits()
