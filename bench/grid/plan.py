# SPDX-License-Identifier: MIT
"""The plan of a grid: every command that `run` would give, with digests of code and data.

A chain is one training and all that is made of it, one command after the other. Written to
`plan.json` before any test split is scored, and held against what would be done today: so a reader
of the scores knows that nothing was chosen by them.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, fields, replace
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any, Literal, cast

import tyro

from bench.grid.presets import PRESETS, REAL, Entry, Preset, PresetName, flags_of, training_seconds
from bench.methods import METHODS
from bench.requests import Mode
from scapo.released import weights
from scapo.store import StoreError, canonical_json, sha256_bytes, sha256_file, write_bytes
from scapo.store.json_records import read_json, readable_json
from scapo.store.manifest import read_manifest
from scapo.store.provenance import PACKAGE, commit
from scapo.text import UsageError

FORMAT = "scapo-plan/1"
PLAN = "plan.json"
SIZES = {"train": 5000, "val": 1000, "test": 1000, "test-ood": 800}
"""Samples of the benchmark's splits, for estimates before they are there."""
SCORABLE = ("val", "test", "test-ood")
"""Predictions on `train` are for frames, not for scores."""
SCORING = 25.0
"""Seconds that `evaluate` takes, with the readings beside it, for a thousand samples."""
START = 4.0
"""Seconds that any command takes to start."""
REAL_VIEWS = 200
"""Samples of a category's real models, for estimates before they are there."""
FROZEN = ("format", "preset", "budget_minutes", "configs", "chains", "code")
"""What must be as it was when the plan was written, with the data that were there."""

Kind = Literal["train", "predict", "evaluate", "explain", "pictures"]


SCORED: tuple[Kind, ...] = ("evaluate",)
LOOKED_AT: tuple[Kind, ...] = ("evaluate", "explain", "pictures")
"""What is made of predictions, of those on `test` by the first seed in its last mode more."""
SUFFIX = ".safetensors"


@dataclass(frozen=True, slots=True, kw_only=True)
class Step:
    """One command of `scapo-bench`."""

    kind: Kind
    name: str
    """Unique in its chain, such as predict-fast-test."""
    command: tuple[str, ...]
    """Verb and flags; {data} and {out} stand for the folders."""
    output: str
    """The file that it makes, relative to the folder of the run."""
    needs: tuple[str, ...] = ()
    """Steps before it in the chain."""
    reads: tuple[str, ...] = ()
    """Splits, PART/CATEGORY/SPLIT."""
    model: str = ""
    """SHA-256 of the released model that it asks or begins at; "" where there is none."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Chain:
    """One training or released model, and what is made of it."""

    part: str
    category: str
    label: str
    """Of the method's configuration."""
    seed: int
    steps: tuple[Step, ...]

    @property
    def name(self) -> str:
        """PART/CATEGORY/LABEL/seedN."""
        return "/".join((self.part, self.category, self.label, f"seed{self.seed}"))


@dataclass(frozen=True, slots=True, kw_only=True)
class Plan:
    """What a preset comes to."""

    preset: PresetName
    budget_minutes: float | None
    configs: Mapping[str, Any]
    """Whole configuration of each label's method."""
    chains: tuple[Chain, ...]
    data: Mapping[str, str | None]
    """Digest of each split that is read; None: not there yet."""
    code: str
    """SHA-256 over the Python files of the three packages."""
    commit: str
    seconds: Mapping[tuple[str, str], float | None]
    """Estimate for each step, by names of chain and step; no part of the file."""

    def to_json(self) -> dict[str, Any]:
        """As `plan.json` has it, with the digest over all else but the commit."""
        body = {name: value for name, value in asdict(self).items() if name != "seconds"}
        plain: dict[str, Any] = json.loads(canonical_json({**body, "format": FORMAT}))
        return {**plain, "digest": digest_of(plain)}


def digest_of(plan: Mapping[str, Any]) -> str:
    """The digest of a plan as JSON: a commit that only adds the plan's own file changes nothing."""
    body = {name: value for name, value in plan.items() if name not in ("commit", "digest")}
    return sha256_bytes(canonical_json(body).encode())


