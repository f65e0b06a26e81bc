# SPDX-License-Identifier: MIT
"""What another run says is where the networks begin: on boxes whose true placements it says."""

from __future__ import annotations

from dataclasses import asdict, replace
from pathlib import Path
from typing import Literal

import pytest
import torch
from torch import Tensor
from torch.testing import assert_close

from scapo.categories import CATEGORIES, JointKind
from scapo.geometry.points import nearest, normalise
from scapo.geometry.rigid import apply, rigid
from scapo.geometry.rotations import rotvec_to_rotmat
from scapo.method import Mode, Step, evenly
from scapo.paper import warm_start
from scapo.paper.autoencoder import Encoding
from scapo.paper.config import warm_config
from scapo.paper.first_targets import first_targets
from scapo.paper.method import ARTICULATE, CANONICALISE, Scapo
from scapo.paper.skinning import cross_maps, deform, part_maps
from scapo.paper.warm_start import Exchange, Told, WarmStart, imitation
from scapo.registered.method import load_run
from scapo.store.checkpoint import WEIGHTS
from scapo.store.samples import TrainingData
from scapo.store.schema import StoreError
from scapo.training import fit
from scapo.training.journal import StoredJournal
from scapo.types import Labels, Observation, Prediction
from tests.helpers.placed import Told as Oracle
from tests.helpers.placed import placed_run
from tests.helpers.strategies import generator
from tests.helpers.tiny import TINY, tiny
from tests.helpers.two_ranks import CONFIG, StoppedError, stop_after

KINDS = ("revolute",)
LEGS: tuple[JointKind, ...] = ("revolute", "revolute")
WARM = replace(
    TINY,
    preset="warm",
    part_start="run",
    told=10,
    joint=replace(TINY.joint, base_fixed=False),
    search=replace(TINY.search, teaching=20),
)


def oracle(count: int = 10) -> tuple[Oracle, Observation]:
    method = Oracle(count)
    return method, Observation(points=torch.as_tensor(method.clouds()))


def asked(count: int = 10) -> tuple[Observation, Told]:
    method, observation = oracle(count)
    return observation, WarmStart(method).of(observation, torch.arange(count))


def test_the_shape_that_is_told_lies_on_the_cloud() -> None:
    observation, told = asked()
    points, _ = normalise(observation.points)
    base = (points - told.translation[:, None]) @ told.rotation
    shape = told.observed(KINDS)
    seen = base - torch.stack([s[n] for s, n in zip(shape, nearest(base, shape), strict=True)])
    assert seen.norm(dim=-1).mean() < 0.03
    still = told.shape
    flap = told.part == 1
    assert (shape - still)[~flap].abs().max() == 0
    assert (shape - still)[flap].norm(dim=-1).mean() > 0.02


def test_the_observed_shape_is_where_the_part_poses_put_it() -> None:
    method, observation = oracle()
    said = method.predict(observation)
    told = WarmStart(method).of(observation, torch.arange(10))
    _, similarity = normalise(observation.points)
    count = told.shape.shape[1]
    assert said.camera_T_part is not None
    assert said.canonical_points is not None
    placed = apply(said.camera_T_part, said.canonical_points[:, None, :count])
    flap = (told.part == 1)[..., None]
    expected = similarity.forward(torch.where(flap, placed[:, 1], placed[:, 0]))
    found = told.observed(KINDS) @ told.rotation.mT + told.translation[:, None]
    assert_close(found, expected, atol=1e-4, rtol=0)


