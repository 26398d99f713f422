"""Parameters of crack tips in the criterion by fracture energy (docs/theory.md#fracture-energy)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from math import radians


def _by_dimension(in_plane: float, in_space: float) -> Mapping[int, float]:
    """Return a field that is read by the dimension of the body, 2 or 3."""
    values: Mapping[int, float] = field(default_factory=lambda: {2: in_plane, 3: in_space})
    return values


@dataclass(frozen=True)
class TipParameters:
    """Lengths and thresholds of crack tips; mappings have the keys 2 and 3, for 2D and 3D.

    Lengths are in units of the local mesh size h unless a unit is given.

    Attributes:
        disc_radius: radius R of the domain of a tip: the disc, in 3D ball, over which the force on it is summed.
        kinked_radius: least radius of the part of the disc over which the force is summed, where the crack behind the
            tip is straight for less than R.
        straightness: distance from the tangent at its tip within which a crack counts as straight.
        average_radius: radius within which stress is averaged.
        mature_length: a tip is mature once a split cell lies between R and R plus this length.
        passes_per_size: fracture passes in which a crack advances by h.
        exclusion_radius: distance between tips that advance in one pass.
        near_field_mean: mean stress across a crack over the half disc of radius R ahead of its tip, in units of
            K / sqrt(2 pi R). With sigma = K / sqrt(2 pi r) cos(t/2) (1 + sin(t/2) sin(3t/2)) it is
            4/3 of (1 / pi) int cos(t/2) (1 + sin(t/2) sin(3t/2)) dt; over a half ball more, by
            9/10 of int sqrt(sin(s)) ds / 2.
        min_start_radius: least radius of the half disc ahead of a place at which a crack starts.
        max_start_radius: largest radius of that half disc, which bounds the number of cells in it.
        start_distance: distance within which a crack starts at the most loaded cell alone.
        notch_sine: mean sine of the angle between the surface around a node and its tangent plane, from which on a
            concave surface is a notch.
        branching_ratio: mean of G over G_c from which on a crack branches: there is energy for two.
        branching_angle: angle between a branch and the crack it comes from, rad. At 27 degrees short branches open
            without sliding.
        side_by_side: largest lead of a branch, in R, at which two branches advance side by side.
        max_lead: lead in R from which on the branch ahead is inactive.
        min_front_advance: least length of an advance, in R, that belongs to a crack front.
        min_surface_area: area of the body's surface in a ball, in R^2, from which on a front follows the surface.
        min_disc_radius: lower bound of R: cut polygons reach as far as a cell beyond their cell's centre.
        cell_reach: distance from the centroid of a cell within which its corners are.
        kink_length: length, times the sine of its angle, by which a kink is cut beyond its first cell. The forces at
            shorter ones are off by a third.
        front_lag: relative lack of G below G_c with which tips of a front advance with their neighbours.
        lead_distance: distance up to which a tip of a front leads its plane.
        force_round_off: relative rounding error of a sum over some thousand cells.
        tie_break: relative change of stresses by a hash, by which cells are selected; as of the strength of edges.
    """

    disc_radius: Mapping[int, float] = _by_dimension(5.0, 4.0)
    kinked_radius: Mapping[int, float] = _by_dimension(2.5, 4.0)
    straightness: float = 0.5
    average_radius: float = 3.0
    mature_length: float = 1.5
    passes_per_size: Mapping[int, float] = _by_dimension(2.5, 5.0)
    exclusion_radius: Mapping[int, float] = _by_dimension(5.0, 0.5)
    near_field_mean: Mapping[int, float] = _by_dimension(1.5605, 1.6827)
    min_start_radius: float = 3.0
    max_start_radius: Mapping[int, float] = _by_dimension(60.0, 8.0)
    start_distance: float = 2.0
    notch_sine: float = 0.01
    branching_ratio: float = 2.0
    branching_angle: float = radians(27.0)
    side_by_side: float = 0.5
    max_lead: float = 0.2
    min_front_advance: float = 0.05
    min_surface_area: float = 0.1
    min_disc_radius: float = 3.0
    cell_reach: float = 1.5
    kink_length: float = 1.5
    front_lag: float = 0.03
    lead_distance: float = 0.65
    force_round_off: float = 1e-9
    tie_break: float = 1e-6


TIP = TipParameters()
