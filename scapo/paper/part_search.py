# SPDX-License-Identifier: MIT
"""Where stage 2 begins: parts and joints found from several starts, judged without labels.

Not in the paper, which says nothing of how keypoints, bones and joints begin. From the P-means of
one shape the skinning of stage 2 settles on whatever halves those are (a laptop is cut across its
hinge), and the terms of Sec. 3.3 hold it there. Here the blend skinning of Sec. 3.2 is fitted to
clouds that stage 1 has aligned, without networks: a template with bones and joints for all, and for
each cloud its states, what is left of its pose, and three sizes. Many splits of the template are
tried on few clouds, the best go on with more, and clouds that no start was fitted to decide.

Frames: `aligned`, where the clouds are; `template`. Lengths in normalised units.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, fields, replace
from typing import ClassVar, Literal, TypeVar

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int
from torch import Tensor

from scapo.categories import JointKind
from scapo.geometry.points import (
    farthest_points,
    gather,
    k_means,
    k_nearest,
    nearest,
    squared_distances,
)
from scapo.geometry.rigid import joint_motion
from scapo.geometry.rotations import rotvec_to_rotmat
from scapo.paper.skinning import deform, gaussian_weights
from scapo.records import cat, map_tensors, take

Kinds = tuple[JointKind, ...]
T = TypeVar("T", "Skeleton", "Placements")


@dataclass(frozen=True, slots=True, kw_only=True)
class SearchConfig:
    """How widely the start of stage 2 is looked for."""

    LIKE: ClassVar[tuple[tuple[str, ...], ...]] = (("clouds", "steps"),)
    seeds: int = 10
    """Points of the template around which a part may be."""
    clouds: tuple[int, ...] = (16, 32, 64)
    """Clouds fitted in each round; as many others judge."""
    alike: int = 4
    """Times the clouds of the last round that are placed, for those most like the template."""
    kept: tuple[int, ...] = (6, 2)
    """Starts that go on from each round but the last."""
    steps: tuple[int, ...] = (40, 60, 150)
    """Steps of Adam in each round."""
    points: int = 512
    """Points of the template, or all of a shape that has more."""
    asked: int = 256
    """Points of each cloud, and of the template, whose nearest is looked for in a step."""
    rate: float = 0.02
    """Learning rate of poses and states."""
    reach: float = 1.2
    """States that are tried lie within this many radians either side of 0."""
    aside: float = 0.4
    """Weight of the squared shift of a joint on the body, which lets hinges sit elsewhere on each
    object: without it a far hinge, about which a part slides, tells how bodies differ."""
    spread: float = 0.03
    """Added to the deviations of a part's points where its bone begins."""
    taught: int = 1000
    """Clouds that are placed, for the networks to be fitted to."""
    placing: int = 40
    """Steps of Adam for that; where starts are judged, half of them or a third of the round's."""
    teaching: int = 400
    """Steps of Adam of the networks."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Skeleton:
    """A template with bones and joints: what all clouds share."""

    points: Float[Tensor, "M 3"]
    keypoints: Float[Tensor, "P 3"]
    factor: Float[Tensor, "P 3 3"]
    """L of each bone; Q / gamma is L^T L."""
    pivot: Float[Tensor, "J 3"]
    axis: Float[Tensor, "J 3"]

    def precision(self) -> Float[Tensor, "P 3 3"]:
        """Q / gamma of each bone."""
        return self.factor.mT @ self.factor

    def weights(self) -> Float[Tensor, "M P"]:
        """Of the template's points: w."""
        return gaussian_weights(self.points[None], self.keypoints[None], self.precision())[0]

    def laid_over(self, shape: Float[Tensor, "K 3"]) -> Skeleton:
        """With as many points as a shape, each the nearest to one of it that is left."""
        return replace(self, points=self.points[matched(shape, self.points)])


def matched(shape: Float[Tensor, "K 3"], points: Float[Tensor, "M 3"]) -> Int[Tensor, " K"]:
    """For each point of a shape one of the points, none twice, squared distances least in all."""
    from scipy.optimize import linear_sum_assignment

    cost = torch.cdist(shape, points).square()
    _, column = linear_sum_assignment(cost.cpu().numpy())
    return torch.as_tensor(column).to(points.device)


@dataclass(frozen=True, slots=True, kw_only=True)
class Placements:
    """How each cloud lies and stands."""

    turn: Float[Tensor, "B 3"]
    """Rotation vector of aligned_R_template, of the base."""
    shift: Float[Tensor, "B 3"]
    size: Float[Tensor, "B 3"]
    """Logarithms of the scales along the template's axes."""
    aside: Float[Tensor, "B J 3"]
    """Of a joint and its part on the base; template frame, after scaling."""
    state: Float[Tensor, "B J"]


