# SPDX-License-Identifier: MIT
"""Where an object would have to stand, turned by a quarter or more, to look as it does.

A coarse search over joint states on grids of distances to each part's surface, for all turns at
once, and Gauss-Newton steps from observed points to the tangent planes of the nearest surface
(Y. Chen, G. Medioni: Object Modelling by Registration of Multiple Range Images, 1992), with the
placement and the joint states as unknowns.

Everything is in the object frame of the true placement: `object_T_turned` takes the turned object
to where it would stand.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import permutations, product

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import KDTree

from sim_assets.objects import ArticulatedObject, joint_motion
from sim_assets.sampling.cloud import sample_surface
from sim_assets.sampling.viewpoints import generator

SAMPLES = 4096
"""Points of each part's surface, for distances."""
CELLS = 32
"""Of a grid of distances, along the object's diagonal."""
REACH = 0.1
"""Beyond a part's box, in diagonals, up to which its grid reaches and distances are told apart."""
STATES = 13
"""Joint states tried, from closed to the end of the travel."""
NEAR = 0.05
"""Diagonals between an observed point and a surface that may explain it, before the fit."""
STEPS = 10
"""Of the fit."""
CLOSE = 0.015
"""As NEAR, at its end."""
FAR = 1.5
"""As far as NEAR or CLOSE, where the normals differ too."""
HOPELESS = 0.6
"""Share of the points on the surface, halfway through a fit, below which it is given up."""
FACING = 0.04
"""Diagonals that count as much as a right angle between normals, in the search for the nearest."""
ROTATION_PRIOR, SHIFT_PRIOR = np.radians(5.0), 0.03
"""Standard deviations of the fitted placement about the exact turn, rad and diagonals."""
NOISE = 0.005
"""That of a distance in the fit, in diagonals."""
FITTED_FREELY = 64
"""Points that count in full in the fit; more of them are not independent."""
STATE_STEP = 0.2
"""Share of the travel that one step of the fit easily covers."""
MOST_ROTATION, MOST_SHIFT = np.radians(15.0), 0.1
"""Of a fitted placement from where it starts, rad and diagonals; farther off is another turn."""


def _cube_turns() -> Float[np.ndarray, "24 3 3"]:
    found = []
    for order in permutations(range(3)):
        for signs in product((1.0, -1.0), repeat=3):
            turn = np.zeros((3, 3))
            turn[range(3), order] = signs
            if np.linalg.det(turn) > 0:
                found.append(turn)
    return np.stack(found)


TURNS = _cube_turns()
"""The 24 turns of a cube, the identity first: rows are signed unit vectors, sorted by the axes that
they pick, then by sign, plus first. Turn k takes the object frame's axes to its columns."""


Oriented = Float[np.ndarray, "M 6"]
"""Points and the unit normals of the surface there, outward or towards the camera."""
States = Float[np.ndarray, " J"]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Fit:
    """One turned object."""

    object_T_turned: Float[np.ndarray, "4 4"]
    state: Float[np.ndarray, " J"]
    covered: float = 1.0
    """Share of the observed points that lie on its surface, about."""


