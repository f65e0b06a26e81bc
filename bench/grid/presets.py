# SPDX-License-Identifier: MIT
"""What the presets of `run` train and score, as data: which method on which part, how, how often.

Rates and times were measured on one core of two (results/experiments); they serve the estimate
and, through the budget, the epochs of methods that a preset does not bound.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Literal

from bench.requests import Mode

PresetName = Literal["smoke", "cpu", "paper"]
SINGLE, SENSOR = ("laptop", "safe", "eyeglasses", "oven", "washer"), (
    "basket", "drawer", "laptop", "scissors", "suitcase",
)  # fmt: skip
CATEGORIES: Mapping[str, tuple[str, ...]] = {
    "clean": SINGLE,
    "complete": SINGLE,
    "isolated": SINGLE,
    "sensor": SENSOR,
}
"""Of each part that is trained on."""
REAL = {**dict.fromkeys(SENSOR, "sensor"), **dict.fromkeys(SINGLE, "clean")}
"""Part whose models are shown the real objects of a category."""
ABLATED = ("shape-var", "dir-align", "joint-prox", "joint-boundary")
"""Terms of the loss that Table 3 leaves out, one at a time."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Entry:
    """A method in one configuration, on some parts."""

    method: str
    name: str = ""
    """Of this configuration in names of files; by default the method's."""
    preset: str = ""
    """Of the method; by default the one that goes with the grid's."""
    start: tuple[str, ...] = ()
    """Of the training: names of a released model that `--start` names, the first that is there."""
    models: tuple[str, ...] = ()
    """In place of a training: names of a released model, the first that is there."""
    flags: tuple[str, ...] = ()
    """Of `train`."""
    seeds: tuple[int, ...] = (1,)
    modes: tuple[Mode, ...] = ("fast",)
    parts: tuple[str, ...] = ("clean", "complete", "sensor")
    rates: tuple[float, ...] = ()
    """Training clouds a second in each stage; () for a training that no epochs bound."""
    shares: tuple[float, ...] = ()
    """Of a budget, for each stage; () for equal ones."""
    training: float | None = None
    """Seconds of such a training; None: not known."""
    seconds: Mapping[str, float] = field(default_factory=dict[str, float])
    """Of one cloud, by mode."""

    @property
    def label(self) -> str:
        """What files call it."""
        return self.name or self.method


@dataclass(frozen=True, slots=True, kw_only=True)
class Preset:
    """A grid and its data."""

    entries: tuple[Entry, ...]
    categories: Mapping[str, tuple[str, ...]] = field(default_factory=lambda: CATEGORIES)
    splits: tuple[str, ...] = ("test", "test-ood")
    """Scored unless asked otherwise."""
    budget: float | None = None
    """Minutes of one training; None: each method's own preset decides."""
    calibration: int = 200
    """Training clouds that fix the frames of a method that saw no poses."""
    sizes: Mapping[str, tuple[int, int]] | None = None
    """Samples and objects by split of data made here; None: the benchmark's."""


THREE = (1, 2, 3)
NETWORKS = (
    Entry(method="gcn3d", rates=(183,), seconds={"fast": 0.025}),
    Entry(method="pointnet2", rates=(155,), seconds={"fast": 0.03}),
    Entry(method="npcs-epn", rates=(29,), seconds={"fast": 0.03}, parts=("clean", "complete")),
    Entry(method="icp", training=30, seconds={"fast": 0.42}, parts=("clean", "complete")),
    # As near to 60 % of 20 minutes for the first stage as whole epochs of 5,000 clouds come.
    Entry(method="eap", rates=(30, 19), shares=(0.56, 0.44), seconds={"fast": 0.1},
          parts=("clean", "complete", "isolated")),
    Entry(method="op-align", seeds=THREE, rates=(34,), seconds={"fast": 0.018}),
    Entry(method="op-align", name="op-align-isolated", rates=(34,), seconds={"fast": 0.018},
          parts=("isolated",)),
    Entry(method="scapo", seeds=THREE, rates=(115, 105), seconds={"fast": 0.01},
          parts=("clean", "sensor")),
    # Searches parts and joints on whole surfaces before its second stage.
    Entry(method="scapo", name="scapo-complete", preset="complete", seeds=THREE, rates=(115, 105),
          seconds={"fast": 0.01}, parts=("complete",)),
    Entry(method="scapo", name="scapo-isolated", rates=(115, 105), seconds={"fast": 0.01},
          parts=("isolated",)),
)  # fmt: skip
REGISTERED = Entry(
    method="registered",
    seeds=THREE,
    parts=("clean", "sensor"),
    modes=("fast", "quick", "refine"),
    training=1300,
    seconds={"fast": 0.03, "quick": 0.04, "refine": 0.1},
)
TOLD = replace(REGISTERED, name="registered-objects", flags=("--supervision", "instance"))
"""The same, told which clouds show the same object, as the released models were."""
RELEASED = replace(REGISTERED, name="released", seeds=(1,), training=0,
                   models=("{category}/{part}", "{category}"))  # fmt: skip
