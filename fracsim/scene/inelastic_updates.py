"""What happens to the body of a study at the end of a step: it flows, then it breaks. Nothing is imported in vain."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from ..mechanics.balance import Balance
from ..mechanics.stress import Stress
from ..mesh.domain import Domain
from ..study import BrittleSettings, Study
from ..study.conditions import fibre_direction, initial_cracks
from ..study.length_checks import check_branching_dimension
from ..timestepping.protocols import NoPlasticFlow, PlasticFlowProtocol
from .material_model import per_cell

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
    """What flows."""
    if study.plasticity is None:
        return NoPlasticFlow()
    from ..mechanics.return_mapping import ReturnMapping

    return ReturnMapping(balance.stress)


def build_breaking(study: Study, balance: Balance) -> FracturePass | None:
    """What breaks; None without [fracture]."""
    if study.fracture is None:
        return None
    from ..fracture.fracture_pass import FracturePass
    from ..mesh.edge_graph import EdgeGraph

    graph = EdgeGraph(balance.domain)
    passes = study.fracture.passes
    if passes is None and balance.scheme.inertia:
        passes = 1
    opened = _opened(study, balance, graph)
    if study.fracture.energy is not None:
        breaking = _tearing(study, balance, graph, passes, opened)
    else:
        criterion = _criterion(study, balance.stress, graph)
        joining = _joining(study, balance, graph, criterion.strength)
        breaking = FracturePass(
            balance.stress, graph, criterion, max_passes=passes, initial_cuts=opened, node_attachment=joining
        )
    if (cut := breaking.criterion.cut_positions) is not None:  # of a surface, or of a crack
        balance.contact.set_cuts(lambda: graph.gather_broken(cut[:, None]))
    if opened is not None:
        balance.edges_broke(graph.pattern)
        balance.damage_changed()
    return breaking


def _tearing(
    study: Study, balance: Balance, graph: EdgeGraph, passes: int | None, opened: Values | None
) -> FracturePass:
    """What breaks where cracks take an energy."""
    from ..fracture.degradation import CrackClosureDegradation, Degradation, SplitCellDegradation
    from ..fracture.energy.front_advance import FrontTipCriterion
    from ..fracture.energy.tip_criterion import TipCriterion
    from ..fracture.fracture_pass import FracturePass

    assert study.fracture is not None and study.fracture.energy is not None
    check_branching_dimension(study, balance.domain.dim)
    if study.fracture.law == "cohesive":
        return _cohesive(study, balance, graph, passes, opened)
    stress, strength = balance.stress, build_strength(study, balance.domain, graph)
    toughness = per_cell(study, balance.domain, study.fracture, "energy", "fracture_energy")
    given, moves = study.fracture.passes is not None, balance.scheme.inertia
    rows = balance.domain.dim == 3 and not moves
    criterion_type: type[TipCriterion] = FrontTipCriterion if rows else TipCriterion
    if study.fracture.branching:
        from ..fracture.energy.crack_speed import RateDependentTipCriterion

        criterion_type = RateDependentTipCriterion
    tips = criterion_type(stress, graph, strength, toughness, opened)
    pace = tips.passes_per_second() if moves and not given else None
    splitting: Degradation = SplitCellDegradation(stress, graph, tips.release_rate() if moves else None)
    if stress.cracks_close:
        splitting = CrackClosureDegradation(splitting, stress, graph)
    criterion: TipCriterion | AttachedTipCriterion = tips
    if (joining := _joining(study, balance, graph, strength)) is not None:
        from ..fracture.energy.tip_criterion import AttachedTipCriterion

        criterion = AttachedTipCriterion(tips, graph, joining)
    return FracturePass(
        stress, graph, criterion, max_passes=passes, initial_cuts=opened, degradation=splitting, passes_per_second=pace
    )


def _cohesive(
    study: Study, balance: Balance, graph: EdgeGraph, passes: int | None, opened: Values | None
) -> FracturePass:
    """What breaks where cracks hold on while they open."""
    from ..fracture.cohesive_cracks import CohesiveFracturePass, CohesiveSoftening, CohesiveTipCriterion
    from ..mesh.edge_graph import EdgeGraph

    assert study.fracture is not None
    stress, cuts = balance.stress, EdgeGraph(balance.domain)
    strength = build_strength(study, balance.domain, cuts)
    toughness = per_cell(study, balance.domain, study.fracture, "energy", "fracture_energy")
    tips = CohesiveTipCriterion(stress, cuts, strength, toughness, opened)
    softening = CohesiveSoftening(stress, cuts, strength, toughness, tips.cut_positions)
    return CohesiveFracturePass(stress, graph, cuts, tips, softening, max_passes=passes, initial_cuts=opened)


def _opened(study: Study, balance: Balance, graph: EdgeGraph) -> Values | None:
    """[[crack]]: break its edges; where they are cut, None without any."""
    if not study.crack:
        return None
    from ..fracture.initial_cracks import open_initial_cracks

    return open_initial_cracks(
        graph, initial_cracks(study, balance.domain.dim), keep_connected=not balance.scheme.inertia
    )


def _criterion(study: Study, stress: Stress, graph: EdgeGraph) -> OverloadedEdges | CellRetention | BrittleSurfaces:
    """Which edges fail."""
    from ..fracture.criterion import OverloadedEdges

    assert study.fracture is not None
    strength, average = build_strength(study, stress.domain, graph), build_average(study, stress.domain)
    if study.brittle is None:
        failing = OverloadedEdges(stress, graph, strength, average, study.fracture.cap)
        if study.fracture.crumbs:
            return failing
        from ..fracture.node_retention import CellRetention

        return CellRetention(failing, stress, graph)
    from ..fracture.brittle.surface_criterion import BrittleSurfaces

    return BrittleSurfaces(stress, graph, strength, average, build_surface_rules(study.brittle))


def _joining(study: Study, balance: Balance, graph: EdgeGraph, strength: EdgeStrength) -> NodeAttachment | None:
    """What nodes without a whole cell stay joined by."""
    table = study.fracture
    assert table is not None
    if not table.retains_nodes(study.material.energy):
        return None
    from ..fracture.node_retention import NodeAttachment

    return NodeAttachment(
        balance.stress, graph, strength, balance.motion.prescribed_nodes, cracks=table.energy is not None
    )


def build_average(study: Study, domain: Domain) -> CellAverage | None:
    """The average that a study takes of its stress; None: it takes the stress as it is."""
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


def build_strength(study: Study, domain: Domain, graph: EdgeGraph, copy: int = 0) -> EdgeStrength:
    """Strength of edges by region, with scatter, another one in each `copy` of a mesh, and a fibre."""
    from ..fracture.strength import EdgeStrength, FibreAnisotropy, WeibullScatter

    table = study.fracture
    assert table is not None
    scatter = None if (given := table.heterogeneity) is None else WeibullScatter(given.modulus, given.seed + copy)
    direction = fibre_direction(study, domain.dim)
    fibre = FibreAnisotropy(direction, table.fibre.ratio) if direction is not None and table.fibre is not None else None
    of_cell = per_cell(study, domain, table, "strength")
    return EdgeStrength(graph, of_cell, tie_break=table.tie_break, scatter=scatter, fibre=fibre)


def build_surface_rules(table: BrittleSettings, copy: int = 0) -> SurfaceParameters:
    """[brittle] as numbers; seeds differ from `copy` to copy of a mesh."""
    from ..fracture.brittle.grains import GrainParameters, SurfaceParameters

    given = table.grains
    grains = None if given is None else GrainParameters(given.count, given.seed + copy, given.spread, given.mode)
    curved = table.shape == "curved"
    return SurfaceParameters(table.surfaces, table.spacing, curved, table.seed + copy, table.per_pass, grains)
