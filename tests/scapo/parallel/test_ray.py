# SPDX-License-Identifier: MIT
"""Jobs on a Ray cluster of several nodes on this machine, one of which is killed in the middle."""

from __future__ import annotations

import os
import signal
import sys
import time
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from scapo.parallel import ray as engine
from scapo.parallel.pool import Outcome, Pool
from scapo.parallel.ray import MAX_LOST, MISSING, RayPool, open_pool
from scapo.store import Split
from sim_assets.__main__ import main
from sim_assets.generation import generate as generating
from sim_assets.generation.generate import Made, Running, generate
from sim_assets.generation.ledger import GenerateError, Ledger
from sim_assets.generation.request import make_request, versions
from sim_assets.generation.shard import ShardJob
from sim_assets.objects import ArticulatedObject
from sim_assets.options import DataOptions
from tests.helpers.boxes import laptop
from tests.scapo.parallel.test_pool import act

with_ray = pytest.mark.skipif(
    find_spec("ray") is None, reason="the package ray (extra [cluster]) is not installed"
)


@pytest.fixture(scope="module")
def cluster() -> Iterator[Any]:
    """A head without cores and two nodes with one each; RAY_ADDRESS names it."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        engine.find_ray()
        cluster_utils = import_module("ray.cluster_utils")
        cluster = cluster_utils.Cluster(initialize_head=True, head_node_args={"num_cpus": 0})
        for _ in range(2):
            cluster.add_node(num_cpus=1)
        before = os.environ.get("RAY_ADDRESS")
        os.environ["RAY_ADDRESS"] = cluster.address
        try:
            yield cluster
        finally:
            os.environ.pop("RAY_ADDRESS")
            if before is not None:
                os.environ["RAY_ADDRESS"] = before
            cluster.shutdown()


def suicide(job: int, report) -> int:
    """Kill the Ray worker above this process, as a machine out of memory would."""
    report("suicide", 3)
    time.sleep(2 * engine.BETWEEN)
    report("suicide", 4)
    time.sleep(2 * engine.BETWEEN)
    os.kill(os.getppid(), signal.SIGKILL)
    time.sleep(60)
    return job


class NodeDiedError(Exception):
    """What the stand-in for Ray raises."""


class StandIn:
    """In place of the package: a task is done here once it is listened to, the oldest first.

    Some lose their machine when they have ended, before their outcome is heard.
    """

    exceptions = SimpleNamespace(RayError=NodeDiedError, RayTaskError=ZeroDivisionError)

    def __init__(self, loses: Callable[[Any], bool]) -> None:
        self.loses = loses

    def is_initialized(self) -> bool:
        return True

    def cluster_resources(self) -> dict[str, float]:
        return {"CPU": 1.0}

    def remote(self, **_: object) -> Any:
        return lambda task: SimpleNamespace(
            remote=lambda *job: self._stream(task(*job), self.loses(job[1]))
        )

    def _stream(self, messages: Iterator[Any], lost: bool) -> Iterator[Any]:
        for message in messages:
            if lost and isinstance(message, Outcome):
                raise NodeDiedError
            yield message

    def wait(self, streams: list[Any], **_: object) -> tuple[list[Any], list[Any]]:
        return streams[:1], []

    def get(self, message: object) -> object:
        return message

    def cancel(self, stream: Iterator[Any], *, force: bool) -> None:
        del stream, force


@pytest.fixture
def losing(monkeypatch: pytest.MonkeyPatch) -> Callable[[Callable[[Any], bool]], None]:
    """Put the stand-in in the place of Ray; jobs are done in this process."""
    monkeypatch.setattr(engine, "_pool", lambda timeout, gpus: Pool[Any, Any](0, timeout=timeout))
    return lambda loses: monkeypatch.setattr(engine, "find_ray", lambda: StandIn(loses))


def test_what_is_lost_is_done_again_and_given_up_where_it_always_is(losing):
    left = {("square", 2): 1, ("square", 4): MAX_LOST}

    def loses(job: tuple[str, int]) -> bool:
        left[job] = left.get(job, 0) - 1
        return left[job] >= 0

    losing(loses)
    jobs = [("square", 1), ("square", 2), ("raise", 3), ("square", 4)]
    heard: dict[str, int] = {}

    def hear(job: tuple[str, int], label: str, amount: int) -> None:
        heard[label] = heard.get(label, 0) + amount

    with RayPool[Any, Any]() as pool, Pool[Any, Any](0) as local:
        outcomes = {outcome.job: outcome for outcome in pool.run(act, jobs, hear)}
        alike = {outcome.job: outcome for outcome in local.run(act, jobs[:3])}
    killed = outcomes.pop(("square", 4))
    assert outcomes == alike
    assert (killed.failure, killed.result, killed.label) == ("died", None, "square 4")
    assert killed.reason == f"its machine or worker was lost {MAX_LOST} times (NodeDiedError)"
    assert pool.lost == 1 + MAX_LOST - 1
    assert heard == {"square 1": 1, "square 2": 1, "raise 3": 1, "square 4": 1}


@with_ray
@pytest.mark.slow
def test_outcomes_are_those_of_a_local_pool(cluster):
    assert len(cluster.worker_nodes) == 2
    jobs = [("square", 1), ("raise", 2), ("die", 3), ("hang", 4), ("tick", 6), ("square", 8)]
    heard: list[tuple[str, int]] = []
    with RayPool[Any, Any](timeout=2.5) as pool:
        outcomes = {
            outcome.job: outcome
            for outcome in pool.run(act, jobs, lambda job, label, n: heard.append((label, n)))
        }
        assert pool.lost == 0
        killed = list(pool.run(suicide, [5], lambda job, label, n: heard.append((label, n))))
        assert pool.lost == MAX_LOST - 1
    assert {job: outcome.result for job, outcome in outcomes.items() if not outcome.failure} == {
        ("square", 1): 1,
        ("tick", 6): 36,
        ("square", 8): 64,
    }
    assert {job: (o.failure, o.reason, o.label) for job, o in outcomes.items() if o.failure} == {
        ("raise", 2): ("error", "number 2: expected less", "raise 2"),
        ("die", 3): ("died", "its process was ended by SIGKILL", "die 3"),
        ("hang", 4): ("hung", "no sign of life for 2.5 s", "hang 4"),
    }
    assert ("square 8", 1) in heard
    assert [(outcome.failure, outcome.label) for outcome in killed] == [("died", "suicide")]
    assert killed[0].reason.startswith(f"its machine or worker was lost {MAX_LOST} times")
    assert 0 <= sum(n for label, n in heard if label == "suicide") <= 7  # lost amounts taken back


@dataclass(frozen=True, slots=True, kw_only=True)
class Gated:
    """An object that in some shards waits for a file to be there, and may then kill its worker."""

    name: str
    folder: Path
    gated: bool
    deadly: bool

    def load(self) -> ArticulatedObject:
        log = self.folder / "loads"
        with log.open("a") as file:
            file.write(f"{self.name} {os.environ.get('RAY_RAYLET_PID')}\n")
        if log.read_text().split().count(self.name) > 1:  # no longer for the plan
            while self.gated and not (self.folder / "gate").exists():
                time.sleep(0.05)
            if self.deadly:
                os.kill(os.getpid(), signal.SIGKILL)
        return laptop(self.name)


def make(folder: Path, running: Running) -> Made:
    """Four shards of two objects, the second of which waits; one kills its worker."""
    options = DataOptions(protocol="full", points=64, count=256, instances=8)
    request, _ = make_request("laptop", options)
    folder.mkdir()
    assets = [
        Gated(name=f"object{i}", folder=folder, gated=i % 2 == 1, deadly=i == 3) for i in range(8)
    ]
    if running.engine == "local":
        (folder / "gate").touch()
    found = versions(request.settings.backend)
    return generate(request, assets, folder / "split", found, running)


def content(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in sorted(folder.iterdir())}


def kill_node(cluster: Any, raylet: int) -> None:
    """All processes of a node at once, as when a machine is lost."""
    parents = {
        int(path.parent.name): int(path.read_text().rpartition(")")[2].split()[1])
        for path in Path("/proc").glob("[0-9]*/stat")
    }
    doomed = [raylet]
    for process in doomed:
        doomed += [child for child, parent in parents.items() if parent == process]
    for process in reversed(doomed):
        os.kill(process, signal.SIGKILL)
    for node in cluster.worker_nodes.copy():
        if node.all_processes["raylet"][0].process.pid == raylet:
            cluster.remove_node(node, allow_graceful=False)


def test_machines_lost_with_finished_shards_lose_and_double_nothing(losing, tmp_path, monkeypatch):
    """Each object and each shard is made twice, since the first machine is never heard of again."""
    options = DataOptions(protocol="full", points=64, count=128, instances=2)
    request, assets = make_request("laptop", options)
    found = versions(request.settings.backend)
    local = generate(request, assets, tmp_path / "local", found, Running(workers=0))
    begun: list[str] = []
    recorded: list[str] = []
    done: list[tuple[str, int]] = []

    def loses(job: Any) -> bool:
        begun.append(job.plan.file if isinstance(job, ShardJob) else job.name)
        return begun.count(begun[-1]) == 1

    def record(ledger: Ledger, shard) -> None:
        recorded.append(shard.file)
        before(ledger, shard)

    before = Ledger.record
    monkeypatch.setattr(Ledger, "record", record)
    losing(loses)
    running = Running(
        workers=None, engine="ray", progress=lambda what, n, _: done.append((what, n))
    )
    made = generate(request, assets, tmp_path / "ray", found, running)
    objects, shards = [asset.name for asset in assets], ["00000.safetensors", "00001.safetensors"]
    assert sorted(begun) == sorted(2 * (objects + shards))
    assert recorded == shards
    assert max(done) == done[-1] == ("samples", 128)
    assert made.failed == {}
    assert content(made.folder) == content(local.folder)


@with_ray
@pytest.mark.slow
def test_a_node_killed_in_the_middle_loses_and_doubles_nothing(cluster, tmp_path, monkeypatch):
    local = make(tmp_path / "local", Running(workers=1))
    pools: list[RayPool[Any, Any]] = []
    recorded: list[str] = []
    killed: list[int] = []

    def opened(*args, **kwargs):
        pools.append(RayPool(args[1], timeout=kwargs["timeout"]))
        return pools[-1]

    def record(ledger: Ledger, shard) -> None:
        recorded.append(shard.file)
        before(ledger, shard)

    before = Ledger.record
    monkeypatch.setattr(generating, "open_pool", opened)
    monkeypatch.setattr(Ledger, "record", record)

    def show(what: str, done: int, total: int) -> None:
        if what == "samples" and done and not killed:
            killed.append(int((tmp_path / "ray/loads").read_text().split()[-1]))
            kill_node(cluster, killed[0])
            (tmp_path / "ray/gate").touch()

    made = make(tmp_path / "ray", Running(workers=None, engine="ray", progress=show))
    assert killed
    assert pools[0].lost >= 1
    assert sorted(recorded) == [f"{i:05d}.safetensors" for i in range(4)]
    assert made.failed == local.failed == {"object3": "its process was ended by SIGKILL"}
    assert made.manifest == local.manifest
    assert made.manifest.count == 224
    assert content(made.folder) == content(local.folder)
    Split(made.folder).verify()


@with_ray
def test_a_cluster_that_does_not_answer_is_one_line(monkeypatch):
    monkeypatch.setenv("RAY_ADDRESS", "127.0.0.1:9")
    with pytest.raises(ConnectionError, match=r"RAY_ADDRESS 127\.0\.0\.1:9: expected a Ray clus"):
        RayPool[Any, Any]().__enter__()


def test_without_ray_the_extra_is_named(tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "ray", None)  # as if it were not installed
    with pytest.raises(RuntimeError, match=r"pip install 'scapo\[cluster\]'"):
        RayPool[Any, Any]().__enter__()
    flags = ["--protocol", "full", "--count", "4", "--engine", "ray", "--out", str(tmp_path)]
    with pytest.raises(SystemExit, match="1"):
        main(["generate", "laptop", *flags])
    assert capsys.readouterr().err == f"scapo-data: {MISSING}\n"


def test_engines_and_numbers_of_workers():
    assert isinstance(open_pool("ray", 2), RayPool)
    local = open_pool("local", timeout=7)
    assert isinstance(local, Pool)
    assert (local.size, local.timeout) == (os.cpu_count(), 7)
    with pytest.raises(ValueError, match="workers: expected 1 or more with engine ray, found 0"):
        open_pool("ray", 0)


def test_a_machine_that_would_make_other_pixels_is_refused(tmp_path):
    """The versions of the job are those of the machine that planned it."""
    from sim_assets.generation.plan import plan_shards
    from sim_assets.generation.shard import ShardJob, describe, render_shard, render_shard_alike

    request, assets = make_request("laptop", DataOptions(protocol="full", points=64, count=2))
    entries = [describe(asset, lambda label, amount: None) for asset in assets]
    job = ShardJob(
        folder=tmp_path,
        request=request,
        plan=plan_shards(request, entries, 1)[0],
        options={},
        versions=versions(request.settings.backend),
        strict=True,
    )
    silent = lambda label, amount: None  # noqa: E731
    done = render_shard_alike(job, silent)
    assert done == render_shard(job, silent)
    other = replace(job, versions={**job.versions, "numpy": "0.1"})
    with pytest.raises(ValueError, match=r"machine .*: expected numpy 0\.1, found numpy [\d.]+$"):
        render_shard_alike(other, silent)


def test_a_shard_that_is_not_seen_is_not_recorded(tmp_path, monkeypatch):
    from sim_assets.generation import ledger
    from sim_assets.generation.shard import ShardDone

    monkeypatch.setattr(ledger, "SEEN", 0.2)
    shard = ShardDone(
        file="00000.safetensors", count=1, sha256="0" * 64, plan="", views=1, draws=1, failed={}
    )
    with (
        Ledger(tmp_path / "split", {}, {}) as book,
        pytest.raises(GenerateError, match="storage that all machines share"),
    ):
        book.record(shard)