def test_targets_carry_the_template_onto_the_shape_in_the_encoders_frame() -> None:
    _, told = asked()
    astray = rotvec_to_rotmat(0.3 * torch.randn(10, 3, generator=generator(1)))
    rotation = told.rotation @ astray
    shift = 0.05 * torch.randn(10, 3, generator=generator(2))
    encoding = Encoding(
        frame=rotation,
        rotation=rotation,
        translation=told.translation + shift,
        code=torch.zeros(10, 4),
    )
    order = torch.arange(0, 400, 4)
    skeleton, own = told.skeleton(order, 0.03), told.lying(order, encoding)
    wanted = first_targets(skeleton.points, own, KINDS)
    maps = part_maps(cross_maps(wanted.template_joints, wanted.joints, KINDS))
    weights = torch.nn.functional.one_hot(told.part[:, order], 2).float()
    found = deform(maps, skeleton.points + wanted.residual, weights)
    seen = told.observed(KINDS)[:, order] @ told.rotation.mT + told.translation[:, None]
    assert_close(encoding.place(found), seen, atol=1e-4, rtol=0)
    part = skeleton.weights().argmax(-1)
    assert (part == told.part[0, order]).float().mean() > 0.9


def test_the_points_of_a_shape_are_found_again_or_repeated() -> None:
    _, told = asked()
    seen = told.observed(KINDS)[3]
    some = torch.arange(40) * 10
    shuffled = some[torch.randperm(40, generator=generator(5))]
    assert torch.equal(told.order(seen[shuffled], 3, KINDS), shuffled)
    more = told.order(torch.zeros(410, 3), 3, KINDS)
    assert torch.equal(more.bincount(minlength=400), 1 + (torch.arange(400) < 10).long())


def test_two_plates_told_the_other_way_round_are_the_same_surfaces() -> None:
    """A book of two like halves: exchanged it is told alike, and twice exchanged as before."""
    half = 0.3 * torch.rand(200, 2, generator=generator(6))
    flat = torch.cat([half, torch.zeros(200, 1)], 1)
    open_by = torch.tensor([1.1, 1.4, 1.9])
    still = rotvec_to_rotmat(torch.tensor([-1.3, 0, 0]))  # the canonical state: open by 1.3
    turn = rotvec_to_rotmat(torch.randn(3, 3, generator=generator(7)))
    told = Told(
        rotation=turn,
        translation=torch.randn(3, 3, generator=generator(8)),
        shape=torch.cat([flat, (flat * torch.tensor([1.0, 1, -1])) @ still.mT]).expand(3, -1, -1),
        part=torch.arange(2).repeat_interleave(200).expand(3, -1),
        pivot=torch.tensor([0.15, 0.0, 0.0]).expand(3, 1, 3),
        axis=torch.tensor([-1.0, 0.0, 0.0]).expand(3, 1, 3),
        state=(open_by - 1.3)[:, None],
    )
    exchange = Exchange.of(told)
    assert_close(exchange.turn @ told.axis[0, 0], -told.axis[0, 0], atol=1e-6, rtol=0)
    other = told.exchanged(exchange)
    assert_close(other.shape, told.shape, atol=0.03, rtol=0)

    def placed(one: Told) -> Tensor:
        return one.observed(KINDS) @ one.rotation.mT + one.translation[:, None]

    for mine, its in ((0, 1), (1, 0)):
        found = placed(other)[:, told.part[0] == mine]
        assert_close(found.mean(1), placed(told)[:, told.part[0] == its].mean(1), atol=0.02, rtol=0)
    back = other.exchanged(exchange)
    assert_close(back.rotation, told.rotation, atol=1e-5, rtol=0)
    assert_close(back.translation, told.translation, atol=1e-5, rtol=0)
    encoding = Encoding(
        frame=turn, rotation=other.rotation, translation=other.translation, code=torch.zeros(3, 1)
    )
    assert_close(told.nearer(other, encoding).rotation, other.rotation)
    mixed = replace(
        encoding,
        rotation=torch.stack([turn[0], *other.rotation[1:]]),
        translation=torch.stack([told.translation[0], *other.translation[1:]]),
    )
    assert_close(told.nearer(other, mixed).rotation[0], turn[0])


