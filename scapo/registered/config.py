# SPDX-License-Identifier: MIT
"""What can be chosen of template registration: the search for the template, and all after it."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Annotated, ClassVar, Literal

from scapo.categories import Category
from scapo.ranges import CountOrNone, Range, Share
from scapo.registered.joint_limits import RANGE_COST

LEAST_ROTATIONS = 200
"""Of a grid: with fewer, registration would have no choice of those that it scores twice."""
DISSENT, OBJECTS_DISSENT = 0.2, 1.0
"""Of a network that learned the best of each view; of one that learned how objects stand."""


@dataclass(frozen=True, slots=True, kw_only=True)
class TemplateConfig:
    """How dense a template is, and over what it is searched for."""

    rotations: int = 1000
    """Rotations of the grid that registration and search try, at least 200."""
    final_points: int = 1600
    """Points of the template that is found; its parts end as sharply as it is dense."""

    def __post_init__(self) -> None:
        """Raise ValueError for a grid too coarse to rank its rotations."""
        if self.rotations < LEAST_ROTATIONS:
            raise ValueError(
                f"rotations: expected at least {LEAST_ROTATIONS}, found {self.rotations}"
            )


@dataclass(frozen=True, slots=True, kw_only=True)
class DiscoveryConfig(TemplateConfig):
    """How the template is found, and how much is tried; times are of one CPU core."""

    RETIRED: ClassVar[tuple[str, ...]] = ("further_objects", "further_views")
    """Fields that checkpoints of earlier versions have."""

    seeds: int = 72
    """Views registered with one another in each draw, 10 ms a pair."""
    agreeing: Share = 0.4
    """Share of the registered views, the most confident, that the first fit uses."""
    searched: int = 144
    """Views that the rounds of search and fit use, 0.2 s each and round."""
    trusted: tuple[Share, ...] = (0.55, 0.7, 0.85)
    """Share of the searched views, the most confident, that each round keeps as inliers; the first
    round is on half of the views where mirror images are tried."""
    starts: int = 3
    """Proposed axes of each joint that are fitted; two of each where joints are several."""
    draws: int = 3
    """Draws of views to register: how many of their poses agree is a matter of luck. Where it is
    known which views show one object, draws of objects (4 at most), each registered once."""
    objects: int = 24
    """Objects of which views are registered with one another."""
    object_views: int = 20
    """Views of each of them."""
    contenders: int = 2
    """First templates of each draw, those of least loss, that held-out views judge."""
    finalists: int = 3
    """First templates that enter the rungs, those that explain the held-out views best."""
    dense_rounds: int = 4
    """Of building the dense template and fitting it, 5 s each: axes settle in them."""
    heats: Annotated[tuple[float, ...], Range(0, 1, many=(0, 9))] = (0.4, 0.55)
    """Share of inliers in each rung of these, on half of the views; then the best goes on alone."""
    judged: int = 48
    """Views held out to judge templates, at most a quarter of all."""
    range_cost: float = RANGE_COST
    """Mean loss that a radian of a joint's range must save; 0: any joint limits."""
    askew_cost: float = 0.05
    """Mean loss that two joints of one kind must save whose axes are at right angles: those of made
    things are mostly parallel; 0: nothing."""
    axis_weight: float = 1.0
    """Pull of the axes to the main directions of the base once a template is chosen (before, wrong
    axes must be free to turn) and where the base has two of them; 0: none."""
    held_frame: bool = True
    """Turn the template's frame to the main directions of its base in every round."""
    way_out: bool = True
    """Take the way out of the body for a sliding joint's axis."""
    mirror: bool = True
    """Try whether the base lacks a side that is the mirror image of another, and whether one of two
    parts is the other's."""
    halves: bool = True
    """Try whether the two parts of a hinge are halves that are alike."""
    leans: bool = True
    """Try whether the axes of hinges deviate from one object to the next."""
    template_points: int = 400
    """Points of the template while it is sought."""
    together: bool = True
    """Count what the views of all known objects say among the votes of each; where a symmetry
    exchanges parts objects are read in two ways, and each votes alone, or none where it exchanges
    the base with a part and cameras stand before the object."""
    standing: bool = True
    """Learn how objects stand, and charge hypotheses by it, where the network learns candidates
    that stand as their objects do. Elsewhere its word and the loss tell better."""

    def __post_init__(self) -> None:
        """Raise ValueError where the dense template would never be built, or the grid is coarse."""
        TemplateConfig.__post_init__(self)
        if self.dense_rounds < 1:
            raise ValueError(f"dense_rounds: expected at least 1, found {self.dense_rounds}")


