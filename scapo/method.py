# SPDX-License-Identifier: MIT
"""What the training loop and the benchmark ask of a method, ours or a baseline.

Methods that can be given labels at test time, such as ICP with true parts: declared by type.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, fields, is_dataclass
from functools import partial
from typing import Any, ClassVar, Literal, TypeVar

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from scapo.categories import Category
from scapo.pictures import PictureData
from scapo.types import Labels, Observation, Prediction, Supervision

Mode = Literal["fast", "quick", "refine", "whole"]
T = TypeVar("T")
SEEDS = 2**31  # Of generators


class Journal:
    """What a `start` that takes minutes tells of itself, and keeps in case it is interrupted.

    This one does neither. Training puts one that does in its place (`training.journal`).
    """

    def tell(self, words: str, done: float, left: float) -> None:
        """What begins now.

        Args:
            words: What it is.
            done: Share of the start that is over, in [0, 1].
            left: Seconds that the rest will take, by estimate.
        """

    def once(
        self,
        name: str,
        make: Callable[[], T],
        generator: torch.Generator,
        makers: Mapping[str, Callable[..., Any]],
    ) -> T:
        """What `make` returns, or what it returned before the start was interrupted.

        Steps come in the same order with the same names each time, and draw from `generator` alone.

        Args:
            name: Of the step, no two alike.
            make: Does it.
            generator: Afterwards as it was after the step.
            makers: What makes each kind of record that a step may return (`records.unpack`).
        """
        del name, generator, makers
        return make()

    def ahead(self, jobs: Sequence[Callable[[], T]]) -> Sequence[Callable[[], T]]:
        """What returns the same as the jobs, asked once each and in their order.

        Training may begin on all of them, side by side in several processes, when the first one is
        asked for. So none may need what another does, draw from what another draws from, or be
        without a pickle; what a job changes in place may be a copy.

        Args:
            jobs: What is to be done.
        """
        return jobs


NO_JOURNAL = Journal()


def own_generators(generator: torch.Generator, count: int) -> list[torch.Generator]:
    """Generators on the host, seeded by one, for what is done side by side (`Journal.ahead`)."""
    seeds = torch.randint(SEEDS, (count,), generator=generator, device=generator.device)
    return [torch.Generator().manual_seed(seed) for seed in seeds.tolist()]


def drawing(
    make: Callable[..., T], items: Sequence[Any], rest: tuple[Any, ...], generator: torch.Generator
) -> list[partial[T]]:
    """Jobs to be done side by side: `make` of each item, the rest and a generator of its own."""
    own = own_generators(generator, len(items))
    return [partial(make, item, *rest, one) for item, one in zip(items, own, strict=True)]


@dataclass(frozen=True, slots=True, kw_only=True)
class ParameterGroup:
    """Parameters that a stage trains, by the method's attribute that holds them."""

    module: str
    """Name of a submodule or parameter of the method, "" for all of it."""
    rate: float = 1.0
    """Factor on the stage's learning rate."""
    begin: float = 0.0
    """Share of the stage that passes before these parameters are updated at all."""
    weight_decay: float | None = None
    """None: the stage's."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Adam:
    """Adam; weight decay is added to the gradient."""

    betas: tuple[float, float] = (0.9, 0.999)


@dataclass(frozen=True, slots=True, kw_only=True)
class Sgd:
    """Stochastic gradient descent."""

    momentum: float = 0.9
    nesterov: bool = False


@dataclass(frozen=True, slots=True, kw_only=True)
class HalfCosine:
    """The learning rate on half a cosine from the stage's `lr` to its `min_lr`."""


@dataclass(frozen=True, slots=True, kw_only=True)
class StepDecay:
    """The learning rate times `factor` after every so many epochs, down to the stage's `min_lr`."""

    every: int
    """Epochs."""
    factor: float = 0.5