def glasses() -> Told:
    """A bar with a leg at either end, of which half a turn about y exchanges the legs."""
    draw = generator(9)
    bar = (torch.rand(200, 3, generator=draw) - 0.5) * torch.tensor([0.5, 0.02, 0.06])
    leg = torch.rand(100, 3, generator=draw) * torch.tensor([0.01, 0.4, 0.03])
    left = leg + torch.tensor([0.25, 0.0, 0.0])
    right = left * torch.tensor([-1.0, 1.0, -1.0])
    pivot = torch.tensor([[0.25, 0.0, 0.0], [-0.25, 0.0, 0.0]])
    return Told(
        rotation=rotvec_to_rotmat(torch.randn(3, 3, generator=draw)),
        translation=torch.randn(3, 3, generator=draw),
        shape=torch.cat([bar, left, right]).expand(3, -1, -1),
        part=torch.tensor([0, 1, 2]).repeat_interleave(torch.tensor([200, 100, 100])).expand(3, -1),
        pivot=pivot.expand(3, -1, -1),
        axis=torch.tensor([[0.0, 0.0, 1.0], [0.0, 0.0, 1.0]]).expand(3, -1, -1),
        state=torch.tensor([[0.2, -0.9], [1.1, -0.1], [0.6, -0.6]]),
    )


def test_two_legs_told_the_other_way_round_are_the_same_surfaces() -> None:
    told = glasses()
    exchange = Exchange.of(told)
    assert_close(exchange.turn, torch.diag(torch.tensor([-1.0, 1.0, -1.0])), atol=0.06, rtol=0)
    other = told.exchanged(exchange)
    assert_close(other.shape, told.shape, atol=0.06, rtol=0)
    # Either joint keeps its direction, so the states are told as they count for it.
    assert_close(other.axis, told.axis, atol=0.06, rtol=0)
    assert_close(other.state, -told.state.flip(1))

    def placed(one: Told) -> Tensor:
        return one.observed(LEGS) @ one.rotation.mT + one.translation[:, None]

    for mine, its in ((0, 0), (1, 2), (2, 1)):
        found = placed(other)[:, told.part[0] == mine]
        assert_close(found.mean(1), placed(told)[:, told.part[0] == its].mean(1), atol=0.03, rtol=0)
    back = other.exchanged(exchange)
    assert_close(back.rotation, told.rotation, atol=1e-5, rtol=0)
    assert_close(back.translation, told.translation, atol=2e-3, rtol=0)
    assert_close(back.pivot, told.pivot, atol=2e-3, rtol=0)


@pytest.mark.parametrize(("category", "two"), [("oven", False), ("eyeglasses", True)])
def test_two_readings_are_asked_for_where_parts_may_change_places(category: str, two: bool) -> None:
    method, _ = oracle()
    method.category = CATEGORIES[category]
    assert WarmStart(method).two_readings == two


class Counted(Oracle):
    asked: int = 0
    last: float = float("inf")
    """Of the clouds, where it is interrupted."""

    def predict(self, observation: Observation, mode: Mode = "fast") -> Prediction:
        if self.asked >= self.last:
            raise KeyboardInterrupt
        self.asked += len(observation.points)
        return super().predict(observation, mode)


def test_asking_goes_on_where_it_was_interrupted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(warm_start, "LOT", 4)
    method, told = Counted(10), list[float]()
    observation = Observation(points=torch.as_tensor(method.clouds()))

    def begun() -> WarmStart:
        start = WarmStart(method)
        journal = StoredJournal(tmp_path, {"seed": 1}, CANONICALISE, lambda *at: told.append(at[1]))
        start.ask(observation, evenly(10, 9), generator(1), journal)
        return start

    method.last = 8
    with pytest.raises(KeyboardInterrupt):
        begun()
    method.last = float("inf")
    start = begun()
    assert method.asked == 9
    assert told == pytest.approx([0, 1 / 3, 2 / 3] * 2)
    index = evenly(10, 9)
    some = Observation(points=observation.points[index])
    found = start.of(some, index)
    assert method.asked == 9
    assert_close(asdict(found), asdict(WarmStart(method).of(some, index)), atol=1e-5, rtol=0)


