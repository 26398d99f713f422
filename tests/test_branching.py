"""Where cracks branch: the share of tips in a disc against energy, the angle against fine elements, and a strip."""

from __future__ import annotations

from inspect import signature
from pathlib import Path
from typing import Any

import gmsh
import numpy as np
import numpy.typing as npt
import pytest
import ufl
from dolfinx import fem
from dolfinx.fem.petsc import LinearProblem
from mpi4py import MPI
from scipy.optimize import brentq

from fracsim.errors import InputError
from fracsim.fracture.energy.branching import branch_directions, release_rate, rotate
from fracsim.fracture.energy.crack_speed import RateDependentTipCriterion, relax_slowness
from fracsim.fracture.energy.cut_plane import branching_cuts, exit_cuts
from fracsim.fracture.energy.mixed_mode import kink_gain, phase_angles
from fracsim.fracture.energy.neighbour_search import NeighbourPairs
from fracsim.fracture.energy.tip_parameters import TIP
from fracsim.mesh.domain import distribute
from fracsim.scene import Scene, build_scene, build_scene_on
from fracsim.study.check import check_study
from fracsim.study.check_limits import LIMITS
from support.resumed import assert_alike, going_stopped_resumed
from support.scenes import DIRECT, each_step, make_scene, make_study, march
from support.squares import square
from support.strip import run_of_a_strip
from support.tearing import RUNS
from support.tips import criterion_of, seen, tips

try:
    from dolfinx.io.gmsh import model_to_mesh
except ImportError:  # DOLFINx 0.9
    from dolfinx.io.gmshio import model_to_mesh

Values = npt.NDArray[np.float64]

YOUNG, POISSON = 1.0, 0.3


# --- parts -----------------------------------------------------------------------------------------------------------


def test_what_each_tip_of_a_disc_takes_up() -> None:
    """g = G (t_1 + q t_2) of tips that go apart; one that comes towards the tip is left out."""
    t = rotate(np.array([[1.0, 0.0], [1.0, 0.0]]), np.array([0.4, -0.4]))
    advance = t[:1] + 0.7 * t[1:]
    np.testing.assert_allclose(release_rate(3 * advance, advance, t[:1]), 3.0)
    towards = t[:1] - 0.6 * t[:1]
    np.testing.assert_allclose(release_rate(2 * t[:1], towards, t[:1]), 2.0)


def test_tips_abreast_go_apart() -> None:
    """Each at ANGLE to the way of both, from the other, and the one that is ahead by over h = R / 5 waits; not those
    behind one another, nor those that meet, nor any that have left each other's discs."""
    ways = rotate(np.repeat([[1.0, 0.0]], 2, axis=0), np.array([0.2, -0.2]))

    def pair(apart: list[float], own: Values, other: Values) -> tuple[Values, bool]:
        vector, none = np.array([apart]), np.zeros(1, np.int64)
        both = NeighbourPairs(none, none, vector, np.linalg.norm(vector, axis=1), 1)
        way, waits = branch_directions(both, own[None], other[None], np.array([2.0]))
        return way[0], bool(waits[0])

    c, s = np.cos(TIP.branching_angle), np.sin(TIP.branching_angle)
    np.testing.assert_allclose(pair([0.1, -1.0], ways[0], ways[1])[0], [c, s])
    np.testing.assert_allclose(pair([0.1, 1.0], ways[1], ways[0])[0], [c, -s])
    assert [pair([lead, 1.0], ways[1], ways[0])[1] for lead in (0.5, -0.39, -0.41)] == [False, False, True]
    assert [pair([-0.9, apart], ways[1], ways[0])[1] for apart in (1.7, 1.9)] == [True, False]
    assert not pair([1.1, 1.0], ways[1], ways[0])[0].any()
    assert not pair([0.1, 1.0], ways[1], -ways[1])[0].any()
    assert not pair([0.0, 0.0], ways[1], ways[1])[0].any()