@dataclass(frozen=True, slots=True, kw_only=True)
class Stage:
    """One run of the optimiser."""

    name: str
    epochs: int
    lr: float
    min_lr: float = 1e-6
    weight_decay: float = 1e-8
    batch: int = 16
    clouds: int | None = None
    """Samples of an epoch: training clouds, evenly spread (`rows`); None: all."""
    parameters: tuple[ParameterGroup, ...] = (ParameterGroup(module=""),)
    optimiser: Adam | Sgd = Adam()
    schedule: HalfCosine | StepDecay = HalfCosine()
    validate_every: int | None = None
    """Epochs between two passes of `validation_loss` over clouds that are not trained on; the
    stage then ends with the state of the least. None: it ends with its last."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Step:
    """Where in the training a batch is, what it holds, and the randomness it may use."""

    stage: str
    progress: float
    """Share of the stage that is done, in [0, 1)."""
    generator: torch.Generator
    """On the device of the batch; the only source of randomness in `losses`."""
    index: Int[Tensor, " B"]
    """Which samples these are: rows of all clouds that `start` saw (of the validation clouds in
    `validation_loss`), on the device of the batch."""
    total: int
    """How many clouds those are."""


def evenly(total: int, count: int | None) -> Int[Tensor, " K"]:
    """Indices spread over the whole; all where there are no more than `count`, or for None."""
    if count is None or total <= count:
        return torch.arange(total)
    return torch.linspace(0, total - 1, count).long()


def changes(
    config: Any,  # noqa: ANN401 - a dataclass
    default: Any,  # noqa: ANN401
    leave: Collection[str] = (),
) -> list[str]:
    """Options of a configuration that differ from the default, as words of a variant's name.

    Sizes, counts and schedules (whole numbers, tuples of numbers) make no other variant.

    Args:
        config: A dataclass, of dataclasses perhaps.
        default: Another of the same type.
        leave: Dotted names of fields that do not count.

    >>> from scapo.registered.config import DiscoveryConfig
    >>> changed = DiscoveryConfig(draws=1, axis_weight=0.0, way_out=False)
    >>> changes(changed, DiscoveryConfig(), leave=["axis_weight"])
    ['way_out=False']
    """
    words = []
    for name in (f.name for f in fields(config)):
        here, there = getattr(config, name), getattr(default, name)
        if name in leave or here == there or _counts(here):
            continue
        if is_dataclass(here):
            below = [x.removeprefix(f"{name}.") for x in leave]
            words += [f"{name}.{word}" for word in changes(here, there, below)]
        else:
            words.append(f"{name}={here}")
    return words


def _counts(value: object) -> bool:
    if isinstance(value, tuple):
        return all(isinstance(one, int | float) for one in value)
    return isinstance(value, int) and not isinstance(value, bool)


class AbstractMethod(nn.Module, ABC):
    """A method of articulated pose estimation for one category.

    `fit.fit` calls `losses` with `labels.keep(method.supervision)`: what the method does not
    declare arrives as None, so a label cannot leak. `predict` sees an Observation alone.
    """

    name: ClassVar[str]
    networks: ClassVar[tuple[str, ...]] = ()
    """Submodules whose forward passes may run in reduced precision or compiled (`precision`)."""
    usual: ClassVar[Mode] = "fast"
    """The mode in which users are answered who ask for none."""
    least_points: int = 1
    """Points that a cloud needs to be predicted at all."""
    least_batch: ClassVar[int] = 1
    """Clouds that a step of training needs: a norm over clouds alone has nothing to say of one."""
    takes_up: ClassVar[bool] = False
    """Whether it uses `Observation.up`."""
    up: tuple[float, ...] | None = None
    """Which way is up in the first part's own frame, where labels told (`Alignment.up`)."""
    config: Any
    """A frozen dataclass; stored in checkpoints."""
    category: Category
    supervision: frozenset[Supervision]
    camera: bool | None = None
    """Whether training or prediction uses where the camera stands; None: as its registry line."""
    journal: Journal = Journal()
    """Of the `start` that is going on."""

    @property
    @abstractmethod
    def variant(self) -> str:
        """How this run differs from the method's default, as tables name it; "" = it does not."""

    def axes(self) -> Float[Tensor, "J 3"] | None:
        """Unit directions of its joints in the first part's own frame, if they never differ."""
        return None

    @abstractmethod
    def stages(self) -> tuple[Stage, ...]:
        """The stages of training, in order; none for a method without parameters."""

    @abstractmethod
    def start(
        self, stage: str, observation: Observation, labels: Labels, generator: torch.Generator
    ) -> None:
        """Prepare a stage from the whole training split, such as a template from its medoid.

        Called once at the beginning of each stage, not again on resume: what it sets must be
        in the state dict, or found again by `recall`. A method without stages is called once,
        with stage "". One that takes long tells `self.journal` how far it is, and has it keep
        what each of its steps made.

        Args:
            stage: Its name.
            observation: All training clouds, camera frame, metres.
            labels: As allowed by `supervision`.
            generator: On the device of the clouds.
        """

    def recall(self, stage: str, observation: Observation, generator: torch.Generator) -> None:
        """Have at hand what `losses` need beside the state dict; nothing by default.

        Called before the epochs of each stage that are left, after `start` and on resume, in every
        process of a training; what it finds depends on neither. `self.journal` is there as in
        `start`, from the first process alone.

        Args:
            stage: Its name.
            observation: All training clouds, as in `start`.
            generator: For the journal; nothing is drawn from it.
        """
        del stage, observation, generator

    def rows(self, stage: Stage, total: int) -> Int[Tensor, " K"]:
        """Which of so many training clouds a stage that was started learns from, one or more.

        An epoch has `stage.clouds` samples all the same; fewer rows come again in it.
        """
        return evenly(total, stage.clouds)

    @abstractmethod
    def losses(self, observation: Observation, labels: Labels, step: Step) -> dict[str, Tensor]:
        """Weighted scalar terms of the loss; their sum is minimised.

        Args:
            observation: A batch, camera frame, metres.
            labels: As allowed by `supervision`.
            step: Stage, progress, samples and randomness.
        """

    def validation_loss(self, observation: Observation, labels: Labels, step: Step) -> Tensor:
        """How badly the method does on clouds that it is not trained on: a scalar to be small.

        Called in eval mode without gradients, with the same random numbers each time; by default
        the sum of `losses`.

        Args:
            observation: A batch of validation clouds, camera frame, metres.
            labels: As allowed by `supervision`.
            step: Stage, progress, samples and randomness.
        """
        return torch.stack(list(self.losses(observation, labels, step).values())).sum()

    @abstractmethod
    def predict(self, observation: Observation, mode: Mode = "fast") -> Prediction:
        """Parts, poses and joints of a batch, in metres and the camera frame.

        Args:
            observation: A batch, camera frame, metres.
            mode: `fast`, networks only; `refine`, with search or optimisation at test time;
                `quick`, with a little of it; `whole`, for clouds that show all of an object, not
                the side that a camera sees. A method that knows no such way takes the one it
                knows in all modes.
        """

    def strip(self) -> None:
        """Let go of what training alone needs, before the model is released; nothing by default."""

    def pictures(self, observation: Observation, stage: str) -> dict[str, PictureData]:
        """What training shows of its progress, by name: a template, reconstructions, nothing.

        Called in eval mode without gradients, with the same few training clouds each time. It
        must not change the method nor draw random numbers.

        Args:
            observation: A batch, camera frame, metres.
            stage: In which training is, or which has ended.
        """
        del observation, stage
        return {}


class OracleMethod(AbstractMethod):
    """A method that can also answer with true labels of the test split in hand.

    Only `predict --oracle` shows it any, and only `labels.keep(oracle)`. The predictions file then
    says `oracle-...` in its variant, and so does the row of every table.
    """

    oracle: frozenset[Supervision]
    """The labels that it can use."""

    @abstractmethod
    def predict_given(self, observation: Observation, labels: Labels) -> Prediction:
        """As `predict`, with the labels that `oracle` names."""