def test_each_cloud_is_asked_about_once() -> None:
    method = Counted(10)
    observation = Observation(points=torch.as_tensor(method.clouds()))
    start = WarmStart(method)
    some = torch.tensor([7, 2, 5])
    first = start.of(Observation(points=observation.points[some]), some)
    every = start.of(observation, torch.arange(10))
    assert method.asked == 10
    assert_close(every.translation[some], first.translation)
    apart = torch.cdist(every.translation, every.translation) + torch.eye(10)
    assert apart.min() > 1e-4


def test_what_is_imitated_is_least_at_what_was_told() -> None:
    _, told = asked()

    def terms(away: Tensor) -> dict[str, Tensor]:
        rotation, code = told.rotation @ away, torch.zeros(10, 4)
        encoding = Encoding(
            frame=rotation, rotation=rotation, translation=told.translation, code=code
        )
        return imitation(encoding, told.observed(KINDS), told, KINDS, TINY.loss)

    exact = terms(torch.eye(3))
    assert max(float(value) for value in exact.values()) < 1e-5
    quarter = rotvec_to_rotmat(torch.tensor([0.0, 0, torch.pi / 2]))
    assert float(terms(quarter)["frame"]) == pytest.approx(2 / 3, abs=1e-4)
    turn = rigid(quarter, torch.tensor([0.1, 0.2, 0.3])).expand(10, 4, 4)
    turned = told.turned(turn)
    before = told.shape @ told.rotation.mT + told.translation[:, None]
    after = turned.shape @ turned.rotation.mT + turned.translation[:, None]
    assert_close(after, apply(turn, before), atol=1e-5, rtol=0)


def warm(run: Path | None) -> Scapo:
    start = None if run is None else str(run)
    return Scapo(replace(WARM, start=start), CATEGORIES["oven"], generator(0))


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return placed_run(tmp_path_factory.mktemp("run"))


def test_both_stages_begin_at_a_run(run: Path) -> None:
    method, observation = oracle()
    model = warm(run)
    model._run = WarmStart(method)  # true answers: the run's own network is untaught
    first, second = model.stages()
    assert (first.clouds, second.clouds) == (10, None)
    model.start(CANONICALISE, observation, Labels(), generator(1))
    index = evenly(10, 10)
    step = Step(stage=CANONICALISE, progress=0.0, generator=generator(2), index=index, total=10)
    model.train()
    assert set(model.losses(observation, Labels(), step)) == {"frame", "rec", "ortho"}
    before = model.joint_network.lift.weight.clone()
    model.start(ARTICULATE, observation, Labels(), generator(1))
    assert not torch.equal(before, model.joint_network.lift.weight)
    told = model._run.of(observation, index)
    gap = torch.cdist(model.template.points, told.shape.mean(0)).amin(1)
    assert gap.max() < 1e-3  # each of its points is one that was told
    nearest_told = torch.cdist(model.template.points, told.shape.mean(0)).argmin(1)
    assert torch.equal(model.template.part.long(), told.part[0, nearest_told])
    assert set(model.template.part.tolist()) == {0, 1}
    terms = model.losses(observation, Labels(), replace(step, stage=ARTICULATE))
    assert "recon" in terms
    assert all(bool(torch.isfinite(value)) for value in terms.values())


def test_the_run_is_read_from_disk_and_is_no_part_of_the_model(run: Path) -> None:
    model = warm(run)
    model.start(CANONICALISE, oracle()[1], Labels(), generator(1))
    assert model.state_dict().keys() == tiny(category="oven").state_dict().keys()
    read = load_run(run, CATEGORIES["oven"])
    assert read.template.points.abs().sum() > 0
    assert not read.training
    assert warm(run).variant == warm(None).variant


