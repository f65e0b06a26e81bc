# SPDX-License-Identifier: MIT
"""Which turns of an object look as the object does: poses that nobody could tell apart.

For each of the 24 turns of a cube, applied to the base about its box's centre, placement and joint
states are fitted again (`turned_fit`), and what the turned object would show is compared with what
is seen (`evidence`). Poses are told apart by what is seen, not by the object's symmetry, as in
BOP-Distrib (arXiv 2408.17297); here with joints.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, UInt8

from scapo.geometry.camera import Intrinsics
from sim_assets.objects import ArticulatedObject
from sim_assets.options import Noise, Protocol
from sim_assets.sampling.evidence import (
    AbstractEvidence,
    DepthImage,
    Sight,
    Tolerance,
    WholeSurface,
)
from sim_assets.sampling.turned_fit import SAMPLES, TURNS, Body, States

PROBES = 96
"""Points of the coarse search, of what is seen and of each part's surface."""
FITTED = 256
"""Points of the fit."""
COVERED, STICKING_OUT = 0.85, 0.1
"""Of a turn that is fitted: the least share of probes near its surface, and the largest share of
its surface that would stand where nothing was seen."""
FITTING = 0.8
"""Share of the points on its surface from which on a fit is compared with what is seen."""
DENSE = 4 * SAMPLES
"""Samples of each part's surface where whole surfaces are compared."""
CHOSEN = Tolerance()


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Alike:
    """The turns that look as the truth does; at all others the fields hold the truth."""

    turns: UInt8[np.ndarray, " 24"]
    """1 where the turn looks alike; the first, no turn, always does."""
    camera_T_base: Float[np.ndarray, "24 4 4"]
    state: Float[np.ndarray, "24 J"]
    part: UInt8[np.ndarray, "24 P"]
    """The true part in whose place part p of the turned object is."""
    unexplained: Float[np.ndarray, " 24"]
    """Share of what is seen, or would be, that stays unexplained; 1 where it was not compared."""

    def row(self) -> dict[str, np.ndarray]:
        """The tensors of a sample (docs/data-format.md)."""
        return {
            "alike": self.turns,
            "alike_base": self.camera_T_base.astype(np.float32),
            "alike_state": self.state.astype(np.float32),
            "alike_part": self.part,
        }


class Ambiguity:
    """Finds the turns of one object that look alike, sample by sample."""

    def __init__(
        self,
        thing: ArticulatedObject,
        camera: Intrinsics,
        noise: Noise = "none",
        protocol: Protocol = "joint",
        tolerance: Tolerance = CHOSEN,
    ) -> None:
        """Prepare the object's surfaces; a sample then takes tens of milliseconds.

        Args:
            thing: The object.
            camera: Intrinsics of the views: what is outside their images is not seen.
            noise: Of the sensor.
            protocol: `joint`, a depth image, or `full`, the whole surface.
            tolerance: When a turned object explains what is seen.

        Raises:
            ValueError: Another protocol.
        """
        if protocol == "isolated":
            raise ValueError("ambiguity: expected protocol joint or full, found isolated")
        self.thing, self.tolerance = thing, tolerance
        self.body = Body(thing, SAMPLES if protocol == "joint" else DENSE)
        self.sight = None
        if protocol == "joint":
            from sim_assets.rendering.embree import RaycastRenderer  # not on every machine

            renderer = RaycastRenderer(rebuild_below=0)
            renderer.open(thing)
            self.sight = Sight(camera=camera, noise=noise, tolerance=tolerance, renderer=renderer)

    def find(
        self, state: Float[np.ndarray, " J"], camera_T_object: Float[np.ndarray, "4 4"]
    ) -> Alike:
        """The turns that explain what this sample shows.

        Args:
            state: Joint states, rad or m.
            camera_T_object: Where the object stands; its frame is that of part 0.
        """
        if self.sight is None:
            evidence, eye = WholeSurface(self.body, state, self.tolerance), None
        else:
            evidence = DepthImage(self.body, state, camera_T_object, self.sight)
            eye = -camera_T_object[:3, :3].T @ camera_T_object[:3, 3]
        starts = self.body.starts(eye)
        alike = _truth(state, camera_T_object, len(self.thing.visuals))
        seen = evidence.oriented(FITTED)
        for turn, states in self.candidates(evidence, starts):
            for moves in (False, True):  # the exact turn first
                fit = self.body.fit(seen, starts[turn], states, moves=moves)
                if fit is None or fit.covered < FITTING:
                    continue
                share, part = evidence.unexplained(fit)
                alike.unexplained[turn] = min(share, alike.unexplained[turn])
                if share <= self.tolerance.share:
                    alike.turns[turn] = 1
                    alike.camera_T_base[turn] = camera_T_object @ fit.object_T_turned
                    alike.state[turn], alike.part[turn] = fit.state, part
                    break
        return alike

    def candidates(
        self, evidence: AbstractEvidence, starts: Float[np.ndarray, "T 4 4"]
    ) -> list[tuple[int, States]]:
        """Turns but the first that may explain what is seen, with the best states to start from."""
        cover = self.body.cover(evidence.points(PROBES), starts)
        base, *others = evidence.outside(starts, PROBES)
        joints = len(others)
        outside = base.reshape(-1, *[1] * joints)
        for j, share in enumerate(others):
            outside = outside + share.reshape(
                len(starts), *[-1 if i == j else 1 for i in range(joints)]
            )
        outside = outside / (1 + joints)
        possible = (cover >= COVERED) & (outside <= STICKING_OUT)
        score = np.where(possible, cover - outside, -np.inf).reshape(len(starts), -1)
        best = score.argmax(1)
        states = np.stack(np.unravel_index(best, cover.shape[1:]), -1)
        return [
            (turn, self.body.states[range(joints), states[turn]])
            for turn in range(1, len(starts))
            if score[turn, best[turn]] > -np.inf
        ]


def _truth(
    state: Float[np.ndarray, " J"], camera_T_object: Float[np.ndarray, "4 4"], parts: int
) -> Alike:
    count = len(TURNS)
    itself = np.arange(count) == 0
    return Alike(
        turns=itself.astype(np.uint8),
        camera_T_base=np.tile(camera_T_object, (count, 1, 1)),
        state=np.tile(state, (count, 1)),
        part=np.tile(np.arange(parts, dtype=np.uint8), (count, 1)),
        unexplained=np.where(itself, 0.0, 1.0),
    )
