# SPDX-License-Identifier: MIT
"""One pull, in SAPIEN: a hand follows the predicted path and holds a point of the moving part.

The object is scaled to a diagonal of 1 m, so that glasses and ovens pose the same problem; forces
are those of the object at its own size, which grow with it as the grip does (`GRIP`). The body is
fixed, the moving part hangs on the object's true joint with its true limits, and nothing collides.
The hand is a spring and a damper between the point that it should be at and the one that it holds;
all that the path demands beyond what the joint allows becomes force across the true path.

There is no gravity, so that a part moves because it is pulled and for no other reason: under it an
oven's door would fall open whatever was predicted, and no lid would stay. What holds a part in its
place is the friction of its hinge or slide, as with real doors that stay where they are left.
"""

from __future__ import annotations

import math
import warnings
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from scapo.categories import JointKind
from scapo.export.urdf import box_inertia
from sim_assets.actuation.grasp import Path, Point, grasp_point, path_of
from sim_assets.objects import ArticulatedObject

with warnings.catch_warnings():
    warnings.simplefilter("ignore")
    import sapien
    from sapien import physx

STIFFNESS = 1000.0
"""N/m, of the hand: within the usual range of compliant arms, some hundreds to two thousand."""
GRIP = 50.0
"""N per metre of the object's diagonal, the force at which the hand slips off: at this stiffness
where the predicted path is a twentieth of the diagonal away from the true one. An oven's handle is
held with 50 N, a temple of glasses with 10."""
FRICTION = 5.0
"""N per metre of the diagonal at the grasp point: a tenth of the grip. Household doors and drawers
ask for a few newtons to a few tens (Jain et al., The Complex Structure of Simple Devices, 2010)."""
SPEED = 0.25
"""Diagonals per second at which the hand moves: slow, so that inertia adds little to the forces."""
RAMP = 0.5
"""Seconds in which the hand gathers that speed."""
SETTLE = 0.25
"""Seconds at the end of the path in which the part may catch up."""
LONGEST = 20.0
"""Seconds after which a pull is over: a predicted axis a long way off has a long path."""
STEP = 1 / 240
"""Seconds of a simulated step, SAPIEN's usual one."""
SHORTEST = 0.01
"""Diagonals, a shorter lever than any object has; a predicted axis may pass through the grasp."""
STICKING = 1e4
"""N s/m at the grasp point up to which friction resists creeping: 0.5 mm/s at full friction."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Body:
    """The moving part and its true joint, the object scaled to a diagonal of 1 m."""

    kind: JointKind
    pivot: Point
    axis: Point
    """Unit; a positive state opens."""
    upper: float
    """Travel, rad or diagonals."""
    size: float
    """The diagonal that was, m."""
    grasp: Point
    """Where the hand holds the part, at rest."""
    mass: float
    centre: Point
    """Of mass, at rest."""
    moments: Point
    """Of inertia about the centre, along the object frame's axes."""

    @property
    def unit(self) -> float:
        """Of the joint's state here, in rad or m."""
        return 1.0 if self.kind == "revolute" else self.size

    def path(self) -> Path:
        """Of the grasp point, from rest."""
        return path_of(self.kind, self.pivot, self.axis, self.grasp)

    def inertia(self, lever: float) -> float:
        """As felt at the grasp point, so far from the axis; kg."""
        if self.kind == "prismatic":
            return self.mass
        offset = np.cross(self.axis, self.centre - self.pivot)
        about = float(self.moments @ self.axis**2 + self.mass * (offset @ offset))
        return about / lever**2


