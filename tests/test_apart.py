"""Nothing is drawn inside something else: the files of a run, looked at with VTK's reader and plain geometry."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mpi4py import MPI

from fracsim.contact.obstacle_term import ObstacleTerm
from fracsim.contact.self_contact import SelfContact
from fracsim.deformable_run import Run
from fracsim.scene import build_scene
from fracsim.studies.paper_table import SCENES, overrides
from fracsim.study.reader import load_study
from support.scenes import each_step, make_scene, make_study
from support.vtu import Drawn, frames

FLOOR, TOP, RADIUS, SPEED = -0.001, 0.132, 0.03, 3.0


def crushed(**change: Any) -> dict[str, Any]:
    """A soft plate between a hammer and a floor, which breaks to crumbs under it."""
    body: dict[str, Any] = {
        "mesh": {"builder": "box", "size": [0.2, 0.1], "h": 0.025, "pattern": "unstructured"},
        "material": {"energy": "neo-hookean", "young": 1e6, "poisson": 0.3, "density": 1000.0},
        "fracture": {"strength": 3e4, "radius": 0.03},
        "contact": {},
        "obstacle": [
            {"name": "floor", "shape": "plane", "at": [0.0, FLOOR], "normal": [0.0, 1.0]},
            {"name": "hammer", "shape": "sphere", "radius": RADIUS, "at": [0.1, TOP], "velocity": [0.0, -SPEED]},
        ],
        "time": {"scheme": "backward-euler", "step": 4e-4, "end": 0.011},
        "output": {"interval": 4e-4, "picture": False},
    }
    return body | change


def crossings(drawn: Drawn) -> int:
    """Pairs of segments without a common point that cut each other, by the signs of areas."""
    a, b = (drawn.points[drawn.segments[:, k], :2] for k in range(2))
    i, j = np.triu_indices(len(a), 1)
    apart = (drawn.segments[i][:, :, None] != drawn.segments[j][:, None, :]).all(axis=(1, 2))
    i, j = i[apart], j[apart]

    def side(p: Any, q: Any, r: Any) -> Any:
        return (q[:, 0] - p[:, 0]) * (r[:, 1] - p[:, 1]) - (q[:, 1] - p[:, 1]) * (r[:, 0] - p[:, 0])

    one = side(a[i], b[i], a[j]) * side(a[i], b[i], b[j]) < 0
    return int((one & (side(a[j], b[j], a[i]) * side(a[j], b[j], b[i]) < 0)).sum())


def test_crumbs_between_hammer_and_floor(tmp_path: Path) -> None:
    """In no frame is a point below the floor or in the hammer, and no crumb overlaps another; and as edges break the
    energy of the barriers does not rise."""
    run = Run(build_scene(MPI.COMM_SELF, make_study(**crushed())), tmp_path / "out")
    terms = [term for term in run.scene.balance.terms if isinstance(term, ObstacleTerm | SelfContact)]
    rose: list[float] = []
    for term in terms:

        def watched(pattern: Any, term: Any = term, go: Any = term.edges_broke) -> None:
            before = term.stored_energy()
            go(pattern)
            rose.append(term.stored_energy() - before)

        term.edges_broke = watched  # type: ignore[method-assign]
    run()
    drawn = frames(tmp_path / "out")
    assert len(drawn) > 20 and len(rose) > 10
    assert drawn[-1].pieces > 2
    for each in drawn:
        used = each.points[np.unique(each.segments), :2]
        assert used[:, 1].min() > FLOOR
        assert np.linalg.norm(used - [0.1, TOP - SPEED * each.t], axis=1).min() > RADIUS
        assert crossings(each) == 0
    assert max(rose) < 1e-3 * run.state.elastic


@pytest.mark.parametrize("itself", ['"pieces"', "true"])
def test_new_faces_beside_short_edges_gain_no_energy(itself: str, tmp_path: Path) -> None:
    """A Charpy bar that snaps along one surface: its edges at the notch are an eighth of others. Without room for the
    barrier between the points around one node, the barriers had 20 times the energy of the blow."""
    sets = [*overrides(SCENES["brittle-charpy"], small=False), "mesh.h=4e-3", "mesh.h_notch=5e-4"]
    run = Run(build_scene(MPI.COMM_SELF, load_study("charpy", [*sets, f"contact.itself={itself}"])), tmp_path / "out")
    while not run.breaks.counts[0]:
        run.step()
    run.step()
    run.history.close()
    history = np.genfromtxt(tmp_path / "out" / "history.csv", delimiter=",", names=True)
    work = history["external_work"]
    surplus = history["kinetic"] + history["elastic"] + history["dissipated"] - work
    assert run.breaks.counts[2] == 2 and work[-1] > 0.2
    assert surplus.max() < 0.02 * work[-1]


@pytest.mark.parametrize("itself", ["pieces", True])
def test_crack_faces_in_contact_lie_on_the_surface_that_cut_the_body(itself: str | bool) -> None:
    """A bar pulled until one plane parts it. Faces through the middle of edges would be 0.23 h from the plane."""
    h, size = 0.02, [0.2, 0.08, 0.08]
    scene, state = make_scene(
        mesh={"builder": "box", "size": size, "h": h, "pattern": "unstructured"},
        material={"energy": "corotated", "young": 1e7, "poisson": 0.3, "density": 1000.0},
        fracture={"strength": 1e5, "crumbs": False},
        brittle={"surfaces": 1},
        contact={"itself": itself, "distance": 1e-3 * h},
        boundary=[{"on": "left", "fix": "xyz"}, {"on": "right", "velocity": [0.5, 0.0, 0.0]}],
        time={"scheme": "backward-euler", "step": 1e-3, "end": 0.1},
    )
    while not next(each_step(scene, state)).broken:
        pass
    [term] = [term for term in scene.balance.terms if isinstance(term, SelfContact)]
    surface = term.surface.current
    x = surface.rest_positions[np.unique(surface.elements[surface._crack_faces])]
    x = x[(np.abs(x - np.array(size) / 2) < np.array(size) / 2 - 1e-9).all(axis=1)]
    centre = x.mean(axis=0)
    away = (x - centre) @ np.linalg.svd(x - centre)[2][-1]
    assert len(x) > 20 and np.sqrt(np.mean(away**2)) < 0.06 * h