def values(of: Skeleton | Placements) -> list[Tensor]:
    """What can be learned, in the order of the fields."""
    return [getattr(of, one.name) for one in fields(of)]


def having(of: T, new: Iterable[Tensor]) -> T:
    """The same with other values, in the order of the fields."""
    return replace(of, **{one.name: value for one, value in zip(fields(of), new, strict=True)})


def motionless(clouds: Float[Tensor, "B N 3"], joints: int) -> Placements:
    """Where everything begins."""
    zero = clouds.new_zeros(len(clouds), 3)
    return Placements(
        turn=zero,
        shift=zero,
        size=zero,
        aside=clouds.new_zeros(len(clouds), joints, 3),
        state=clouds.new_zeros(len(clouds), joints),
    )


def posed(s: Skeleton, at: Placements, kinds: Kinds) -> Float[Tensor, "B M 3"]:
    """The template as each cloud has it."""
    size = at.size.exp()[:, None]
    points, pivot = s.points * size, s.pivot * size
    axis = F.normalize(s.axis, dim=-1).expand_as(pivot)
    eye = torch.eye(4, dtype=points.dtype, device=points.device).expand(len(size), 4, 4)
    moves = [
        joint_motion(pivot[:, j], axis[:, j], at.state[:, j], kind) for j, kind in enumerate(kinds)
    ]
    weights = s.weights().expand(len(size), -1, -1)
    moved = deform(torch.stack([eye, *moves], 1), points, weights)
    moved = moved + weights[..., 1:] @ at.aside
    return moved @ rotvec_to_rotmat(at.turn).mT + at.shift[:, None]


def misfit(
    clouds: Float[Tensor, "B N 3"], shapes: Float[Tensor, "B M 3"], asked: int, offset: int = 0
) -> Float[Tensor, " B"]:
    """Mean distance to the nearest point, both ways: strangers weigh less than when squared.

    All points are there to be found, but about `asked` of each side ask. How far the nearest is
    depends on how densely the other side is sampled, and that may be more than a door that moves.
    """
    some, others = _every(clouds, asked, offset), _every(shapes, asked, offset)
    there, back = squared_distances(some, shapes), squared_distances(others, clouds)
    return (there + 1e-6).sqrt().mean(-1) + (back + 1e-6).sqrt().mean(-1)


@torch.no_grad()
def unlikeness(
    clouds: Float[Tensor, "B N 3"], shapes: Float[Tensor, "B M 3"], asked: int
) -> Float[Tensor, " B"]:
    """Mean distance to the nearest point, both ways, of the points that are not far: `NEAR`."""
    some, others = _every(clouds, asked, 0), _every(shapes, asked, 0)
    gaps = []
    for here, there in ((some, shapes), (others, clouds)):
        gap = (here - gather(there, nearest(here, there))).norm(dim=-1)
        gaps.append(gap.sort(-1).values[:, : int(NEAR * gap.shape[1])].mean(-1))
    return gaps[0] + gaps[1]


NEAR = 0.75
"""Share of the points that tell whether two objects are alike; the others may have moved."""