@pytest.mark.parametrize(("told_of", "mode"), [("views", "quick"), ("surfaces", "whole")])
def test_a_run_is_asked_about_what_the_clouds_show(
    run: Path, told_of: Literal["views", "surfaces"], mode: Mode, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(WarmStart, "ask", lambda *_: None)  # the run's network is untaught
    config = replace(WARM, start=str(run), told_of=told_of)
    model = Scapo(config, CATEGORIES["oven"], generator(0))
    model.start(CANONICALISE, oracle()[1], Labels(), generator(1))
    assert model._run is not None
    assert model._run.mode == mode


def test_a_start_that_cannot_be_is_refused(run: Path, tmp_path: Path) -> None:
    observation = oracle()[1]
    with pytest.raises(ValueError, match="--start: expected a trained `registered`"):
        warm(None).start(CANONICALISE, observation, Labels(), generator(1))
    with pytest.raises(StoreError, match="expected a file, found none"):
        warm(tmp_path).start(CANONICALISE, observation, Labels(), generator(1))
    with pytest.raises(StoreError, match="expected a run of registered on laptop"):
        load_run(run, CATEGORIES["laptop"])


def test_a_stopped_training_reads_laptops_as_before(tmp_path: Path) -> None:
    """Which reading of a cloud is learned does not depend on the batch that came first."""
    start = placed_run(tmp_path / "run", category="laptop")
    config = replace(WARM, start=str(start), told=12, batch=4)
    data = TrainingData(observation=oracle(12)[1], labels=Labels(), digest="d")

    def train(folder: Path, listener: fit.Listener = fit.silent, *, resume: bool = False) -> bytes:
        model = Scapo(config, CATEGORIES["laptop"], generator(0))
        fit.fit(model, data, folder, CONFIG, resume=resume, listener=listener)
        return (folder / "metrics.jsonl").read_bytes() + (folder / WEIGHTS).read_bytes()

    with pytest.raises(StoppedError):  # in the second epoch of the first stage
        train(tmp_path / "stopped", stop_after(6))
    assert train(tmp_path / "stopped", resume=True) == train(tmp_path / "whole")


def test_what_the_run_was_told_the_warm_start_says_too(tmp_path: Path) -> None:
    """Rows of tables tell labels and camera by the method's own words."""
    told, observation = placed_run(tmp_path, supervision=("instance",)), oracle()[1]
    with pytest.raises(ValueError, match="instance, found it left out; add --supervision instance"):
        warm(told).start(CANONICALISE, observation, Labels(), generator(1))
    config = replace(WARM, start=str(told), supervision=("instance",))
    model = Scapo(config, CATEGORIES["oven"], generator(0))
    model.start(CANONICALISE, observation, Labels(), generator(1))
    assert model.supervision == {"instance"}
    assert model.variant.replace("-objects known", "") == warm(told).variant != model.variant
    assert model.camera
    assert not tiny().camera


def test_the_preset_leaves_the_base_free_and_takes_partial_clouds() -> None:
    preset = warm_config()
    assert preset.part_start == "run"
    assert not preset.joint.base_fixed
    assert (preset.loss.recon_form, preset.loss.dir_align) == ("robust", 0)
    stages = Scapo(preset, CATEGORIES["laptop"], generator(0)).stages()
    assert not {"encoder", "decoder"} & {group.module for group in stages[1].parameters}
    assert Scapo(preset, CATEGORIES["laptop"], generator(0)).variant == "warm"


def test_a_start_may_be_a_released_model_by_name() -> None:
    assert load_run("oven", CATEGORIES["oven"]).category.name == "oven"
    with pytest.raises(StoreError, match="expected a run of registered on safe, found one of"):
        load_run("oven", CATEGORIES["safe"])
    with pytest.raises(StoreError, match="expected a run folder, a checkpoint or a category with"):
        load_run("ovens", CATEGORIES["oven"])
