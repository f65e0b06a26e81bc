# SPDX-License-Identifier: MIT
"""`run`: data that are missing, the plan, its steps, the tables; what a listener may show of it."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from bench.grid.command import run_command
from bench.grid.execute import (
    Ended,
    Estimate,
    Machines,
    execute,
    made_of,
    read_record,
    record_path,
)
from bench.grid.plan import PLAN, Chain, Plan, chosen, freeze, make_plan
from bench.grid.presets import PRESETS, Preset, PresetName
from bench.requests import GridRequest
from bench.scoring.score_files import SUFFIX
from bench.tables.results import TABLE_SPLIT, UNSEEN_SPLIT
from scapo.store import sha256_file
from scapo.store.folders import alone

RUNS = Path("results/runs")
"""Where runs go unless told otherwise, a folder for each preset."""
SCORES, ASIDE = "scores", "scores-of-earlier-plans"
DATA_SEED = 2
"""Of data made here, as the benchmark's."""
MADE = ("clean", "complete", "sensor")
"""Parts that `scapo-data benchmark` makes; others are made split by split."""


@dataclass(slots=True, kw_only=True)
class Status:
    """How far a run is."""

    chains: Sequence[Chain]
    estimate: Estimate
    workers: int
    running: dict[str, tuple[str, float]] = field(default_factory=dict)
    """Chain -> its step, and when that began."""
    ended: list[Ended] = field(default_factory=list)

    def hear(self, chain: str, step: str, over: bool) -> None:
        """A sign of life."""
        if self.running.get(chain, ("",))[0] != step and not over:
            self.running[chain] = (step, time.monotonic())

    def end(self, chain: str, ended: Sequence[Ended]) -> None:
        """A chain is over."""
        self.running.pop(chain, None)
        self.ended += ended
        known = next(one for one in self.chains if one.name == chain)
        steps = {step.name: step for step in known.steps}
        for one in ended:
            if one.state in ("made", "kept"):  # what was kept is in the estimate already
                seconds = one.seconds if one.state == "made" else 0.0
                self.estimate.over(known, steps[one.step], seconds)

    @property
    def counts(self) -> Counter[str]:
        """Steps by how they ended."""
        return Counter(one.state for one in self.ended)

    @property
    def failed(self) -> list[Ended]:
        """Steps that failed, each with its reason."""
        return [one for one in self.ended if one.state == "failed"]

    def seconds_left(self) -> tuple[float, int]:
        """Until the end, by the workers there are, and the steps whose time nobody knows."""
        seconds, unknown = self.estimate.total(self.chains)
        return seconds / max(1, self.workers), unknown