def test_a_cell_is_cut_in_three_where_both_ways_out_are_free() -> None:
    """A crack that comes in at the middle of a side and makes for the corner leaves by both others, at ANGLE to where
    it goes; one that makes for the middle of a side goes on as one."""
    corners = np.repeat([[[0.0, -1.0], [0.0, 1.0], [1.0, 0.0]]], 2, axis=0)
    entry, point = np.array([2, 2]), np.zeros((2, 2))  # local edges: opposite to 0, 1 and 2
    ahead = rotate(np.repeat([[1.0, 0.0]], 2, axis=0), np.array([0.1, 0.8]))
    torn, yes = np.zeros((2, 3), bool), np.ones(2, bool)
    one = exit_cuts(corners, entry, point, rotate(ahead, np.pi / 2), ahead, torn)
    cuts = branching_cuts(corners, entry, point, rotate(ahead, np.pi / 2), ahead, torn, yes)
    assert sorted(cuts.row) == [0, 0, 1] and len(set(cuts.edge[cuts.row == 0])) == 2
    assert cuts.share[cuts.row == 1] == one.share[1] and cuts.edge[cuts.row == 1] == one.edge[1]
    ends = {0: (1, 2), 1: (0, 2)}
    for edge, share in zip(cuts.edge[cuts.row == 0], cuts.share[cuts.row == 0], strict=True):
        first, second = (corners[0, k] for k in ends[int(edge)])
        place = first + share * (second - first)
        assert abs(abs(np.arctan2(place[1], place[0]) - 0.1) - TIP.branching_angle) < 1e-9
    whole = branching_cuts(corners, entry, point, rotate(ahead, np.pi / 2), ahead, torn, ~yes)
    np.testing.assert_array_equal(whole.edge, one.edge)


@pytest.mark.parametrize("rest", (0.9, 1.2, 1.5, 1.9, 3.0))
def test_how_fast_a_crack_gets(rest: float) -> None:
    """Where G* = `rest` G_c flows to a crack at rest, and (1 - v / c_R) of that to one that runs, it runs so that G_c
    is left; up to half of c_R, where 2 G_c is left of 4; in 30 times R / c_R, which count alike in large and small."""
    ends = []
    for count in (3000, 6000):
        slow = np.ones(1)
        for _ in range(count):
            slow = relax_slowness(slow, rest * slow, np.full(1, 30 / count))
        ends.append(1 - float(slow[0]))
    assert ends == pytest.approx([float(np.clip(1 - 1 / rest, 0.0, 0.5))] * 2, abs=1e-6)


# --- against energy, and fine elements -------------------------------------------------------------------------------


def forked(upper: float, lower: float, n: int = 40) -> Scene:
    """A plate of 1 m, pulled by 1 mm, cracked to its middle, with two branches of these lengths, m, at ANGLE."""
    at = np.array([0.5, 0.503])
    ends = at + rotate(np.array([[upper, 0.0], [lower, 0.0]]), np.array([TIP.branching_angle, -TIP.branching_angle]))
    study = make_study(
        material={"energy": "linear", "young": YOUNG, "poisson": POISSON, "density": 1.0},
        fracture={"strength": 1e9, "energy": 1e9},
        crack=[{"segment": [[-0.1, at[1]], at.tolist()]}, *({"segment": [at.tolist(), end.tolist()]} for end in ends)],
        boundary=[{"on": "bottom", "fix": "xy"}, {"on": "top", "displacement": [0.0, 1e-3]}],
        time={"scheme": "quasi-static", "step": 1.0, "end": 1.0},
    )  # fmt: skip
    scene = build_scene_on(distribute(MPI.COMM_SELF, square("unstructured", n)), study)
    scene.stepper.advance(scene.start())
    return scene


def test_two_tips_in_a_disc_share_its_force() -> None:
    """G of branches of 1 to 5 h is what the plate lets go as both get longer, to 15 %, of those below 3 h to 30 %. The
    force on short ones, whose discs lie over each other, is that of both."""
    rows = []
    for length in np.arange(1.0, 5.6, 0.4) / 40:
        scene = forked(length, length)
        now, reached = seen(scene), tips(scene)
        along, force = now.tips.point - now.tips.behind, now.evaluate_forces()
        released = release_rate(force, now.tips.ahead, along / np.linalg.norm(along, axis=1)[:, None])
        size = np.linalg.norm(reached - [0.5, 0.503], axis=1).sum()
        rows.append((size, scene.balance.stress.stored_energy(), released.mean(), np.linalg.norm(force, axis=1).mean()))
    size, stored, G, whole = np.array(rows).T
    taken = -np.polyval(np.polyder(np.polyfit(size, stored, 2)), size)
    np.testing.assert_allclose(G, taken, rtol=0.3)
    np.testing.assert_allclose(G[size > 6 / 40], taken[size > 6 / 40], rtol=0.15)
    assert whole[0] > 1.8 * taken[0] and whole[-1] < 1.2 * taken[-1]


