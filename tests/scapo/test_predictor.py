# SPDX-License-Identifier: MIT
"""A trained model from disk answers as it did in memory, for one cloud or many."""

from __future__ import annotations

import inspect
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest
import torch
from safetensors.torch import load_file
from torch.testing import assert_close

from scapo.alignment import unit_length
from scapo.categories import CATEGORIES
from scapo.geometry.rigid import axis_angle, rotation_angle
from scapo.geometry.rotations import rotvec_to_rotmat
from scapo.paper.method import Scapo
from scapo.predictor import Predictor, load
from scapo.registered.config import RegisteredConfig
from scapo.registered.method import TemplateRegistration
from scapo.registry import LIBRARY
from scapo.released import find, released
from scapo.store.checkpoint import WEIGHTS, checkpoint_header, with_alignment, write_checkpoint
from scapo.store.schema import StoreError
from scapo.types import Observation, Prediction
from tests.helpers.conventions import convention
from tests.helpers.hinged import plates
from tests.helpers.strategies import generator
from tests.helpers.tiny import TINY, tiny


@pytest.fixture
def saved(tmp_path: Path) -> Path:
    header = checkpoint_header("scapo", TINY, "laptop", {})
    write_checkpoint(tmp_path / WEIGHTS, tiny(), header)
    return tmp_path


def test_answers_are_those_of_the_model(saved: Path) -> None:
    points = plates(3, 96)[0].points
    wanted = tiny().eval().predict(Observation(points=points))
    many = load(saved).predict(points.numpy())
    assert_close(many.part_weight, wanted.part_weight)
    assert_close(many.camera_T_part, wanted.camera_T_part)
    one = load(str(saved / WEIGHTS)).predict(points[0])
    assert one.part_weight.shape == (96, 2)
    assert one.joints is not None
    assert wanted.joints is not None
    assert_close(one.joints.pivot, wanted.joints.pivot[0])
    nested = load(saved).predict(points.numpy().reshape(3, 1, 96, 3))
    assert nested.part_weight.shape == (3, 1, 96, 2)


def test_a_stored_alignment_is_applied_unless_own_frames_are_asked_for(saved: Path) -> None:
    points = plates(3, 96)[0].points
    own = load(saved).predict(points)
    assert not load(saved).in_object_frame
    alignment = convention((1, 0), np.random.default_rng(0))
    with_alignment(saved / WEIGHTS, alignment)
    model = load(saved)
    assert model.in_object_frame
    assert_close(model.predict(points, own_frame=True).camera_T_part, own.camera_T_part)
    category = CATEGORIES["laptop"]
    found = model.predict(points)
    wanted = alignment.apply(own, unit_length(points), category)
    for field in ("part_weight", "camera_T_part", "canonical_points"):
        assert_close(getattr(found, field), getattr(wanted, field))
    nested = model.predict(points.reshape(3, 1, 96, 3)).camera_T_part
    assert nested is not None
    assert_close(nested[:, 0], found.camera_T_part)


KINDS = ("backwards", "columns", "big-endian", "read-only", "double", "tensor", "gradient")


@pytest.mark.parametrize("kind", KINDS)
def test_how_an_array_lies_in_memory_changes_no_answer(saved: Path, kind: str, monkeypatch) -> None:
    points = plates(2, 96)[0].points.numpy()
    fixed = points.copy()
    fixed.flags.writeable = False
    other = {
        "backwards": np.ascontiguousarray(points[:, ::-1])[:, ::-1],
        "columns": np.asfortranarray(points),
        "big-endian": points.astype(">f4"),
        "read-only": fixed,
        "double": points.astype(np.float64),
        "tensor": torch.from_numpy(points).mT.contiguous().mT,
        "gradient": torch.tensor(points, requires_grad=True),
    }[kind]
    wanted = load(saved).predict(torch.from_numpy(points))
    model = load(saved)
    asked = Mock(wraps=model.model.predict)
    monkeypatch.setattr(model.model, "predict", asked)
    found = model.predict(other).camera_T_part
    assert_close(found, wanted.camera_T_part, rtol=0, atol=0)
    # The least difference of rounding, as of another layout, grows in `refine`.
    assert asked.call_args[0][0].points.is_contiguous()


@pytest.mark.parametrize("shape", [(3,), (96, 2), (4, 3)])
def test_other_shapes_are_refused(saved: Path, shape: tuple[int, ...]) -> None:
    with pytest.raises(ValueError, match=r"points: expected shape \(..., N, 3\) with N at least 6"):
        load(saved).predict(np.zeros(shape, np.float32))


def test_values_that_are_not_finite_are_called_that(saved: Path) -> None:
    points = plates(2, 96)[0].points
    points[1, 3:5, 0] = torch.nan
    with pytest.raises(ValueError, match=r"expected finite .* NaN or infinity in 2 of 192 points"):
        load(saved).predict(points)


def test_far_from_the_origin_points_would_be_rounded(saved: Path) -> None:
    points = plates(1, 96)[0].points.double() + 5e5
    with pytest.raises(ValueError, match=r"nearer to the origin, found 5e\+05 m, .* 0.031 m apart"):
        load(saved).predict(points, sensor=torch.full((3,), 5e5))
    load(saved).predict(points - 5e5 + 100)