"""What users get: the models that come with the package, in the frame that they answer in."""
WHOLE = replace(RELEASED, parts=("complete",), modes=("whole",), seconds={"whole": 0.35})
"""The same models, which learned single views, asked about whole surfaces."""
RELEASED_SCAPO = Entry(method="scapo", name="released-warm", models=("{category}/scapo",),
                       parts=("clean",), training=0, modes=("fast", "refine"),
                       seconds={"fast": 0.01, "refine": 0.15})  # fmt: skip
"""The paper's networks, warm start, as they come with the package."""
BOUND = Entry(method="registered-labelled", parts=("clean", "sensor"), modes=("refine",),
              training=300, seconds={"refine": 0.35})  # fmt: skip
"""What its search can do at best, with a template of true placements."""
WARM = Entry(method="scapo", name="scapo-warm", preset="warm", seeds=THREE, start=RELEASED.models,
             flags=("--supervision", "instance"), parts=("clean", "sensor"), training=1000,
             modes=("fast", "refine"), seconds={"fast": 0.01, "refine": 0.15})  # fmt: skip
"""The paper's networks, begun at what a released model says, which was told which clouds show the
same object: SCAPO, warm start."""
WARM_WHOLE = replace(
    WARM, name="scapo-warm-complete", parts=("complete",), seeds=(1,), training=1500,
    flags=(*WARM.flags, "--loss.recon-form", "squared", "--told-of", "surfaces", "--told", "1000",
           "--epochs", "60", "2"),
)  # fmt: skip
"""The same on whole surfaces."""
LABELLED = (
    Entry(method="op-align", name="op-align-sj", parts=("sensor",), rates=(34,),
          flags=("--supervision", "segmentation", "joint"), seconds={"fast": 0.02}),
    replace(WARM, name="scapo-warm-sj", parts=("sensor",), seeds=(1,),
            flags=("--supervision", "segmentation", "joint", "instance")),
)  # fmt: skip
"""The semi-supervised rows of Table 2."""
FULL = replace(WARM, name="scapo-full", parts=("clean",), seeds=(1,),
               flags=(*WARM.flags, "--loss.dir-align", "0.1"))  # fmt: skip
ABLATIONS = (FULL, *(
    replace(FULL, name=f"scapo-wo-{term}",
            flags=(*FULL.flags, "--loss.without", term.replace("-", "_")))
    for term in ABLATED
))  # fmt: skip
"""Of Table 3, in the setting in which the method works on single views, with all four terms: `warm`
has no L_dir-align."""
GRID = (*NETWORKS, RELEASED, WHOLE, RELEASED_SCAPO, REGISTERED, TOLD, WARM, WARM_WHOLE,
        *LABELLED, BOUND, *ABLATIONS)  # fmt: skip

PRESETS: Mapping[PresetName, Preset] = {
    "smoke": Preset(
        entries=(
            Entry(method="pointnet2", parts=("clean",), rates=(100,), seconds={"fast": 0.05}),
            Entry(method="icp", parts=("clean",), training=6, seconds={"fast": 0.5}),
            Entry(method="scapo", parts=("clean",), rates=(60, 60), seconds={"fast": 0.02}),
        ),
        categories={"clean": ("oven",)},
        splits=("test",),
        budget=0.1,
        calibration=16,
        sizes={"train": (96, 6), "val": (16, 4), "test": (16, 4), "test-ood": (16, 4)},
    ),
    "cpu": Preset(entries=GRID, budget=20.0),
    "paper": Preset(entries=GRID),
}


def flags_of(entry: Entry, preset: str | None, minutes: float | None, clouds: int) -> list[str]:
    """The flags of `train` that give an entry its configuration.

    Args:
        entry: The method.
        preset: Its own preset, where it has such a flag.
        minutes: Budget. Within one a method has as many epochs as it holds, its time in the
            entry's shares for the stages, at least one each; without, its own.
        clouds: Of the training.

    >>> flags_of(Entry(method="eap", rates=(10, 5)), "cpu", 20.0, 500)
    ['--preset', 'cpu', '--epochs', '12', '6']
    """
    words = [*(() if preset is None else ("--preset", preset)), *entry.flags]
    if minutes is None or not entry.rates:
        return words
    shares = entry.shares or (1 / len(entry.rates),) * len(entry.rates)
    seen = [minutes * 60 * s * rate / clouds for s, rate in zip(shares, entry.rates, strict=True)]
    return [*words, "--epochs", *(str(max(1, int(epochs))) for epochs in seen)]


def training_seconds(entry: Entry, flags: list[str], clouds: int) -> float | None:
    """The estimate for a training with such flags; None where nothing was measured."""
    if not entry.rates or "--epochs" not in flags:
        return entry.training
    epochs = map(int, flags[flags.index("--epochs") + 1 :])
    return sum(count * clouds / rate for count, rate in zip(epochs, entry.rates, strict=True))