@dataclass(frozen=True, slots=True, kw_only=True)
class SearchConfig:
    """A template, the network that votes for its placement, and the search at test time."""

    discovery: TemplateConfig = field(default_factory=TemplateConfig)
    """The template."""
    learned: int = 600
    """Training clouds in which the template is searched for thoroughly, 0.1 s each on one core."""
    trusted: Share = 0.85
    """Share of those clouds, the most confidently placed, that tell states, cameras and looks, and
    of the placed ones from which the network learns."""
    placed: int = 2000
    """Training clouds in which the template is then searched for as `quick` does, 0.08 s each."""
    of_objects: int = 5000
    """The same where objects say how they stand (`stand`): views of one object correct each other,
    and of drawers more of them teach more. The network then takes as many steps in fewer epochs."""
    rounds: int = 2
    """How often that is done, and the network taught: from the second time on its word counts."""
    epochs: int = 30
    """Epochs of the network in the last round, and twice those of a round before, which has to tell
    no more than how clouds are placed anew."""
    lr: float = 2e-3
    """Learning rate of the network at the beginning; it falls to a hundredth on half a cosine."""
    batch: int = 32
    """Clouds of one step of the network's optimiser."""
    looks: int = 4
    """Rolls about its ray in which the network sees a cloud when it is asked."""
    channels: int = 16
    """Of the network's finest level; 16 gives 0.5 million parameters."""
    width: int = 48
    """Of the layers of the network that is asked where nobody knows the camera."""
    points: int = 256
    """Points of each cloud that the network and the search see."""
    grid_hypotheses: CountOrNone = 16
    """Placements of each cloud that `refine` begins with beside the network's: half of them as of
    clouds that look alike and were placed in training, half as of images of the template. 0: the
    network's alone."""
    quick_beside: int = 0
    """Of these, those with which `quick` begins beside the network's, of 32 that stand as objects
    do."""
    quick_hypotheses: int = 6
    """Such placements with which the search begins before there is a network."""
    strays: Literal["out", "kept"] = "out"
    """Whether outliers, points that do not belong to the object, are left out."""
    dissent: float | None = None
    """Loss that a part of a hypothesis costs which is turned another way than the network says,
    where the network's votes agree; None: 0.2, or 1 for one that learned how objects stand, which
    knows better than the loss."""
    settle: bool = True
    """Try all states again for the placement that won, where no network says what they are."""
    camera: Literal["known", "estimated"] = "known"
    """Whether the camera is known, or another network, in the principal frames of the learned
    clouds, has to say where it is."""

    def __post_init__(self) -> None:
        """Raise ValueError where the network would never be taught."""
        for name in ("rounds", "looks"):
            if (number := getattr(self, name)) < 1:
                raise ValueError(f"{name}: expected at least 1, found {number}")


@dataclass(frozen=True, slots=True, kw_only=True)
class RegisteredConfig(SearchConfig):
    """Template registration, a method of ours: finds an articulated template without labels."""

    discovery: DiscoveryConfig = field(default_factory=DiscoveryConfig)
    """The search for the template."""
    supervision: tuple[Literal["instance"], ...] = ()
    """What is known of the training clouds: nothing, or which of them show the same object."""
    start: str | None = None
    """A run or checkpoint of the same category whose template, and what it learned of views, is
    taken, so that the network alone is trained. None: a template is found."""
    teach: Literal["all", "hinges"] = "all"
    """What of the network learns: all, or nothing but where the hinges of objects sit, which models
    that were not told instances do not know (with `start`; a few epochs of one round)."""
    stand: Literal["auto", "views", "objects"] = "auto"
    """What of the candidates the network learns: the best of each view, or, where it is known which
    clouds show the same object and no symmetry exchanges its parts, those that stand as the object
    does in all of its views. auto: objects where a part slides, since a box with a drawer explains
    a view in several ways."""
    preset: Literal["cpu", "quick"] = "cpu"
    """Where the other defaults come from; quick: a training of two minutes, for trying things."""

    def __post_init__(self) -> None:
        """Raise ValueError where hinges alone are to be taught and cannot be."""
        SearchConfig.__post_init__(self)
        known = self.start is not None and "instance" in self.supervision
        if self.teach == "hinges" and not (known and self.camera == "known"):
            raise ValueError("teach: expected start, supervision instance and a known camera")


def decided(config: RegisteredConfig, category: Category) -> RegisteredConfig:
    """The configuration with what it leaves open decided for the joints of a category."""
    stand, price = config.stand, config.dissent
    if stand == "auto":
        slides = any(joint.kind == "prismatic" for joint in category.joints)
        stand = "objects" if slides and "instance" in config.supervision else "views"
    if price is None:
        price = OBJECTS_DISSENT if stand == "objects" else DISSENT
    together = config.discovery.together and category.symmetry is None
    standing = config.discovery.standing and stand == "objects"
    discovery = replace(config.discovery, together=together, standing=standing)
    return replace(config, stand=stand, dissent=price, discovery=discovery)


def cpu_config() -> RegisteredConfig:
    """Trains one category in 9 to 14 minutes on two cores, where a part slides in longer."""
    return RegisteredConfig()


def quick_config() -> RegisteredConfig:
    """For trying things: trains one category in less than two minutes on two cores."""
    discovery = DiscoveryConfig(
        seeds=32, searched=48, trusted=(0.6, 0.85), starts=2, draws=2, objects=8, object_views=12,
        contenders=1, heats=(), judged=16, mirror=False, halves=False, leans=False,
        final_points=800, dense_rounds=1,
    )  # fmt: skip
    return RegisteredConfig(
        preset="quick",
        discovery=discovery,
        learned=120,
        placed=240,
        of_objects=240,
        rounds=1,
        epochs=10,
    )


PRESETS = {"cpu": cpu_config, "quick": quick_config}
UNNAMED = ("lr", "supervision", "preset", "start", "teach")
"""Fields that a variant is not named after, or not by their values."""