class Grid:
    """One call of `run`."""

    def __init__(
        self, request: GridRequest, presets: Mapping[PresetName, Preset] = PRESETS
    ) -> None:
        """Say what is wrong with the request before anything begins.

        Raises:
            ValueError: More GPUs than one that are no whole number.
        """
        if request.gpus < 0 or (request.gpus > 1 and request.gpus != int(request.gpus)):
            raise ValueError(f"--gpus: expected a share of one or a whole number, found "
                             f"{request.gpus}")  # fmt: skip
        self.request, self.presets = request, presets
        self.out = request.out or RUNS / request.preset
        self.data, self.aside = request.data or self.out / "data", self.out / ASIDE
        self.machines = Machines(engine=request.engine, workers=request.workers, gpus=request.gpus)

    def plan(self, say: Callable[[str], None]) -> tuple[Plan, list[Chain]]:
        """The plan, written or held against the one that is there, and the chains asked for.

        Raises:
            StoreError: Another plan is there, or damaged data.
            StepError: Data that are missing could not be made.
        """
        plan = self._made()
        chains = chosen(plan.chains, self.request.only)
        missing = [] if self.request.plan_only else self._commands(plan, chains)
        for words in missing:
            say(f"data: scapo-data {' '.join(words)}")
            run_command("scapo-data", words, self.out / "jobs" / "data" / f"{words[0]}.txt")
        if missing:
            plan = self._made()
            chains = chosen(plan.chains, self.request.only)
        scored = {split.split("/")[-1] for split in plan.data}
        free = not any(split.startswith("test") for split in scored)  # design may go on there
        written = freeze(self.out / PLAN, plan, anew=free or self.request.replan)
        say(f"plan: {'written to' if written else 'as in'} {self.out / PLAN}")
        return plan, chains

    def _made(self) -> Plan:
        asked = self.request
        return make_plan(asked.preset, self.data, minutes=asked.budget_minutes,
                         splits=asked.splits, presets=self.presets)  # fmt: skip

    def _commands(self, plan: Plan, chains: Sequence[Chain]) -> list[list[str]]:
        """What `scapo-data` must be asked for."""
        wanted = {split for chain in chains for step in chain.steps for split in step.reads}
        missing = [split for split, digest in plan.data.items()
                   if digest is None and split in wanted]  # fmt: skip
        cores = ["--workers", str(self.machines.at_once or 2)]
        sizes, commands = self.presets[plan.preset].sizes, []
        whole = [split for split in missing if sizes is None and split.split("/")[0] in MADE]
        target = ["benchmark", "sim-art/2", "--out", str(self.data), *cores]
        if self.request.real is not None and not (self.data / "real").is_dir():
            commands.append([*target, "--only", "real", "--real", str(self.request.real)])
        if whole:
            commands.append([*target, "--only", *whole])
        others = [split for split in missing if split not in whole]
        return [*commands, *(_generate(self.data, split, sizes) for split in others)]

    def status(self, plan: Plan, chains: Sequence[Chain]) -> Status:
        """How far the run is now."""
        return Status(chains=chains, estimate=Estimate(plan, self.out),
                      workers=min(self.machines.at_once or 1, max(1, len(chains))))  # fmt: skip

    def go(self, plan: Plan, status: Status) -> Iterator[tuple[str, tuple[Ended, ...]]]:
        """Do what is not finished, and yield each chain as it ends.

        Raises:
            StoreError: Another run goes on in this folder.
            KeyboardInterrupt: With what to do next.
        """
        done = execute(plan, status.chains, self.out, self.data, self.machines, status.hear)
        with alone(self.out, "run"):
            try:
                for name, ended in done:
                    status.end(name, ended)
                    yield name, ended
            except KeyboardInterrupt as stop:
                words = f"{self.out}: interrupted; the same command goes on from here"
                raise KeyboardInterrupt(words) from stop

    def set_aside(self, plan: Plan) -> int:
        """Move scores that an earlier plan made into a folder that no table is made from.

        Returns:
            How many, other readings of the same predictions not counted.
        """
        stale = self._stale(plan)
        for path in stale:
            for one in path.parent.glob(f"{path.name.removesuffix(SUFFIX)}.*"):
                aside = self.aside / one.relative_to(self.out / SCORES)
                aside.parent.mkdir(parents=True, exist_ok=True)
                one.replace(aside)
        return len(stale)

    def _stale(self, plan: Plan) -> set[Path]:
        """Of the splits that tables show, scores whose record is not of this plan.

        What has no record was put there on purpose.
        """
        shown = tuple(f"-{split}" for split in (_shown(plan), UNSEEN_SPLIT, "real"))
        records = {path: read_record(path) for path in (self.out / "jobs").rglob("evaluate-*.json")
                   if path.stem.endswith(shown)}  # fmt: skip
        own, stale = set[Path](), set[Path]()
        for chain in plan.chains:
            made = made_of(plan, chain, self.out)
            for step in (one for one in chain.steps if one.kind == "evaluate"):
                own.add(self.out / step.output)
                known = records.pop(record_path(self.out, chain.name, step), None)
                if known is not None and step.name not in made:
                    stale.add(self.out / step.output)
        others = {record.output for record in records.values()}
        there = set((self.out / SCORES).rglob(f"*{SUFFIX}"))
        return stale & there | {path for path in there - own if sha256_file(path) in others}

    def tables(self, plan: Plan) -> list[Path]:
        """The tables of all scores that are there, and the page of them; none without scores.

        Raises:
            StepError: They could not be made.
        """
        scores, tables = self.out / SCORES, self.out / "tables"
        if not any(scores.rglob(f"*{SUFFIX}")):
            return []
        words = [
            "tables",
            "--scores",
            str(scores),
            "--out",
            str(tables),
            "--split",
            _shown(plan),
            "--html",
        ]
        run_command("scapo-bench", words, self.out / "jobs" / "tables.txt")
        return [tables / "table1.md", tables / "index.html"]


def _shown(plan: Plan) -> str:
    """The split that tables show beside objects unlike the training's."""
    splits = {split.split("/")[-1] for split in plan.data}
    return min(splits - {"train", UNSEEN_SPLIT}, default=TABLE_SPLIT)


def _generate(data: Path, split: str, sizes: Mapping[str, tuple[int, int]] | None) -> list[str]:
    """The command for one split that is no piece of the benchmark."""
    part, category, kind = split.split("/")
    count, instances = (sizes or {"train": (5000, 100), "val": (1000, 50), "test": (1000, 50)})[
        kind
    ]
    words = ["generate", category, "--out", str(data / part), "--split", kind, "--count",
             str(count), "--instances", str(instances), "--seed", str(DATA_SEED)]  # fmt: skip
    return [*words, "--protocol", "isolated"] if part == "isolated" else words