def test_a_tip_that_is_ahead_waits_unless_there_is_enough_for_both() -> None:
    """It takes 2 G_c: less than that, and the branch behind, which shares its disc, is to go first."""
    scene = forked(0.05, 0.09)
    stress, graph, held = scene.balance.stress, scene.fracture.graph, criterion_of(scene)
    for share, goes in ((1.9, False), (2.1, True)):
        criterion = RateDependentTipCriterion(stress, graph, held.strength, 1.0, held.cut_positions.copy())
        found = criterion.find_tips()
        now = criterion.field_evaluator.evaluate_fields(*scene.fracture.evaluate_undamaged_stress())
        tangent = (found.point - found.behind) / np.linalg.norm(found.point - found.behind, axis=1)[:, None]
        ahead = int(np.argmax(found.point[:, 0]))
        assert found.is_inactive[ahead] and found.is_inactive.sum() == 1
        released = release_rate(now.evaluate_forces(), found.ahead, tangent) * kink_gain(
            phase_angles(now.stress_intensities()) * ~np.any(found.branch_direction, axis=1)
        )
        criterion.toughness = released[ahead] / share
        criterion(*scene.fracture.evaluate_undamaged_stress())
        assert (found.cell[ahead] in criterion.cells) == goes


def branch(angle: float, length: float = 0.02, finest: float = 5e-5) -> tuple[float, float]:
    """K_I and K_II, over that of the crack, of two short branches of a long crack under K_I.

    Quadratic elements on the upper half of a disk with the field of the crack around it; both from the opening and
    sliding along the branch, extrapolated to its tip. Shares no code with the program.
    """
    mu, kappa = YOUNG / 2 / (1 + POISSON), 3 - 4 * POISSON
    lmbda = YOUNG * POISSON / (1 + POISSON) / (1 - 2 * POISSON)
    c, s = np.cos(angle), np.sin(angle)
    gmsh.initialize()
    gmsh.option.setNumber("General.Terminal", 0)
    g = gmsh.model.geo
    below, above = (g.addPoint(0, 0, 0, length / 10) for _ in range(2))
    tip = g.addPoint(length * c, length * s, 0, finest)
    right, far, top, left = (g.addPoint(*each, 0, 0.1) for each in ((1, 0), (c, s), (0, 1), (-1, 0)))
    under, over, on, axis = (g.addLine(*each) for each in ((below, tip), (above, tip), (tip, far), (below, right)))
    arcs = [g.addCircleArc(a, below, b) for a, b in ((right, far), (far, top), (top, left))]
    side = g.addLine(left, above)
    wedge = g.addPlaneSurface([g.addCurveLoop([axis, arcs[0], -on, -under])])
    rest = g.addPlaneSurface([g.addCurveLoop([over, on, arcs[1], arcs[2], side])])
    g.synchronize()
    for dim, tags, number in ((2, [wedge, rest], 1), (1, [axis], 2), (1, arcs, 3)):
        gmsh.model.addPhysicalGroup(dim, tags, number)
    gmsh.model.mesh.generate(2)
    mesh, _, facets, *_ = model_to_mesh(gmsh.model, MPI.COMM_SELF, 0, gdim=2)
    gmsh.finalize()

    def field(x: Values) -> Values:
        r, t = np.hypot(x[0], x[1]), np.arctan2(x[1], x[0])
        cos, sin = np.cos(t / 2), np.sin(t / 2)
        return np.asarray(np.sqrt(r / 2 / np.pi) / 2 / mu * np.array(
            [cos * (kappa - 1 + 2 * sin**2), sin * (kappa + 1 - 2 * cos**2)]
        ))  # fmt: skip

    V = fem.functionspace(mesh, ("P", 2, (2,)))
    outer = fem.Function(V)
    outer.interpolate(field)
    across, _ = V.sub(1).collapse()
    held = fem.locate_dofs_topological((V.sub(1), across), 1, facets.find(2))
    conditions = [
        fem.dirichletbc(outer, fem.locate_dofs_topological(V, 1, facets.find(3))),
        fem.dirichletbc(fem.Function(across), held, V.sub(1)),
    ]

    def strain(w: Any) -> Any:
        return ufl.sym(ufl.grad(w))

    u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
    stress = 2 * mu * strain(u) + lmbda * ufl.tr(strain(u)) * ufl.Identity(2)
    nothing = ufl.inner(fem.Constant(mesh, (0.0, 0.0)), v) * ufl.dx
    options: dict[str, Any] = {"petsc_options": {"ksp_type": "preonly", "pc_type": "lu"}}
    if "petsc_options_prefix" in signature(LinearProblem).parameters:  # not in DOLFINx 0.9
        options["petsc_options_prefix"] = "branch_"
    solved = LinearProblem(ufl.inner(stress, strain(v)) * ufl.dx, nothing, bcs=conditions, **options).solve()

    x, moved = V.tabulate_dof_coordinates()[:, :2], solved.x.array.reshape(-1, 2)
    along, off = x @ [c, s], np.abs(x @ [-s, c])
    near = np.flatnonzero((off < 1e-9) & (along > 0.9 * length) & (along < length - 3 * finest))
    near = near[np.lexsort([np.arctan2(*moved[near].T), np.round(along[near], 9)])].reshape(-1, 2)
    jump = moved[near[:, 0]] - moved[near[:, 1]]
    jump *= np.sign(jump @ [-s, c])[:, None]
    r = length - along[near[:, 0]]
    scale = (mu * np.sqrt(2 * np.pi / r) / (kappa + 1))[:, None]
    opening, sliding = np.polyfit(r, scale * jump @ np.array([[-s, c], [c, s]]).T, 1)[1]
    return float(opening), float(sliding)


