"""Shards of shells that fly at one another: none passes through another."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
import pytest

pytest.importorskip("mujoco", reason="an environment made without a network")

from fracsim.fracture.brittle.grains import SurfaceParameters
from fracsim.mesh.input_topology import MeshTopology
from fracsim.meshes.builders.ornament import Ornament
from fracsim.rigid.fragment_geometry import FragmentGeometry
from fracsim.rigid.instance_placement import InstancePlacement, InstancePoses
from fracsim.rigid.instances import Instances
from fracsim.rigid.mujoco_model import ContactParameters
from fracsim.rigid.rigid_stepper import RigidState, RigidStepper
from fracsim.rigid.surface_loads import HertzContact
from support.rigid import DENSITY, breakable

Ints = npt.NDArray[np.int64]
Values = npt.NDArray[np.float64]
RADIUS, THICKNESS = 0.04, 0.001


def pierced(x: Values, triangles: Ints, piece: Ints) -> list[tuple[int, int, float]]:
    """(piece, piece, m) where an edge of one goes through a triangle of another, and how far its shorter end sticks out
    behind it: by signed volumes, which share nothing with the engine. Points x (n, 3), triangles (m, 3) of pieces
    (m,)."""
    found = []
    edges = np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]])
    of_edge = np.tile(piece, 3)
    low, high = x[edges].min(axis=1), x[edges].max(axis=1)
    for corners, mine in zip(x[triangles], piece, strict=True):
        near = (low <= corners.max(axis=0)).all(axis=1) & (high >= corners.min(axis=0)).all(axis=1) & (of_edge != mine)
        p, q = np.swapaxes(x[edges[near]], 0, 1)
        a, b, c = corners
        normal = np.cross(b - a, c - a)
        normal /= np.linalg.norm(normal)
        above, below = (p - a) @ normal, (q - a) @ normal
        sides = np.stack([np.einsum("ki,ki->k", q - p, np.cross(u - p, v - p)) for u, v in ((a, b), (b, c), (c, a))])
        through = (above * below < 0) & ((sides > 0).all(axis=0) | (sides < 0).all(axis=0))
        out = np.minimum(np.abs(above), np.abs(below))[through]
        found += [(int(mine), int(k), float(depth)) for k, depth in zip(of_edge[near][through], out, strict=True)]
    return found


@dataclass(frozen=True)
class Scene:
    """Balls, copies of one shell: triangles (m, 3) of their middle surfaces between points (n, 3) at rest."""

    stepper: RigidStepper
    middle: Values
    triangles: Ints

    @classmethod
    def of(cls, places: list[Values], step: float, surfaces: int) -> Scene:
        """At some places, without weight."""
        mesh = Ornament(radius=RADIUS, neck=0.0, thickness=THICKNESS, h=0.012).build()
        assert mesh.shell is not None
        poses = InstancePoses.from_placements([InstancePlacement(at, *np.zeros((3, 3))) for at in places])
        sizes = len(mesh.points), len(mesh.cells), len(MeshTopology(mesh).edges)
        made = Instances(lambda *_: breakable(mesh, 1e6, SurfaceParameters(surfaces)), poses, sizes)
        rules = ContactParameters(step, np.zeros(3), 0.3)
        stepper = RigidStepper(made, FragmentGeometry(mesh, poses), DENSITY, [], rules, HertzContact(1e9, 0.2))
        middle, first = mesh.shell.middle + np.array(places)[:, None], len(mesh.points) * np.arange(len(places))
        triangles = mesh.shell.triangles + first[:, None, None]
        return cls(stepper, middle.reshape(-1, 3), triangles.reshape(-1, 3).astype(np.int64))

    def piercings(self, state: RigidState) -> list[tuple[int, int, float]]:
        """Of the middle surfaces of all pieces, without the triangles that cracks run through."""
        of_node = self.stepper.shapes.node_fragment
        of = of_node[self.triangles]
        whole = (of == of[:, :1]).all(axis=1)
        return pierced(state.bodies.to_current(self.middle, of_node), self.triangles[whole], of[whole, 0])


def test_piercing_is_seen() -> None:
    """An edge through a triangle, 0.2 of it behind; beside it, before it and in one piece there is none."""
    x = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0.2, 0.2, -0.2], [0.2, 0.2, 0.8], [0.2, 5, 0.8]])
    two = np.array([[0, 1, 2], [3, 4, 5]])
    assert (0, 1, pytest.approx(0.2)) in pierced(x, two, np.array([0, 1]))
    assert not pierced(x, two, np.array([0, 0]))
    for shift in ([1.0, 0, 0], [0, 0, 0.3]):
        assert not pierced(np.concatenate([x[:3], x[3:] + shift]), two, np.array([0, 1]))


def test_shards_do_not_pass_through_one_another_at_twenty_metres_a_second() -> None:
    """Two glass balls that meet: after every step no shard sticks in another, of its ball or not, by more than their
    hulls leave out of them, 2 % of the length of each (test_clusters); in the end none does at all."""
    speed, step = 20.0, 1e-3
    scene = Scene.of([np.zeros(3), np.array([0.01, 0.02, 2.05 * RADIUS])], step, 20)
    stepper, state = scene.stepper, scene.stepper.start()
    meeting = np.array([[0.0, 0, speed / 2], [0, 0, -speed / 2]])
    state, deepest = replace(state, bodies=replace(state.bodies, velocity=meeting)), 0.0
    for _ in range(24):
        state, _ = stepper.advance(state)
        found = scene.piercings(state)
        deepest = max(deepest, *(depth for *_, depth in found), 0.0)
    longest = max(float(np.linalg.norm(np.ptp(each, axis=0))) for each in stepper.shapes.hull_points)
    assert len(state.bodies) > 20 and not found and deepest < 2 * 0.02 * longest
    squeezed = replace(state, bodies=replace(state.bodies, position=0.5 * state.bodies.position))
    assert len(scene.piercings(squeezed)) > 10, "it would be seen"