def code_digest() -> str:
    """SHA-256 over names and bytes of the Python files of the three packages, committed or not."""
    top = PACKAGE.parent
    files = [path for name in ("bench", "scapo", "sim_assets")
             for path in sorted((top / name).rglob("*.py"))]  # fmt: skip
    named = [[path.relative_to(top).as_posix(), sha256_file(path)] for path in files]
    return sha256_bytes(canonical_json(named).encode())


def make_plan(
    name: PresetName,
    data: Path,
    *,
    minutes: float | None = None,
    splits: Sequence[str] = (),
    presets: Mapping[PresetName, Preset] = PRESETS,
) -> Plan:
    """Everything that a preset asks for, whatever is done of it already.

    Args:
        name: The preset.
        data: Folder of the data, PART/CATEGORY/SPLIT.
        minutes: Budget of a training, in place of the preset's.
        splits: To score, in place of the preset's.
        presets: Where the preset is.

    Raises:
        StoreError: Damaged data.
        ValueError: A split that is none, or that of the training.
    """
    for split in splits:
        if split not in SCORABLE:
            raise ValueError(f"--splits: expected some of {', '.join(SCORABLE)}, found {split!r}")
    preset = presets[name]
    preset = replace(preset, splits=tuple(splits) or preset.splits,
                     budget=preset.budget if minutes is None else minutes)  # fmt: skip
    maker = _Maker(name, preset, data)
    chains = tuple(maker.chains())
    return Plan(
        preset=name, budget_minutes=preset.budget, configs=maker.configs, chains=chains,
        data=maker.data, code=code_digest(), commit=commit(), seconds=maker.seconds,
    )  # fmt: skip