@pytest.mark.parametrize("values", [np.zeros((96, 3), complex), np.full((96, 3), None)])
def test_what_are_no_real_numbers_is_called_that(saved: Path, values: np.ndarray) -> None:
    with pytest.raises(ValueError, match="expected real numbers, found an array of"):
        load(saved).predict(values)


def test_another_mode_is_refused_with_those_there_are(saved: Path) -> None:
    words = "mode: expected one of fast, quick, refine, whole, found 'best'"
    with pytest.raises(ValueError, match=words):
        inspect.unwrap(Predictor.predict)(load(saved), plates(1, 96)[0].points, "best")


@pytest.mark.parametrize(("name", "first"), [("oven", 0), ("scissors", 1)])  # the template's first
def test_a_cloud_stands_as_it_is_said_to(name: str, first: int) -> None:
    points = load_file(f"results/checks/{name}.safetensors")["points"][:3]
    model = load(name)
    pose = model.predict(points).camera_T_part
    assert pose is not None
    up = pose[..., :3, 2] @ rotvec_to_rotmat(torch.tensor([0.02, -0.03, 0.04]))
    found = model.predict(points, up=7 * up[:, first]).camera_T_part
    assert found is not None
    assert axis_angle(found[:, first, :3, 2], up[:, first]).max() < 2e-3
    alike = model.predict(points[0], up=up[0, first].numpy()).camera_T_part
    assert alike is not None
    assert rotation_angle(alike[:, :3, :3], found[0, :, :3, :3]).max().rad2deg() < 1


def test_an_up_that_nobody_can_use_is_refused(saved: Path) -> None:
    points = plates(3, 96)[0].points
    with pytest.raises(ValueError, match="up: expected a model of template registration"):
        load(saved).predict(points, up=np.array([0.0, -1, 0]))
    for wrong in (np.zeros(3), np.array([np.nan, 0, 1])):
        with pytest.raises(ValueError, match="up: expected finite vectors of some length"):
            load(saved).predict(points, up=wrong)


def test_what_is_not_there_is_named(tmp_path: Path) -> None:
    with pytest.raises(StoreError, match="nowhere: expected a run folder, a checkpoint or a cat"):
        load("nowhere")
    write_checkpoint(tmp_path / WEIGHTS, tiny(), checkpoint_header("other", TINY, "laptop", {}))
    known = ", ".join(LIBRARY)
    with pytest.raises(StoreError, match=f"expected a method of {known}, found 'other'"):
        load(tmp_path)


def test_the_registered_variant_loads_too(tmp_path: Path) -> None:
    config = RegisteredConfig(points=64, width=8)
    model = TemplateRegistration(config, CATEGORIES["laptop"], generator(0)).eval()
    write_checkpoint(
        tmp_path / WEIGHTS, model, checkpoint_header("registered", config, "laptop", {})
    )
    points = plates(2, 96)[0].points
    wanted = model.predict(Observation(points=points))
    found = load(tmp_path).predict(points, "fast", sensor=np.zeros(3))
    assert_close(found.part_weight, wanted.part_weight)
    assert_close(found.camera_T_part, wanted.camera_T_part)
    one = load(tmp_path).predict(points[0].double().numpy(), "fast")
    assert_close(one.part_weight, wanted.part_weight[0])
    assert found.confidence is not None
    assert_close(one.confidence, found.confidence[0])
    few = load(tmp_path).predict(points[:, :40], "fast")
    assert few.part_weight.shape == (2, 40, 2)
    with pytest.raises(ValueError, match="at least one cloud, found"):
        load(tmp_path).predict(np.zeros((0, 96, 3)))


@pytest.mark.parametrize(("name", "usual"), [("scapo", "fast"), ("registered", "quick")])
def test_who_asks_for_no_mode_gets_the_usual_one(monkeypatch, name: str, usual: str) -> None:
    kind = {"scapo": Scapo, "registered": TemplateRegistration}[name]
    config = {"scapo": TINY, "registered": RegisteredConfig(points=64, width=8)}[name]
    model, asked = kind(config, CATEGORIES["laptop"], generator(0)), list[str]()

    def predict(observation: Observation, mode: str) -> Prediction:
        asked.append(mode)
        return Prediction(part_weight=torch.ones(len(observation.points), 96, 2) / 2)

    monkeypatch.setattr(model, "predict", predict)
    Predictor(model, "cpu").predict(plates(2, 96)[0].points)
    Predictor(model, "cpu").predict(plates(2, 96)[0].points, "refine")
    assert asked == [usual, "refine"]


def test_a_misspelt_category_is_told_the_one_that_looks_like_it(monkeypatch) -> None:
    monkeypatch.setattr("scapo.released.weights", lambda: {"oven": Path(), "laptop": Path()})
    with pytest.raises(StoreError, match=r"\(oven, laptop\), found none; did you mean 'oven'\?$"):
        load("oevn")


def test_a_folder_of_clouds_hides_no_released_model_but_a_run_does(monkeypatch, saved) -> None:
    model = saved / "weights" / "oven.safetensors"
    monkeypatch.setattr("scapo.released.weights", lambda: {"oven": model})
    monkeypatch.chdir(saved)
    (saved / "oven" / "test").mkdir(parents=True)
    assert find("oven") == model
    (saved / WEIGHTS).rename(saved / "oven" / WEIGHTS)
    assert find("oven") == Path("oven")


def test_released_weights_are_those_of_categories() -> None:
    for category, path in released().items():
        assert category in CATEGORIES
        assert path.is_file()
