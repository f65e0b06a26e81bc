# SPDX-License-Identifier: MIT
"""A model that is told the truth answers with it, and what speaks for an answer falls with it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial import KDTree

from bench.infer.answer import agreement, ask
from bench.infer.cloud import Cloud, InputError
from bench.matching import rotation_degrees
from bench.twin.record import BACKGROUND
from scapo.predictor import Predictor
from tests.helpers.placed import Told, told_model


@pytest.fixture(scope="module")
def told() -> Told:
    return Told(4, wrong={1: 0.5})


def test_the_truth_is_handed_on_in_the_cameras_frame(told):
    cloud = Cloud(points=told.clouds()[0])
    twin = ask("a", cloud, told_model(told), "fast")
    rotation = told.truth.rotation[0].numpy()
    assert rotation_degrees(twin.camera_T_part[:1, :3, :3], rotation[None]) < 0.1
    assert twin.state[0] == pytest.approx(float(told.truth.state[0, 0]), abs=1e-5)
    axis = rotation @ [0, 1, 0]
    np.testing.assert_allclose(twin.axis[0], axis, atol=1e-5)
    true_pivot = (
        rotation @ [-0.2, 0, -0.15] + (told.truth.translation[0] - told.views.camera[0]).numpy()
    )
    away = twin.pivot[0] - true_pivot
    np.testing.assert_allclose(away - axis * (away @ axis), 0, atol=1e-5)
    assert twin.limits[0, 0] <= twin.state[0] <= twin.limits[0, 1]
    assert twin.shape is not None
    assert np.median(KDTree(twin.shape.points).query(twin.points)[0]) < 0.03
    for part in (0, 1):  # each observed part lies on the shape's
        own = KDTree(twin.shape.points[twin.shape.part == part])
        assert np.median(own.query(twin.points[twin.part == part])[0]) < 0.03
    assert twin.model == {"name": "told", "method": "told", "sha256": "0" * 64}
    assert twin.frame == "camera"
    elsewhere = Cloud(points=told.clouds()[0], sensor=np.array([0, 0, 0.1]))
    assert ask("a", elsewhere, told_model(told), "fast").frame == "input"


def test_a_wrong_answer_has_a_larger_residual_and_draws_that_differ_a_larger_spread(told):
    clouds = [Cloud(points=points) for points in told.clouds()]
    model = told_model(told)
    right, wrong = (ask("a", clouds[k], model, "fast") for k in (0, 1))
    assert right.evidence["residual"] < 0.6 * wrong.evidence["residual"]
    assert right.evidence["margin"] == pytest.approx(0.9)
    sure = agreement(clouds[0], right, model, "fast")
    assert sure.evidence["joint_0_spread"] < 0.1
    assert sure.evidence["part_0_spread"] < 0.1
    turned = replace(right, camera_T_part=wrong.camera_T_part, axis=wrong.axis)
    unsure = agreement(clouds[0], turned, model, "fast")
    assert unsure.evidence["part_1_spread"] > 5


def test_how_well_a_view_is_explained_is_not_said_of_whole_surfaces(told):
    cloud = Cloud(points=told.clouds()[0])
    assert "residual" in ask("a", cloud, told_model(told), "fast").evidence
    assert "residual" not in ask("a", cloud, told_model(told), "whole").evidence


def test_points_far_off_belong_to_no_part(told):
    points = told.clouds()[0]
    far = points[:6] + np.array([0, 0, 3], np.float32)
    twin = ask("a", Cloud(points=np.concatenate([points, far])), told_model(told), "fast")
    assert (twin.part[-6:] == BACKGROUND).all()
    assert (twin.part[:-6] != BACKGROUND).mean() > 0.98


def test_a_cloud_of_another_size_is_doubted(told):
    points = told.clouds()[0]
    (limits,) = ask("a", Cloud(points=points), told_model(told), "fast").warnings
    assert limits == "joint limits are a guess: the method knows neither rest nor range"
    small = Cloud(points=points * np.float32(0.01))
    words = ask("a", small, told_model(told), "fast").warnings
    assert "is it in metres (--scale)?" in words[0]


def test_answers_that_are_none_are_refused(told, monkeypatch):
    cloud, model = Cloud(points=told.clouds()[0]), told_model(told)
    found = model.predictor.predict(cloud.points)
    bare = replace(found, joints=None)
    monkeypatch.setattr(Predictor, "predict", lambda *_, **__: bare)
    with pytest.raises(InputError, match="a method that predicts poses and joints"):
        ask("a", cloud, model, "fast")
    assert found.camera_T_part is not None
    lost = replace(found, camera_T_part=found.camera_T_part * np.nan)
    monkeypatch.setattr(Predictor, "predict", lambda *_, **__: lost)
    with pytest.raises(InputError, match="an answer in numbers, found NaN"):
        ask("a", cloud, model, "fast")


def test_a_model_that_cannot_use_the_up_is_asked_without_it_and_says_so(told):
    cloud, model = Cloud(points=told.clouds()[0]), told_model(told)
    plain = ask("a", cloud, model, "fast")
    told_up = ask("a", replace(cloud, up=np.array([0.0, -1, 0])), model, "fast")
    assert {*told_up.warnings} - {*plain.warnings} == {"this model cannot use --up"}
    np.testing.assert_allclose(told_up.axis, plain.axis)