def test_short_branches_open_and_do_not_slide() -> None:
    """K_II is 0 at ANGLE, to 2 degrees, where each branch releases 0.52 of what the crack straight on does."""
    angles = TIP.branching_angle + np.radians([-6, 6])
    (opening, low), (_, high) = map(branch, angles)
    assert np.interp(0.0, [low, high], angles) == pytest.approx(TIP.branching_angle, abs=np.radians(2))
    assert opening**2 == pytest.approx(0.52, abs=0.015)


# --- cracks that run -------------------------------------------------------------------------------------------------


def test_a_strip_branches_where_it_stores_enough_for_two() -> None:
    """One that stores less than 2 G_c a metre has one crack, for two would take more than there is; with 2.5 it has
    two. None runs with 0.95, and with 1.5 the crack cannot but go as fast as a crack may: at half of c_R."""
    stored = (0.95, 1.5, 1.95, 2.5)
    found = [run_of_a_strip(each, "explicit", "unstructured", 12, branching=True) for each in stored]
    assert [each.tips for each in found] == [1, 1, 1, 2]
    assert found[0].length < 1e-9
    implicit = run_of_a_strip(1.5, "newmark", "unstructured", 12, branching=True)
    assert [found[1].speed, implicit.speed] == pytest.approx([0.5, 0.5], rel=0.05)
    assert implicit.tips == 1


@pytest.mark.slow
def test_a_strip_of_small_cells_that_stores_less_does_not_branch() -> None:
    """Half as large as in the test above."""
    assert run_of_a_strip(1.8, "explicit", "unstructured", 24, branching=True).tips == 1


def test_a_crack_that_is_loaded_slowly_does_not_branch() -> None:
    """A step four times as long as starts the crack, without inertia, tears the plate along one line."""
    tables = RUNS["notched"] | {"time": {"scheme": "quasi-static", "step": 6.0, "end": 12.0}}
    study = make_study(**{key: value for key, value in tables.items() if key != "mesh"})
    scene = build_scene_on(distribute(MPI.COMM_SELF, square("unstructured", 16)), study)
    state = scene.start()
    while not scene.ended(state):
        state, _ = scene.stepper.advance(state)
    graph, cells = scene.fracture.graph, scene.domain.nodes[scene.domain.cell_nodes].mean(axis=1)
    assert graph.split.sum() > 10
    # In the last row of cells a crack may cut off a node.
    assert not np.any((graph.pattern == 7) & (cells[:, 0] < 1 - 1 / 16))


def test_a_step_that_sees_no_waves_makes_no_branches() -> None:
    """The plate whose crack branches on every rank count, in steps in which a wave leaves the disc of a tip."""
    tables = RUNS["forked"]
    for step, end, branches in ((5e-4, 8e-3, True), (7e-3, 14e-3, False)):
        scene, state = make_scene(**tables | {"time": tables["time"] | {"step": step, "end": end}})
        march(scene, state)
        assert scene.fracture.graph.split.sum() > 10
        assert np.any(scene.fracture.graph.pattern == 7) == branches


