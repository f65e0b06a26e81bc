# SPDX-License-Identifier: MIT
"""Carrying out a plan: what is finished stays, what fails costs its own chain, the rest goes on.

A step is finished when its output is there under its final name with the digest that its record
names, and the record is of this very step: the same command, configuration, data and inputs. So a
run that was killed at any moment goes on where it was, and a training that is made again takes
along all that was made of it.
"""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

from bench.grid.command import StepError, run_command
from bench.grid.plan import Chain, Kind, Plan, Step
from scapo.parallel.ray import Engine, open_pool
from scapo.store import StoreError, canonical_json, sha256_bytes, sha256_file, write_bytes
from scapo.store.json_records import from_json, read_json
from scapo.store.manifest import read_manifest

FORMAT = "scapo-step/1"
State = Literal["kept", "made", "failed", "not run"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Record:
    """What is written beside the log of a step: what it is, and once it is finished its output."""

    entry: str
    """Digest of the step with all that it depends on."""
    output: str = ""
    """SHA-256 of the file that it made; "" while it is not finished."""
    seconds: float = 0.0
    code: str = ""
    commit: str = ""
    format: str = FORMAT


@dataclass(frozen=True, slots=True, kw_only=True)
class Ended:
    """How a step ended."""

    chain: str
    step: str
    state: State
    seconds: float = 0.0
    reason: str = ""
    """Of a failure, with the log's last line."""
    code: str = ""
    """Digest of the code that it was made by."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Job:
    """A chain, with what it needs to know in a process of its own, perhaps on another machine."""

    chain: Chain
    out: Path
    data: Path
    config: Any
    code: str
    commit: str
    processes: int = 1
    """GPUs of one training."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Machines:
    """Where the chains run, and how many at a time."""

    engine: Engine = "local"
    workers: int | None = None
    gpus: float = 0.0
    """Of one chain: what a Ray task asks for; 2 or more are also the processes of a training."""

    @property
    def at_once(self) -> int | None:
        """Chains at a time on this machine: one per core, or one where there is a GPU."""
        if self.workers is not None or self.engine == "ray":
            return self.workers
        import torch

        return 1 if torch.cuda.is_available() else os.cpu_count() or 1


def execute(
    plan: Plan,
    chains: Sequence[Chain],
    out: Path,
    data: Path,
    machines: Machines,
    hear: Callable[[str, str, bool], None] = lambda chain, step, over: None,
) -> Iterator[tuple[str, tuple[Ended, ...]]]:
    """Do what is not finished of some chains.

    Args:
        plan: That they belong to.
        chains: In the order in which they begin.
        out: Folder of the run.
        data: Folder of the data.
        machines: Where.
        hear: Told of the chain and step that goes on, and whether it is over.

    Yields:
        The name of each chain that ended, and how its steps did.
    """
    out, data = out.absolute(), data.absolute()  # a worker of a cluster has another working folder
    jobs = [
        Job(chain=chain, out=out, data=data, config=plan.configs[chain.label], code=plan.code,
            commit=plan.commit, processes=max(1, int(machines.gpus)))
        for chain in chains
    ]  # fmt: skip

    def heard(job: Job, step: str, over: int) -> None:
        hear(job.chain.name, step, over > 0)

    with open_pool(machines.engine, machines.at_once, gpus=machines.gpus) as pool:
        for outcome in pool.run(do_chain, jobs, heard):
            name = outcome.job.chain.name
            if outcome.result is not None:
                yield name, outcome.result
            else:
                yield name, (Ended(chain=name, step=outcome.label, state="failed",
                                   reason=f"{outcome.failure}: {outcome.reason}"),)  # fmt: skip


def do_chain(job: Job, report: Callable[[str, int], None]) -> tuple[Ended, ...]:
    """Do the steps of a chain that are not finished, in order; one that fails costs its heirs."""
    records: dict[str, Record] = {}
    ended: list[Ended] = []
    for step in job.chain.steps:
        missing = [name for name in step.needs if name not in records]
        if missing:
            reason = f"needs {missing[0]}"
            ended.append(Ended(chain=job.chain.name, step=step.name, state="not run",
                               reason=reason))  # fmt: skip
            continue
        report(step.name, 0)
        try:
            record, state = _do_step(job, step, records, report)
        except (OSError, StepError, StoreError) as error:
            ended.append(Ended(chain=job.chain.name, step=step.name, state="failed",
                               reason=" ".join(str(error).split())))  # fmt: skip
            continue
        report(step.name, 1)
        records[step.name] = record
        ended.append(Ended(chain=job.chain.name, step=step.name, state=state, code=record.code,
                           seconds=record.seconds))  # fmt: skip
    return tuple(ended)


def _do_step(
    job: Job, step: Step, records: Mapping[str, Record], report: Callable[[str, int], None]
) -> tuple[Record, State]:
    """The record of a finished step, and whether it was so before.

    Raises:
        StepError: Its command failed.
        StoreError: Its data are not there.
    """
    where = record_path(job.out, job.chain.name, step)
    entry = entry_of(step, job.config, records, digests(job.data, step.reads))
    there, output = read_record(where), job.out / step.output
    if is_finished(there, entry, output):
        return there, "kept"
    if step.kind == "train" and there.entry not in ("", entry):
        shutil.rmtree(output.parent, ignore_errors=True)  # of another plan: not to be continued
    _write_record(where, Record(entry=entry))
    folders = {"{out}": str(job.out), "{data}": str(job.data)}
    words = [replaced(word, folders) for word in step.command]
    seconds = run_command(
        "scapo-bench",
        words,
        where.with_suffix(".txt"),
        processes=job.processes if step.kind == "train" else 1,
        alive=lambda: report(step.name, 0),
    )
    if not output.is_file():
        raise StepError(f"{step.name}: expected {output}, found nothing")
    record = Record(entry=entry, output=sha256_file(output), seconds=round(seconds, 2),
                    code=job.code, commit=job.commit)  # fmt: skip
    _write_record(where, record)
    return record, "made"


def replaced(word: str, folders: Mapping[str, str]) -> str:
    """A word of a command with the folders in their places."""
    for name, folder in folders.items():
        word = word.replace(name, folder)
    return word


def entry_of(
    step: Step, config: object, records: Mapping[str, Record], data: Mapping[str, str]
) -> str:
    """The digest of a step with all that its output depends on but the code."""
    settings = config if step.kind == "train" else None
    inputs = {name: records[name].output for name in step.needs}
    return sha256_bytes(canonical_json([asdict(step), settings, inputs, data]).encode())


def is_finished(record: Record, entry: str, output: Path) -> bool:
    """Whether a step's output is there as its record says."""
    return (
        record.entry == entry
        and record.output != ""
        and output.is_file()
        and sha256_file(output) == record.output
    )


def made_of(plan: Plan, chain: Chain, out: Path) -> dict[str, Record]:
    """Records of the steps of a chain that this plan keeps, by name.

    Their outputs are there, but not read again; data that are not there are taken to be as they
    were.
    """
    made: dict[str, Record] = {}
    for step in chain.steps:
        record = read_record(record_path(out, chain.name, step))
        there = record.output != "" and (out / step.output).is_file()
        if there and all(name in made for name in step.needs):
            data = {split: digest for split in step.reads if (digest := plan.data[split])}
            entry = entry_of(step, plan.configs[chain.label], made, data)
            if record.entry == entry or len(data) < len(step.reads):
                made[step.name] = record
    return made


def record_path(out: Path, chain: str, step: Step) -> Path:
    """Where the record of a step is; its log is beside it, STEP.txt."""
    return out / "jobs" / chain / f"{step.name}.json"


def read_record(path: Path) -> Record:
    """The record of a step, an empty one where there is none that can be read."""
    try:
        return from_json(Record, read_json(path), str(path))
    except (OSError, StoreError):
        return Record(entry="")


def _write_record(path: Path, record: Record) -> None:
    write_bytes(path, (json.dumps(asdict(record), indent=1) + "\n").encode())


def digests(data: Path, splits: Sequence[str]) -> dict[str, str]:
    """The digest of each split.

    Raises:
        StoreError: One is not there.
    """
    return {split: read_manifest(data / split / "manifest.json").digest for split in splits}


class Estimate:
    """Seconds of the steps that are left, from stated costs and from what ran before."""

    def __init__(self, plan: Plan, out: Path) -> None:
        """Read the records of a run's folder."""
        self.plan = plan
        self.left: dict[tuple[str, str], Step] = {}
        self._spent: dict[tuple[str, str], list[tuple[float, float]]] = {}
        for chain in plan.chains:
            made = made_of(plan, chain, out)
            for step in chain.steps:
                if step.name in made:
                    self.over(chain, step, made[step.name].seconds)
                else:
                    self.left[chain.name, step.name] = step

    def over(self, chain: Chain, step: Step, seconds: float) -> None:
        """Learn what a step took."""
        self.left.pop((chain.name, step.name), None)
        stated = self.plan.seconds[chain.name, step.name]
        if seconds > 0 and stated:
            self._spent.setdefault((chain.label, _sort(step)), []).append((seconds, stated))

    def of(self, chain: Chain, step: Step) -> float | None:
        """Seconds of a step: as stated, times how far steps of its sort were off on this machine.

        None where neither is known.
        """
        stated = self.plan.seconds[chain.name, step.name]
        known = self._spent.get((chain.label, _sort(step)))
        if stated is None or not known:
            return stated
        return stated * sum(took for took, _ in known) / sum(said for _, said in known)

    def total(self, chains: Sequence[Chain]) -> tuple[float, int]:
        """Seconds of what is left of some chains, one by one, and how many steps have no guess."""
        known = [self.of(chain, step) for chain in chains for step in chain.steps
                 if (chain.name, step.name) in self.left]  # fmt: skip
        return sum(one for one in known if one is not None), known.count(None)


def _sort(step: Step) -> str:
    """Steps that cost alike for each cloud: predictions of one mode, all evaluations."""
    kind: Kind = step.kind
    return "-".join(step.name.split("-")[:2]) if kind == "predict" else kind