def _every(points: Float[Tensor, "B N 3"], count: int, offset: int) -> Float[Tensor, "B K 3"]:
    step = max(1, points.shape[1] // count)
    return points[:, offset % step :: step]


def held(s: Skeleton, at: Placements) -> Float[Tensor, ""]:
    """No part is empty, keypoints are centroids, and placements lie about the template's own."""
    weights = s.weights()
    mass = F.relu(0.04 - weights.mean(0)).sum()
    centroid = weights.mT @ s.points / weights.sum(0).clamp(min=1e-3)[:, None]
    middle = torch.stack([value.mean(0).square().sum() for value in values(at)]).sum()
    return 5 * mass + (s.keypoints - centroid).square().sum() + 0.1 * middle


RATES = (0.25, 0.5, 25.0, 0.5, 1.0)
"""Learning rates of a skeleton's fields as multiples of `SearchConfig.rate`."""


@torch.no_grad()
def residual(
    clouds: Float[Tensor, "B N 3"], shapes: Float[Tensor, "B M 3"], template: Float[Tensor, "M 3"]
) -> Float[Tensor, " M"]:
    """How far each point of the template, as placed, is from the clouds: a mean over neighbours."""
    gap = squared_distances(shapes, clouds).sqrt().mean(0)
    return gap[k_nearest(template, template, 12)].mean(1)


def split_skeleton(
    points: Float[Tensor, "M 3"], children: list[Bool[Tensor, " M"]], spread: float
) -> Skeleton:
    """Bones and joints of a split: Gaussians of the parts, hinges along the boundaries.

    Args:
        points: Of the template.
        children: For each child, which points it has; the others are the base's.
        spread: Added to the deviations of a part's points.
    """
    base = ~torch.stack(children).any(0)
    factors, pivots, axes = [], [], []
    for some in (base, *children):
        deviations, vectors = _main_directions(points[some])
        factors.append((vectors * (0.5**0.5 / (deviations + spread))) @ vectors.mT)
    for some in children:
        gap = torch.cdist(points[some], points[base]).amin(1)
        edge = points[some][gap.topk(max(6, len(points) // 24), largest=False).indices]
        axes.append(_main_directions(edge)[1][:, -1])
        pivots.append(edge.mean(0))
    return Skeleton(
        points=points,
        keypoints=torch.stack([points[some].mean(0) for some in (base, *children)]),
        factor=torch.stack(factors),
        pivot=torch.stack(pivots),
        axis=torch.stack(axes),
    )


def _main_directions(points: Float[Tensor, "N 3"]) -> tuple[Float[Tensor, " 3"], Tensor]:
    """Standard deviations, rising, and the directions as columns."""
    centred = points - points.mean(0)
    variance, vectors = torch.linalg.eigh(centred.mT @ centred / len(points))
    return variance.clamp(min=0).sqrt(), vectors


def splits(
    points: Float[Tensor, "M 3"], stray: Float[Tensor, " M"], joints: int, seeds: int
) -> list[list[Bool[Tensor, " M"]]]:
    """Which points each child may have.

    Args:
        points: Of the template.
        stray: How far each is from clouds on which the template lies as a whole: what moved is.
        joints: For one: halves and ends along the main directions, balls, the points that stray
            most. For two: the two ends of a direction, two balls, and the strays in two clusters.
        seeds: How many balls.
    """
    count, least = len(points), len(points) // 5
    ranks = [along.argsort().argsort() for along in (points @ _main_directions(points)[1]).T]
    ends = [[rank < least, rank >= count - least] for rank in ranks]
    first = int((points - points.mean(0)).norm(dim=1).argmax())
    chosen = farthest_points(points, seeds, start=first)
    balls = [row.argsort().argsort() < least for row in torch.cdist(points[chosen], points)]
    strays = [stray.argsort(descending=True).argsort() < count // k for k in (8, 5, 3)]
    if joints == 1:
        halves = [rank < count // 2 for rank in ranks]
        return [
            [some] for some in (*halves, *(end for pair in ends for end in pair), *balls, *strays)
        ]
    apart = [
        [one, other]
        for i, one in enumerate(balls)
        for other in balls[:i]
        if not bool((one & other).any())
    ]
    clusters = []
    for some in strays:
        corner = farthest_points(points[some], 2)
        nearer = torch.cdist(points, k_means(points[some], points[some][corner], 20)).argmin(1)
        clusters.append([some & (nearer == k) for k in (0, 1)])
    return ends + apart + clusters


Learned = Literal["skeleton", "placements", "rigid"]


class PartSearch:
    """Fits and judges skeletons of a category with these joints."""

    def __init__(self, kinds: Kinds, config: SearchConfig) -> None:
        self.kinds, self.config = kinds, config

    def search(
        self, template: Float[Tensor, "M 3"], clouds: Float[Tensor, "B N 3"]
    ) -> tuple[Skeleton, list[list[float]]]:
        """The start that explains clouds best which it was not fitted to.

        Args:
            template: A shape of the category in the aligned frame.
            clouds: Aligned; of the first half those are fitted that are most like the template, of
                the second they judge. What two clouds of like objects differ by is what moved.

        Returns:
            It, and of each round the misfit of every start, rising.
        """
        c = self.config
        count = max(c.points, len(template))  # of these every point of a shape is given one
        number = torch.arange(count, device=template.device) * len(template) // count
        whole = self.in_one_piece(template[number])
        sides, at = zip(*(self.most_alike(half, whole) for half in clouds.chunk(2)), strict=True)
        starts = self.starts(whole.points, sides[0], at[0])
        said = []
        for count, steps, kept in zip(c.clouds, c.steps, (*c.kept, 1), strict=True):
            fitted, judged = (having(where, [x[:count] for x in values(where)]) for where in at)
            ends = [
                self.descend(sides[0][:count], start, fitted, steps, "skeleton")[0]
                for start in starts
            ]
            few = max(c.placing // 2, steps // 3)
            left = [self.place(sides[1][:count], s, judged, few)[1].mean() for s in ends]
            order = torch.stack(left).argsort().tolist()
            said.append([float(left[k]) for k in order])
            starts = [ends[k] for k in order[:kept]]
        return starts[0], said

    def in_one_piece(self, points: Float[Tensor, "M 3"]) -> Skeleton:
        """A template that is to be placed as a rigid body: its parts are any."""
        some = points[:, 0] > points[:, 0].mean()
        return split_skeleton(points, [some] * len(self.kinds), self.config.spread)

    def most_alike(
        self, clouds: Float[Tensor, "B N 3"], whole: Skeleton
    ) -> tuple[Float[Tensor, "K N 3"], Placements]:
        """The clouds that a rigid template fits best but for what moved, the best first; how."""
        c, joints = self.config, len(self.kinds)
        still = whole.points.expand(len(clouds), -1, -1)
        some = clouds[unlikeness(clouds, still, c.asked // 2).argsort()[: c.alike * c.clouds[-1]]]
        _, at = self.descend(some, whole, motionless(some, joints), c.placing, "rigid")
        order = unlikeness(some, posed(whole, at, self.kinds), c.asked).argsort()[: c.clouds[-1]]
        return some[order], take(at, order)

    def starts(
        self, points: Float[Tensor, "M 3"], clouds: Float[Tensor, "B N 3"], at: Placements
    ) -> list[Skeleton]:
        """Skeletons of all splits.

        Args:
            points: Of the template.
            clouds: Those most like it, the most first.
            at: Its placements in them as one rigid body.
        """
        c, joints, few = self.config, len(self.kinds), self.config.clouds[0]
        shapes = posed(self.in_one_piece(points), at, self.kinds)
        stray = residual(clouds[:few], shapes[:few], points)
        some = splits(points, stray, joints, c.seeds)
        return [split_skeleton(points, children, c.spread) for children in some]

    @torch.enable_grad()
    def descend(
        self,
        clouds: Float[Tensor, "B N 3"],
        s: Skeleton,
        at: Placements,
        steps: int,
        learned: Learned = "placements",
    ) -> tuple[Skeleton, Placements]:
        """Adam on the misfit.

        Args:
            clouds: Aligned frame.
            s: Skeleton.
            at: Where the placements begin.
            steps: How many.
            learned: `placements`; `skeleton`: that too; `rigid`: placements but for the states.
        """
        c, moves, shared = self.config, learned != "rigid", learned == "skeleton"
        at = self.with_best_states(clouds, s, at) if moves else at
        own = [value.clone().requires_grad_() for value in values(at)]
        common = [value.clone().requires_grad_(shared) for value in values(s)]
        learning = own[: None if moves else -2] + common * shared
        rates = [c.rate] * (len(learning) - len(RATES) * shared) + [
            c.rate * rate for rate in RATES
        ] * shared
        groups = [{"params": [one], "lr": rate} for one, rate in zip(learning, rates, strict=True)]
        optimizer = torch.optim.Adam(groups, betas=(0.9, 0.99))
        for k in range(steps):
            s, at = having(s, common), having(at, own)
            if moves and k in (steps // 4, steps // 2):
                own[-1].data.copy_(self.with_best_states(clouds, s, at).state)
            for group, rate in zip(optimizer.param_groups, rates, strict=True):
                group["lr"] = rate * 0.1 ** (k / steps)
            cost = misfit(clouds, posed(s, at, self.kinds), c.asked, k).mean()
            cost = cost + 0.05 * at.size.square().mean() + (held(s, at) if shared else 0.0)
            cost = cost + c.aside * at.aside.square().sum(-1).mean()
            optimizer.zero_grad()
            cost.backward()
            optimizer.step()
        return map_tensors((having(s, common), having(at, own)), Tensor.detach)

    @torch.no_grad()
    def with_best_states(
        self, clouds: Float[Tensor, "B N 3"], s: Skeleton, at: Placements
    ) -> Placements:
        """Each joint's state replaced where one of seven others fits better."""

        def cost(state: Tensor) -> Tensor:
            shapes = posed(s, replace(at, state=state), self.kinds)
            return misfit(clouds, shapes, self.config.asked // 2)

        state = at.state
        for j, kind in enumerate(self.kinds):
            least, best = cost(state), state
            reach = self.config.reach if kind == "revolute" else self.config.reach / 4
            for value in torch.linspace(-reach, reach, 7).tolist():
                other = state.clone()
                other[:, j] = value
                found = cost(other)
                best = torch.where((found < least)[:, None], other, best)
                least = torch.minimum(found, least)
            state = best
        return replace(at, state=state)

    def place(
        self, clouds: Float[Tensor, "B N 3"], s: Skeleton, at: Placements, steps: int
    ) -> tuple[Placements, Float[Tensor, " B"]]:
        """How the skeleton lies in each cloud, and the misfit that is left."""
        found, left = [], []
        for rows in torch.arange(len(clouds), device=clouds.device).split(64):
            _, end = self.descend(clouds[rows], s, take(at, rows), steps)
            with torch.no_grad():
                shapes = posed(s, end, self.kinds)
                left.append(misfit(clouds[rows], shapes, 2 * self.config.asked))
            found.append(end)
        return cat(found), torch.cat(left)