def test_what_is_kept_of_tips_that_branch_is_what_is_found_anew() -> None:
    """After each step, by a criterion that begins there; also of the upper branch, held, while the lower goes on."""
    scene, state = make_scene(**RUNS["forked"])
    criterion, graph, most = criterion_of(scene), scene.fracture.graph, 0
    for _ in each_step(scene, state):
        parts = scene.balance.stress, graph, criterion.strength, criterion.toughness, criterion.cut_positions
        kept, found = criterion.find_tips(), RateDependentTipCriterion(*parts).find_tips()
        most = max(most, len(kept))
        for name in ("cell", "mature", "is_inactive", "alone"):
            np.testing.assert_array_equal(getattr(kept, name), getattr(found, name))
        for name in ("behind", "course", "ahead", "branch_direction"):
            np.testing.assert_allclose(getattr(kept, name), getattr(found, name), atol=1e-12)
        if most > 1:
            criterion.toughness = np.where(criterion.field_evaluator.centres[:, 1] > 0.52, np.inf, 0.02)
    assert most > 1


def test_a_restart_goes_on_as_the_run_would_have(tmp_path: Path) -> None:
    """How fast tips are is remembered, and how far they have to go: the crack branches in the same cell."""
    tables = RUNS["forked"] | {"output": {"picture": False, "interval": 100.0}, "solver": DIRECT}
    going, broken, again = going_stopped_resumed(tables, tmp_path, 13, 5)
    assert 1 < broken < going.breaks.counts[0]
    assert np.any(going.scene.fracture.graph.pattern == 7)
    assert_alike(again, going, 1e-9)
    carried = [each.scene.fracture.criterion.tip_states for each in (going, again)]
    np.testing.assert_allclose(carried[1], carried[0], rtol=1e-9, atol=1e-12)


def test_a_state_is_advanced_twice_alike() -> None:
    """A look is forgotten where a step is taken again, also where nothing has broken in it."""
    scene, state = make_scene(**RUNS["forked"])
    march(scene, state, 12)
    first = [scene.stepper.advance(state.state)[0]]
    carried = [criterion_of(scene).tip_states.copy()]
    first.append(scene.stepper.advance(state.state)[0])
    carried.append(criterion_of(scene).tip_states.copy())
    assert not np.array_equal(first[0].u, state.u)
    np.testing.assert_array_equal(carried[0], carried[1])
    assert np.any(carried[0][:, 0] < 1)


def test_check_tells_when_tips_branch() -> None:
    """And that none does in steps longer than R / c_R; c_R within 1 % of the root of Rayleigh's equation."""
    assert TIP.disc_radius[2] == LIMITS.tip_radius
    nu, h = 0.3, 0.05
    ratio = (1 - 2 * nu) / (2 - 2 * nu)
    root = brentq(lambda x: (2 - x**2) ** 2 - 4 * np.sqrt((1 - x**2) * (1 - ratio * x**2)), 0.5, 0.99)
    wave = 5 * h / (root * np.sqrt(1 / (2 + 2 * nu)))
    told = []
    for step in (0.98 * wave, 1.02 * wave):
        study = make_study(
            mesh={"builder": "box", "size": [1.0, 1.0], "h": h},
            material={"energy": "linear", "young": 1.0, "poisson": nu, "density": 1.0},
            fracture={"strength": 1.0, "energy": 1.0, "branching": True},
            time={"scheme": "newmark", "step": step, "end": 10.0},
        )
        lines = check_study(study)
        assert any("a tip that receives 2 G_c branches" in line for line in lines)
        told.append(any("no tip branches" in line for line in lines))
    assert told == [False, True]


def test_cracks_in_space_do_not_branch() -> None:
    """Refused by `check` and by a run, in one sentence."""
    study = make_study(
        mesh={"builder": "box", "size": [1.0, 1.0, 1.0], "h": 0.5},
        fracture={"strength": 1.0, "energy": 1.0, "branching": True},
    )
    for way in (check_study, lambda study: build_scene(MPI.COMM_SELF, study)):
        with pytest.raises(InputError, match="in the plane only"):
            list(way(study))