class Body:
    """What the search needs of an object: distances to its parts, and its base's box."""

    def __init__(self, thing: ArticulatedObject, samples: int = SAMPLES) -> None:
        """Draw `samples` points of each part's surface."""
        self.thing, self.samples = thing, samples
        self.size = float(np.linalg.norm(thing.extents()))
        self.meshes = [thing.part_mesh(part) for part in range(len(thing.visuals))]
        bounds = self.meshes[0].bounds
        self.centre, self.extents = bounds.mean(0), bounds[1] - bounds[0]
        self.surfaces = [self._surface(part) for part in range(len(self.meshes))]
        self.trees = [KDTree(self._keys(surface)) for surface in self.surfaces]
        self.grids = [_Grid(surface[: self.samples, :3], self.size) for surface in self.surfaces]
        self.states = np.linspace(0, 1, STATES) * thing.upper[:, None]  # (J, K)
        joints = thing.category.joints
        self.motions = np.stack(
            [
                [joint_motion(thing.pivot[j], thing.axis[j], float(s), joint.kind) for s in states]
                for j, (joint, states) in enumerate(zip(joints, self.states, strict=True))
            ]
        )  # (J, K, 4, 4)

    def _surface(self, part: int) -> Oriented:
        """Samples of a part's surface; of one that is not closed with both of its sides."""
        out = self.draw(part, self.samples, generator("ambiguity", self.thing.instance, part))
        closed = all(visual.mesh.is_watertight for visual in self.thing.visuals[part])
        return out if closed else np.concatenate([out, out * [1, 1, 1, -1, -1, -1]])

    def draw(self, part: int, count: int, rng: np.random.Generator) -> Oriented:
        """Points of a part's surface at rest, uniform by area."""
        mesh = self.meshes[part]
        points, face = sample_surface(mesh, count, rng)
        return np.concatenate([points, np.asarray(mesh.face_normals)[face]], 1)

    def _keys(self, surface: Oriented) -> Oriented:
        """What is near in these is near in space and faces the same way."""
        return surface * np.repeat([1.0, FACING * self.size], 3)

    def starts(self, eye: Float[np.ndarray, " 3"] | None) -> Float[np.ndarray, "T 4 4"]:
        """object_T_turned of each exact turn about the base's box's centre.

        A box whose sides differ changes shape with the turn: its sides towards the camera are put
        where they were, as those away from it are not seen.

        Args:
            eye: The camera in the object frame; None: the object is seen from everywhere.
        """
        out = np.tile(np.eye(4), (len(TURNS), 1, 1))
        out[:, :3, :3] = TURNS
        out[:, :3, 3] = self.centre - TURNS @ self.centre
        if eye is not None:
            offset = eye - self.centre
            side = np.where(np.abs(offset) > self.extents / 2, np.sign(offset), 0)
            out[:, :3, 3] += side * (self.extents - np.abs(TURNS) @ self.extents) / 2
        return out

    def cover(
        self, points: Float[np.ndarray, "M 3"], starts: Float[np.ndarray, "T 4 4"]
    ) -> Float[np.ndarray, "T ..."]:
        """Share of the points within NEAR of the turned object, at each combination of states."""
        joints, states = self.states.shape
        local = _into(starts, points)  # (T, M, 3)
        shape = (len(starts), *[1] * joints, len(points))
        near = np.broadcast_to((self.grids[0].at(local) < NEAR * self.size).reshape(shape), shape)
        for j in range(joints):
            # Parts hang on the base, so a joint's motion in the base frame is all that they need.
            moved = _into(self.motions[j], local[:, None])  # (T, K, M, 3)
            there = self.grids[j + 1].at(moved) < NEAR * self.size
            shape = (len(starts), *[states if i == j else 1 for i in range(joints)], len(points))
            near = near | there.reshape(shape)
        return near.mean(-1)

    def fit(
        self,
        seen: Oriented,
        start: Float[np.ndarray, "4 4"],
        states: States,
        *,
        moves: bool,
    ) -> Fit | None:
        """Placement and states that bring the turned object's surface to the points.

        Args:
            seen: Observed, object frame of the true placement.
            start: object_T_turned.
            states: To start from.
            moves: Fit the placement too, not the states alone.

        Returns:
            None where it leaves the neighbourhood of the start, or covers little of the points.
        """
        now = Fit(object_T_turned=start, state=states)
        for step, limit in enumerate(np.geomspace(NEAR, CLOSE, STEPS)):
            update, covered = self._step(seen, now, start, limit, moves)
            if step >= STEPS // 2 and covered < HOPELESS:
                return None
            now = self._after(now, update, start, covered)
        angle, distance = self._moved(start, now.object_T_turned)
        if np.linalg.norm(angle) > MOST_ROTATION or np.linalg.norm(distance) > MOST_SHIFT:
            return None
        return now

    def _after(
        self,
        now: Fit,
        update: Float[np.ndarray, " U"],
        start: Float[np.ndarray, "4 4"],
        covered: float,
    ) -> Fit:
        """The fit after a step."""
        middle = start[:3, :3] @ self.centre + start[:3, 3]
        moved = np.eye(4)
        moved[:3, :3] = _rotation(update[:3])
        moved[:3, 3] = middle - moved[:3, :3] @ middle + update[3:6]
        return Fit(
            object_T_turned=moved @ now.object_T_turned,
            state=np.clip(now.state + update[6:], 0, self.thing.upper),
            covered=covered,
        )

    def _moved(
        self, start: Float[np.ndarray, "4 4"], pose: Float[np.ndarray, "4 4"]
    ) -> tuple[Float[np.ndarray, " 3"], Float[np.ndarray, " 3"]]:
        """Rotation vector from start to pose, and the shift of the box's centre in diagonals."""
        relative = pose[:3, :3] @ start[:3, :3].T
        angle = np.array([relative[2, 1] - relative[1, 2], relative[0, 2] - relative[2, 0],
                          relative[1, 0] - relative[0, 1]]) / 2  # fmt: skip
        before, after = (t[:3, :3] @ self.centre + t[:3, 3] for t in (start, pose))
        return angle, (after - before) / self.size

    def _step(
        self,
        seen: Oriented,
        now: Fit,
        start: Float[np.ndarray, "4 4"],
        limit: float,
        moves: bool,
    ) -> tuple[Float[np.ndarray, " U"], float]:
        """Small rotation about the start's box's centre, shift, and changes of the states.

        Also the share of the points with a surface within the limit.
        """
        used, part, foot, normal = self.nearest(seen, now, FAR * limit * self.size)
        distance = ((seen[used, :3] - foot) * normal).sum(1)
        rows = self._slopes(part, foot, normal, now, start)
        joints = len(now.state)
        scale = np.array([ROTATION_PRIOR] * 3 + [SHIFT_PRIOR * self.size] * 3 + [1.0] * joints)
        weight = scale**-2
        weight[6:] = (STATE_STEP * self.thing.upper) ** -2.0  # only damps the step
        pull = np.zeros(6 + joints)
        angle, shift = self._moved(start, now.object_T_turned)
        pull[:6] = weight[:6] * np.concatenate([angle, shift * self.size])
        noise = (NOISE * self.size) ** -2 * FITTED_FREELY / max(len(seen), FITTED_FREELY)
        left = noise * rows.T @ rows + np.diag(weight)
        right = noise * rows.T @ distance - pull
        free = np.arange(0 if moves else 6, 6 + joints)
        update = np.zeros(6 + joints)
        update[free] = np.linalg.solve(left[np.ix_(free, free)], right[free])
        return update, len(used) / len(seen)

    def _slopes(
        self,
        part: Int[np.ndarray, " M"],
        foot: Float[np.ndarray, "M 3"],
        normal: Float[np.ndarray, "M 3"],
        now: Fit,
        start: Float[np.ndarray, "4 4"],
    ) -> Float[np.ndarray, "M U"]:
        """Motion of each foot along its normal by each unknown of `_step`."""
        middle = start[:3, :3] @ self.centre + start[:3, 3]
        rows = np.zeros((len(foot), 6 + len(now.state)))
        rows[:, :3], rows[:, 3:6] = np.cross(foot - middle, normal), normal
        turn, shift = now.object_T_turned[:3, :3], now.object_T_turned[:3, 3]
        for j, joint in enumerate(self.thing.category.joints):
            axis = turn @ self.thing.axis[j]
            way = np.broadcast_to(axis, foot.shape)
            if joint.kind == "revolute":
                way = np.cross(axis, foot - (turn @ self.thing.pivot[j] + shift))
            rows[:, 6 + j] = np.where(part == joint.child, (way * normal).sum(1), 0)
        return rows

    def nearest(
        self, seen: Oriented, now: Fit, limit: float
    ) -> tuple[
        Int[np.ndarray, " K"],
        Int[np.ndarray, " K"],
        Float[np.ndarray, "K 3"],
        Float[np.ndarray, "K 3"],
    ]:
        """Points with a surface sample within the limit; its part, position and normal."""
        poses = now.object_T_turned @ self.thing.pose(now.state)
        distances, indices = [], []
        for tree, pose in zip(self.trees, poses, strict=True):
            local = [(seen[:, :3] - pose[:3, 3]) @ pose[:3, :3], seen[:, 3:] @ pose[:3, :3]]
            keys = self._keys(np.concatenate(local, 1))
            distance, index = tree.query(keys, distance_upper_bound=limit)
            distances.append(distance)
            indices.append(index)
        used = np.flatnonzero(np.min(distances, 0) < limit)
        part = np.argmin(distances, 0)[used]
        foot, normal = np.zeros((len(used), 3)), np.zeros((len(used), 3))
        for p, index in enumerate(indices):
            mine = part == p
            chosen, turn = self.surfaces[p][index[used[mine]]], poses[p, :3, :3]
            foot[mine] = chosen[:, :3] @ turn.T + poses[p, :3, 3]
            normal[mine] = chosen[:, 3:] @ turn.T
        return used, part, foot, normal

    def posed(
        self, starts: Float[np.ndarray, "T 4 4"], count: int
    ) -> list[Float[np.ndarray, "T _ 3"] | Float[np.ndarray, "T K _ 3"]]:
        """`count` points of each part's surface in every turn and, but the base's, every state."""
        out = [_onto(starts, self.surfaces[0][:count, :3])]
        for j, motions in enumerate(self.motions):
            moved = _onto(motions, self.surfaces[j + 1][:count, :3])  # (K, F, 3)
            out.append(_onto(starts, moved.reshape(-1, 3)).reshape(len(starts), *moved.shape))
        return out


