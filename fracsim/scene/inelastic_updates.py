"""Plastic flow and fracture of a study, which follow a step. Modules are imported only if the study needs them."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from ..mechanics.balance import Balance
from ..mechanics.stress import Stress
from ..mesh.domain import Domain
from ..study import BrittleSettings, Study
from ..study.conditions import fibre_direction, grain_stretch, initial_cracks
from ..study.length_checks import check_branching_dimension
from ..study.plugins import NO_PHYSICS, Physics, PhysicsPart
from ..timestepping.inelastic_update import NoPlasticFlow, PlasticFlowProtocol
from .terms import per_cell

Values = npt.NDArray[np.float64]

if TYPE_CHECKING:
    from ..fracture.brittle.grains import SurfaceParameters
    from ..fracture.brittle.surface_criterion import BrittleSurfaces
    from ..fracture.criterion import CellAverage, OverloadedEdges
    from ..fracture.energy.tip_criterion import AttachedTipCriterion, TipCriterion
    from ..fracture.fracture_pass import FracturePass
    from ..fracture.node_retention import CellRetention, NodeAttachment
    from ..fracture.strength import EdgeStrength
    from ..mesh.edge_graph import EdgeGraph


def build_flow(study: Study, balance: Balance) -> PlasticFlowProtocol:
    """Return the plastic flow of a study."""
    if study.plasticity is None:
        return NoPlasticFlow()
    from ..mechanics.return_mapping import ReturnMapping

    return ReturnMapping(balance.stress)


def build_fracture_pass(
    study: Study, balance: Balance, flow: PlasticFlowProtocol, physics: Physics = NO_PHYSICS
) -> FracturePass | None:
    """Return the fracture pass of a study with this plastic flow (collective); None without [fracture]."""
    if study.fracture is None:
        return None
    from ..fracture.fracture_pass import FracturePass
    from ..mesh.edge_graph import EdgeGraph

    graph = EdgeGraph(balance.domain)
    passes, is_cohesive = study.fracture.passes, study.fracture.law == "cohesive"
    # Cohesive cracks soften until the step is in balance, where steps are solved.
    if passes is None and balance.scheme.inertia and not (is_cohesive and study.time.scheme_class.implicit):
        passes = 1
    cuts = _open_initial_cracks(study, balance, graph)
    if study.fracture.energy is not None:
        fracture = _build_energy_pass(study, balance, flow, graph, passes, cuts)
    else:
        criterion = _build_criterion(study, balance.stress, graph, physics.criterion)
        attachment = _build_node_attachment(study, balance, graph, criterion.strength)
        law = None
        if physics.edge_law is not None:
            from .user_physics import user_edge_law

            law = user_edge_law(physics.edge_law)
        fracture = FracturePass(
            balance.stress, graph, criterion, law, max_passes=passes, initial_cuts=cuts, node_attachment=attachment
        )
    if (cut := fracture.criterion.cut_positions) is not None:
        balance.contact.set_cuts(lambda: graph.broken_rows(cut[:, None]))
    if cuts is not None:
        balance.edges_broke(graph.pattern)
        balance.damage_changed()
    return fracture


def _build_energy_pass(
    study: Study,
    balance: Balance,
    flow: PlasticFlowProtocol,
    graph: EdgeGraph,
    passes: int | None,
    initial_cuts: Values | None,
) -> FracturePass:
    """Return the fracture pass for cracks with a fracture energy (collective)."""
    from ..fracture.degradation import CrackClosureDegradation, Degradation, SplitCellDegradation
    from ..fracture.energy.front_advance import FrontTipCriterion
    from ..fracture.energy.hinges import HingeRelease
    from ..fracture.energy.tip_criterion import TipCriterion
    from ..fracture.energy.tip_record import TipRecord
    from ..fracture.fracture_pass import FracturePass

    assert study.fracture is not None and study.fracture.energy is not None
    check_branching_dimension(study, balance.domain.dim)
    if study.fracture.law == "cohesive":
        return _build_cohesive_pass(study, balance, graph, passes, initial_cuts)
    stress, strength = balance.stress, build_strength(study, balance.domain, graph)
    toughness = per_cell(study, balance.domain, study.fracture, "energy", "fracture_energy")
    inertia = balance.scheme.inertia
    # quasi-static cracks in 3D advance along the whole front
    has_front = balance.domain.dim == 3 and not inertia
    criterion_type: type[TipCriterion] = FrontTipCriterion if has_front else TipCriterion
    if study.fracture.branching:
        from ..fracture.energy.crack_speed import RateDependentTipCriterion

        criterion_type = RateDependentTipCriterion
    record = TipRecord()
    tips = criterion_type(stress, graph, strength, toughness, initial_cuts, record)
    if study.plasticity is not None:
        _add_elastic_zone(flow, tips, graph)
    limits_passes = inertia and study.fracture.passes is None
    passes_per_second = tips.passes_per_second() if limits_passes else None
    degradation: Degradation = SplitCellDegradation(stress, graph, tips.release_rate() if inertia else None)
    if stress.cracks_close:
        degradation = CrackClosureDegradation(degradation, stress, graph)
    criterion: TipCriterion | AttachedTipCriterion = tips
    if (attachment := _build_node_attachment(study, balance, graph, strength)) is not None:
        from ..fracture.energy.tip_criterion import AttachedTipCriterion

        criterion = AttachedTipCriterion(tips, graph, attachment)
    return FracturePass(
        stress,
        graph,
        criterion,
        max_passes=passes,
        initial_cuts=initial_cuts,
        degradation=degradation,
        passes_per_second=passes_per_second,
        tip_record=record,
        hinges=HingeRelease(graph, tips.disc_radius, attachment),
    )


def _add_elastic_zone(flow: PlasticFlowProtocol, tips: TipCriterion, graph: EdgeGraph) -> None:
    """Let the body stay elastic around its crack tips (collective)."""
    from ..fracture.energy.critical_distance import ElasticZone
    from ..mechanics.return_mapping import ReturnMapping

    assert isinstance(flow, ReturnMapping)
    flow.elastic_zone = ElasticZone(tips, graph, flow.plastic)


def _build_cohesive_pass(
    study: Study, balance: Balance, graph: EdgeGraph, passes: int | None, initial_cuts: Values | None
) -> FracturePass:
    """Return the fracture pass for cohesive cracks (collective)."""
    from ..fracture.cohesive_cracks import CohesiveFracturePass, CohesiveSoftening, CohesiveTipCriterion
    from ..mesh.edge_graph import EdgeGraph

    assert study.fracture is not None
    # edges that cracks cut, beside those of `graph`, which have separated entirely
    stress, cut_graph = balance.stress, EdgeGraph(balance.domain)
    strength = build_strength(study, balance.domain, cut_graph)
    toughness = per_cell(study, balance.domain, study.fracture, "energy", "fracture_energy")
    tips = CohesiveTipCriterion(stress, cut_graph, strength, toughness, initial_cuts)
    softening = CohesiveSoftening(stress, cut_graph, strength, toughness, tips.cut_positions)
    return CohesiveFracturePass(
        stress,
        graph,
        cut_graph,
        tips,
        softening,
        max_passes=passes,
        initial_cuts=initial_cuts,
        has_inertia=balance.scheme.inertia,
    )


def _open_initial_cracks(study: Study, balance: Balance, graph: EdgeGraph) -> Values | None:
    """Break the edges of [[crack]]; return where they are cut (collective), None without initial cracks."""
    if not study.crack:
        return None
    from ..fracture.initial_cracks import open_initial_cracks

    # The load of a cohesive crack depends on the length of its ligament, of which a tip has no measure.
    is_cohesive = study.fracture is not None and study.fracture.law == "cohesive"
    cracks = initial_cracks(study, balance.domain.dim)
    return open_initial_cracks(graph, cracks, keep_connected=not balance.scheme.inertia, to_nearest=is_cohesive)


def _build_criterion(
    study: Study, stress: Stress, graph: EdgeGraph, criterion: PhysicsPart | None
) -> OverloadedEdges | CellRetention | BrittleSurfaces:
    """Return the criterion that selects edges (collective)."""
    from ..fracture.criterion import OverloadedEdges

    assert study.fracture is not None
    strength, average = build_strength(study, stress.domain, graph), build_average(study, stress.domain)
    if study.brittle is None:
        if criterion is None:
            failing = OverloadedEdges(stress, graph, strength, average, study.fracture.cap)
        else:
            from ..fracture.criterion import UserCriterion
            from .user_physics import user_criterion

            load = user_criterion(criterion, stress.domain.dim)
            failing = UserCriterion(load, stress, graph, strength, average, study.fracture.cap)
        if study.fracture.crumbs:
            return failing
        from ..fracture.node_retention import CellRetention

        return CellRetention(failing, stress, graph)
    from ..fracture.brittle.surface_criterion import BrittleSurfaces

    return BrittleSurfaces(stress, graph, strength, average, build_surface_parameters(study.brittle, graph.domain.dim))


def _build_node_attachment(
    study: Study, balance: Balance, graph: EdgeGraph, strength: EdgeStrength
) -> NodeAttachment | None:
    """Return what keeps nodes without an unsplit cell attached (collective); None if they are released."""
    table = study.fracture
    assert table is not None
    if not table.retains_nodes(study.material.energy):
        return None
    from ..fracture.node_retention import NodeAttachment

    return NodeAttachment(
        balance.stress, graph, strength, balance.motion.prescribed_nodes, cracks=table.energy is not None
    )


def build_average(study: Study, domain: Domain) -> CellAverage | None:
    """Return the average of the stress (collective); None for the local stress."""
    table = study.fracture
    if table is None:
        return None
    if table.kernel == "neighbours":
        from ..fracture.nonlocal_average import NeighbourAverage

        return NeighbourAverage(domain)
    if not table.radius:
        return None
    from ..fracture.nonlocal_average import NonlocalAverage

    return NonlocalAverage(domain, table.radius, table.kernel)


def build_strength(study: Study, domain: Domain, graph: EdgeGraph, instance: int = 0) -> EdgeStrength:
    """Return the strength of edges, with regions, scatter and fibres (collective).

    `instance`: number of an instance of the mesh, which has a scatter of its own.
    """
    from ..fracture.strength import EdgeStrength, FibreAnisotropy, WeibullScatter

    table = study.fracture
    assert table is not None
    scatter = None
    if (weibull := table.heterogeneity) is not None:
        scatter = WeibullScatter(weibull.modulus, weibull.seed + instance)
    direction = fibre_direction(study, domain.dim)
    fibre = FibreAnisotropy(direction, table.fibre.ratio) if direction is not None and table.fibre is not None else None
    of_cell = per_cell(study, domain, table, "strength")
    return EdgeStrength(graph, of_cell, tie_break=table.tie_break, scatter=scatter, fibre=fibre)


def build_surface_parameters(table: BrittleSettings, dim: int, instance: int = 0) -> SurfaceParameters:
    """Return the parameters of [brittle]; `instance`: number of an instance of the mesh, which has seeds of its own."""
    from ..fracture.brittle.grains import GrainParameters, SurfaceParameters

    grains = None
    if (entry := table.grains) is not None:
        stretch = grain_stretch(table, dim)
        grains = GrainParameters(entry.count, entry.seed + instance, entry.spread, entry.mode, stretch)
    curved = table.shape == "curved"
    return SurfaceParameters(table.surfaces, table.spacing, curved, table.seed + instance, table.per_pass, grains)