class _Maker:
    """Makes the chains; notes what they read, how they are configured and what they cost."""

    def __init__(self, name: PresetName, preset: Preset, folder: Path) -> None:
        self.grid: PresetName = name
        self.preset, self.folder = preset, folder
        self.configs: dict[str, Any] = {}
        self.data: dict[str, str | None] = {}
        self.counts: dict[str, int] = {}
        self.seconds: dict[tuple[str, str], float | None] = {}

    def chains(self) -> Iterator[Chain]:
        """Seeds outermost: the first of every method is there before the second of any."""
        for seed in sorted({seed for entry in self.preset.entries for seed in entry.seeds}):
            for part, categories in self.preset.categories.items():
                for entry in self.preset.entries:
                    if part in entry.parts and seed in entry.seeds:
                        for category in categories:
                            names = entry.models or entry.start
                            if not names or released_model(names, part, category):
                                yield self.chain(entry, part, category, seed)

    def chain(self, entry: Entry, part: str, category: str, seed: int) -> Chain:
        """Training, then for each mode the frames and every split that is scored."""
        place = f"{part}/{category}"
        steps, costs = list[Step](), dict[str, float | None]()
        if entry.models:
            self.configs[entry.label] = {"method": entry.method, "models": list(entry.models)}
        else:
            step, costs["train"] = self.training(entry, place, seed)
            steps.append(step)
        scored = [f"{place}/{split}" for split in self.preset.splits
                  if part != "isolated" or split != "test-ood"]  # fmt: skip
        if self.preset.sizes is None and "test" in self.preset.splits and self.has_real(place):
            scored.append(f"real/{category}/test")
        for mode in entry.modes:
            for step, clouds in self.of_mode(entry, mode, place, seed, scored):
                steps.append(step)
                read = step.kind != "predict"
                each = SCORING / 1000 if read else entry.seconds.get(mode, 0.0)
                costs[step.name] = START + clouds * each
        chain = Chain(part=part, category=category, label=entry.label, seed=seed,
                      steps=tuple(steps))  # fmt: skip
        self.seconds |= {(chain.name, step): cost for step, cost in costs.items()}
        return chain

    def training(self, entry: Entry, place: str, seed: int) -> tuple[Step, float | None]:
        """The training of an entry into a run folder of its own, and its estimate."""
        part, category = place.split("/")
        clouds = self.count(f"{place}/train")
        folder = f"runs/{part}/{name_of(entry, category, seed)}"
        preset, default = own_preset(entry.method, self.grid, entry.preset)
        flags = flags_of(entry, preset, self.preset.budget, clouds)
        begun = released_model(entry.start, part, category)
        step = Step(
            kind="train", name="train", output=f"{folder}/checkpoint.safetensors",
            command=("train", entry.method, "--category", category, "--data", f"{{data}}/{part}",
                     "--out", f"{{out}}/{folder}", "--seed", str(seed), "--resume", *flags,
                     *(("--start", begun[0]) if begun else ())),
            reads=(f"{place}/train",), model=sha256_file(begun[1]) if begun else "",
        )  # fmt: skip
        if entry.label not in self.configs:
            config = configuration(entry.method, default, flags)
            start = {"start": list(entry.start)} if begun else {}
            self.configs[entry.label] = config | start
        return step, training_seconds(entry, flags, clouds)

    def of_mode(
        self, entry: Entry, mode: Mode, place: str, seed: int, scored: Sequence[str]
    ) -> Iterator[tuple[Step, int]]:
        """Predictions and scores of one mode, with the number of clouds of each step."""
        (part, category), frames = place.split("/"), ""
        name = name_of(entry, category, seed)
        model = released_model(entry.models, part, category)
        if "pose" not in METHODS[entry.method].supervision and model is None:
            frames = f"predict-{mode}-train"
            limit = self.preset.calibration
            yield self._predict(f"{place}/train", mode, part, name, limit), limit
        for split in scored:
            clouds = self.count(split)
            predicted = self._predict(split, mode, part, name)
            if model is not None:
                predicted = of_model(predicted, entry.label, *model)
            yield predicted, clouds
            best = seed == 1 and mode == entry.modes[-1]
            looked = LOOKED_AT if best and split.endswith("/test") else SCORED
            for kind in looked:
                yield self._about(kind, predicted, split, frames), clouds

    def _about(self, kind: Kind, predicted: Step, split: str, frames: str) -> Step:
        """A step that reads predictions: their scores, why they are so, what they look like."""
        above, _, name = split.split("/")
        run, stem = Path(predicted.command[1]), Path(predicted.output).name.removesuffix(SUFFIX)
        where = predicted.name.removeprefix("predict-")
        folder = {"evaluate": "scores", "explain": "ladders", "pictures": "pictures"}[kind]
        out = f"{folder}/{above}/{stem}"
        file = {"evaluate": ".csv.gz", "explain": "/ladder.md", "pictures": "/ranking.png"}[kind]
        trained = Path(predicted.output).with_name(stem.removesuffix(where) + frames[8:] + SUFFIX)
        return Step(
            kind=kind, name=f"{kind}-{where}", output=f"{out}{file}", reads=(split,),
            command=(kind, *((str(run),) if kind == "pictures" else ()), "--predictions",
                     f"{{out}}/{predicted.output}",
                     *(("--calibration", f"{{out}}/{trained}") if frames else ()),
                     "--data", f"{{data}}/{above}", "--split", name, "--out",
                     f"{{out}}/{out}{file if kind == 'evaluate' else ''}"),
            needs=(*((frames,) if frames else ()), predicted.name),
        )  # fmt: skip

    def _predict(self, split: str, mode: Mode, part: str, name: str, limit: int = 0) -> Step:
        above, _, kind = split.split("/")
        where = f"{mode}-{'real' if above == 'real' else kind}"
        output = f"predictions/{part}/{name}-{where}.safetensors"
        few = ("--limit", str(limit)) if limit else ()
        return Step(
            kind="predict", name=f"predict-{where}", output=output, reads=(split,),
            command=("predict", f"{{out}}/runs/{part}/{name}", "--data", f"{{data}}/{above}",
                     "--split", kind, "--mode", mode, *few, "--out", f"{{out}}/{output}"),
            needs=("train",),
        )  # fmt: skip

    def has_real(self, place: str) -> bool:
        """Whether this part's models are the ones that real objects of the category are shown."""
        part, category = place.split("/")
        there = (self.folder / "real" / category / "test" / "manifest.json").is_file()
        return there and REAL.get(category) == part

    def count(self, split: str) -> int:
        """Samples of a split, and its digest noted."""
        if split not in self.counts:
            self.data[split] = None
            above, _, kind = split.split("/")
            sizes = {name: size for name, (size, _) in (self.preset.sizes or {}).items()}
            self.counts[split] = REAL_VIEWS if above == "real" else (sizes or SIZES)[kind]
            path = self.folder / split / "manifest.json"
            if path.is_file():
                manifest = read_manifest(path)
                self.data[split], self.counts[split] = manifest.digest, manifest.count
        return self.counts[split]