class _Grid:
    """Distances to a part's surface at the cells of a grid around its box."""

    def __init__(self, points: Float[np.ndarray, "S 3"], size: float) -> None:
        self.cell = size / CELLS
        margin = REACH * size
        self.low = points.min(0) - margin
        shape = np.ceil((np.ptp(points, axis=0) + 2 * margin) / self.cell).astype(int) + 1
        axes = [low + self.cell * np.arange(n) for low, n in zip(self.low, shape, strict=True)]
        cells = np.stack(np.meshgrid(*axes, indexing="ij"), -1)
        self.values, _ = KDTree(points).query(cells, distance_upper_bound=margin)
        self.top = shape - 1

    def at(self, points: Float[np.ndarray, "*B 3"]) -> Float[np.ndarray, "*B"]:
        """Distance at the nearest cell; infinite beyond REACH."""
        index = np.rint((points - self.low) / self.cell).astype(np.intp)
        inside: Bool[np.ndarray, "*B"] = ((index >= 0) & (index <= self.top)).all(-1)
        i, j, k = np.moveaxis(np.clip(index, 0, self.top), -1, 0)
        return np.where(inside, self.values[i, j, k], np.inf)


def _into(
    a_T_b: Float[np.ndarray, "*#B 4 4"], points: Float[np.ndarray, "*#B M 3"]
) -> Float[np.ndarray, "*B M 3"]:
    """Points of a in b."""
    return (points - a_T_b[..., None, :3, 3]) @ a_T_b[..., :3, :3]


def _onto(
    a_T_b: Float[np.ndarray, "B 4 4"], points: Float[np.ndarray, "M 3"]
) -> Float[np.ndarray, "B M 3"]:
    """Points of b in a."""
    return points @ a_T_b[:, :3, :3].transpose(0, 2, 1) + a_T_b[:, None, :3, 3]


def _rotation(vector: Float[np.ndarray, " 3"]) -> Float[np.ndarray, "3 3"]:
    angle = float(np.linalg.norm(vector))
    axis = vector / angle if angle > 0 else np.array([0.0, 0.0, 1.0])
    return joint_motion(np.zeros(3), axis, angle, "revolute")[:3, :3]