def body_of(thing: ArticulatedObject, j: int) -> Body:
    """A moving part of an object and its joint."""
    size, kind = float(np.linalg.norm(thing.extents())), thing.category.joints[j].kind
    mesh = thing.part_mesh(thing.category.joints[j].child)
    mass, centre, moments = box_inertia(np.asarray(mesh.vertices) / size)
    return Body(
        kind=kind,
        pivot=thing.pivot[j] / size,
        axis=thing.axis[j],
        upper=float(thing.upper[j]) / (1.0 if kind == "revolute" else size),
        size=size,
        grasp=grasp_point(mesh, kind, thing.pivot[j], thing.axis[j]) / size,
        mass=mass,
        centre=centre,
        moments=moments,
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class Pulled:
    """What came of a pull."""

    moved: float
    """Farthest that the joint went the wanted way, rad or diagonals."""
    mean: float
    """Of the force across the true path, N at a diagonal of 1 m."""
    peak: float
    slipped: bool
    """The hand lost its hold."""


def pull(body: Body, state: float, wanted: Path, extent: float, opening: bool) -> Pulled:
    """Pull the part along a path, from a state of its joint.

    Args:
        body: The part.
        state: Of the joint at the start.
        wanted: The hand's path, beginning at the grasp point.
        extent: How far along it, rad or diagonals.
        opening: Whether a growing state is what is wanted.
    """
    scene, articulation = _build(body, state)
    link, joint = articulation.links[1], articulation.joints[1]
    own = body.path()
    lever = max(own.lever(), SHORTEST)
    joint.set_drive_properties(0.0, STICKING * lever**2, FRICTION * lever, "force")
    speed = SPEED / max(wanted.lever(), SHORTEST)
    damping = 2 * math.sqrt(STIFFNESS * body.inertia(lever))  # critical
    forces, moved = [], 0.0
    seconds = min(extent / speed + RAMP / 2 + SETTLE, LONGEST)
    for step in range(math.ceil(seconds / STEP)):
        done, rate = _progress(step * STEP, speed, extent)
        q, dq = float(articulation.qpos[0]), float(articulation.qvel[0])
        moved = max(moved, q - state if opening else state - q)
        held, tangent = own.at(q), own.tangent(q)
        force = STIFFNESS * (wanted.at(done) - held)
        force += damping * (rate * wanted.tangent(done) - dq * tangent)
        forces.append(_across(force, tangent))
        if force @ force > GRIP**2:
            return _pulled(forces, moved, slipped=True)
        link.add_force_at_point(force.tolist(), held.tolist())
        scene.step()
    return _pulled(forces, moved, slipped=False)


def _pulled(forces: list[float], moved: float, *, slipped: bool) -> Pulled:
    return Pulled(moved=moved, mean=float(np.mean(forces)), peak=max(forces), slipped=slipped)


def _progress(time: float, speed: float, extent: float) -> tuple[float, float]:
    """How far along its path the hand is, and how fast: evenly faster at first, then steady."""
    if time < RAMP:
        done, rate = speed * time * time / (2 * RAMP), speed * time / RAMP
    else:
        done, rate = speed * (time - RAMP / 2), speed
    return (done, rate) if done < extent else (extent, 0.0)


def _across(force: Point, tangent: Point) -> float:
    """The part of a force that is at right angles to a direction, or all where that is none."""
    square = float(tangent @ tangent)
    rest = force - (force @ tangent) / square * tangent if square else force
    return math.sqrt(float(rest @ rest))


def _build(body: Body, state: float) -> tuple[sapien.Scene, physx.PhysxArticulation]:
    """A fixed base and the moving part on its joint, in a scene that must be kept."""
    scene = sapien.Scene([physx.PhysxCpuSystem()])
    scene.set_timestep(STEP)
    builder = scene.create_articulation_builder()
    base = builder.create_link_builder()
    base.set_mass_and_inertia(1.0, sapien.Pose(), np.ones(3, np.float32))
    part = builder.create_link_builder(base)
    part.set_mass_and_inertia(
        body.mass, sapien.Pose(body.centre.astype(np.float32)), body.moments.astype(np.float32)
    )
    frame = sapien.Pose(_frame(body))
    part.set_joint_properties(body.kind, [[0.0, body.upper]], frame, frame)
    articulation = builder.build(fix_root_link=True)
    articulation.set_qpos(np.array([state], np.float32))
    articulation.set_qvel(np.zeros(1, np.float32))
    for link in articulation.links:
        link.disable_gravity = True
    return scene, articulation


def _frame(body: Body) -> Float[np.ndarray, "4 4"]:
    """The joint's frame, whose x axis SAPIEN turns about or slides along."""
    other = np.eye(3)[int(np.abs(body.axis).argmin())]
    second = np.cross(body.axis, other)
    second /= np.linalg.norm(second)
    frame = np.eye(4)
    frame[:3, :3] = np.stack([body.axis, second, np.cross(body.axis, second)], 1)
    frame[:3, 3] = body.pivot
    return frame