def name_of(entry: Entry, category: str, seed: int) -> str:
    """Of a run and of all files about it."""
    return f"{category}-{entry.label}-seed{seed}"


def released_model(templates: Sequence[str], part: str, category: str) -> tuple[str, Path] | None:
    """Name and file of the first released model of such names that is there."""
    known = weights()
    names = [name.format(part=part, category=category) for name in templates]
    return next(((name, known[name]) for name in names if name in known), None)


def of_model(step: Step, row: str, name: str, path: Path) -> Step:
    """A prediction of a run, asked of a released model instead."""
    verb, _, *others = step.command
    command = (verb, name, *others, "--row", row)  # the models saw different labels: one row
    return replace(step, command=command, needs=(), model=sha256_file(path))


def own_preset(method: str, name: PresetName, own: str = "") -> tuple[str | None, Any]:
    """A method's preset, the one that goes with a grid's if none is named; its options.

    None where it has no flag for it.
    """
    asked = own or ("paper" if name == "paper" else "cpu")
    default = METHODS[method].preset(asked)
    return (asked if any(one.name == "preset" for one in fields(default)) else None), default


def configuration(method: str, default: Any, flags: Sequence[str]) -> dict[str, Any]:  # noqa: ANN401
    """What `train METHOD FLAGS` configures: name, and every option with its value."""
    words = list(flags[2:] if flags[:1] == ["--preset"] else flags)
    config = tyro.cli(type(default), default=default, args=words)
    return {"method": method, "config": json.loads(canonical_json(asdict(config)))}


def chosen(chains: Sequence[Chain], only: Sequence[str]) -> list[Chain]:
    """The chains asked for, all without a word.

    Args:
        chains: All of them.
        only: Patterns of part, category, label or seed (`registered`, `scapo*`, `seed1`), or
            several joined by `/`; a chain is taken if all patterns of one item fit it.

    Raises:
        UsageError: An item that fits nothing.
    """
    if not only:
        return list(chains)
    taken: set[str] = set()
    for item in only:
        patterns = item.split("/")
        fitting = [
            chain.name for chain in chains
            if all(any(fnmatchcase(word, one) for word in chain.name.split("/"))
                   for one in patterns)
        ]  # fmt: skip
        if not fitting:
            labels = ", ".join(dict.fromkeys(chain.label for chain in chains))
            parts = ", ".join(dict.fromkeys(chain.part for chain in chains))
            raise UsageError(
                f"only: expected parts ({parts}), categories, methods ({labels}), seed1, ... or "
                f"these joined by /, found {item!r}"
            )
        taken.update(fitting)
    return [chain for chain in chains if chain.name in taken]


def freeze(path: Path, plan: Plan, *, anew: bool = False) -> bool:
    """Write the plan where there is none, or else hold this one against it.

    Args:
        path: Of `plan.json`.
        plan: What would be done today.
        anew: Write it in any case.

    Returns:
        Whether it was written.

    Raises:
        StoreError: The plan that is there is damaged, or another; naming what differs.
    """
    now = plan.to_json()
    if anew or not path.exists():
        write_bytes(path, readable_json(now).encode())
        return True
    there = read_plan(path)
    differs = [name for name in FROZEN if there[name] != now[name]]
    before = cast("dict[str, str | None]", there["data"])
    differs += [split for split, digest in plan.data.items()
                if digest is not None and before.get(split) not in (None, digest)]  # fmt: skip
    if differs:
        raise StoreError(
            f"{path}: expected the plan that would be followed today (commit {plan.commit}), found "
            f"one of commit {there['commit']} that differs in {', '.join(differs[:3])}; check that "
            "commit out, or plan anew with --replan, which is to be said beside the scores"
        )
    return False


def read_plan(path: Path) -> dict[str, Any]:
    """A plan file.

    Raises:
        StoreError: It is none, or was changed after it was written.
    """
    found = read_json(path)
    there = cast("dict[str, Any]", found) if isinstance(found, dict) else {}
    names = (*FROZEN, "data", "commit", "digest")
    if there.get("format") != FORMAT or any(name not in there for name in names):
        raise StoreError(f"{path}: expected a plan of format {FORMAT!r}, found something else")
    if there["digest"] != digest_of(there):
        raise StoreError(f"{path}: expected a plan that was not changed, found another digest")
    return there
