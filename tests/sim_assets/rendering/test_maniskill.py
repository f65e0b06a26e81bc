# SPDX-License-Identifier: MIT
"""ManiSkill against SAPIEN: the same pictures, the same samples. Needs the extra [gpu-sim]."""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from scapo.geometry.camera import Intrinsics
from scapo.store import Split
from sim_assets.generation.assets import ProceduralAsset
from sim_assets.generation.generate import Running, generate
from sim_assets.generation.request import make_request, versions
from sim_assets.options import DataOptions
from sim_assets.rendering.backends import make_renderer
from sim_assets.rendering.base import AbstractParallelRenderer, RenderError, RenderRequest

pytestmark = [
    pytest.mark.render,
    pytest.mark.filterwarnings("ignore"),  # of the packages that ManiSkill brings
    pytest.mark.skipif(
        find_spec("mani_skill") is None, reason="the package mani_skill (extra [gpu-sim]) is absent"
    ),
]
CAMERA = Intrinsics.from_fov(1.0, 160, 120)
MILLIMETRE = 1e-3


def things(category: str, *indices: int) -> list:
    return [
        ProceduralAsset(category=category, split="train", seed=1, index=i).load() for i in indices
    ]


def many(**given) -> AbstractParallelRenderer:
    renderer = make_renderer("maniskill", **given)
    assert isinstance(renderer, AbstractParallelRenderer)
    return renderer


def request(seed: int, state: list[float], only: int | None = None) -> RenderRequest:
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_rotvec(np.random.default_rng(seed).normal(size=3)).as_matrix()
    pose[2, 3] = 0.3
    return RenderRequest(state=np.array(state), camera_T_object=pose, camera=CAMERA, only=only)


@pytest.mark.parametrize("color", [False, True], ids=["plain", "color"])
def test_pictures_are_those_of_sapien(color: bool):
    """Different objects, one of them twice, states, cameras; single parts; sub-scenes that rest."""
    shown = things("eyeglasses", 0, 1, 1)
    rounds = [
        [request(1, [0.0, 0.4]), request(2, [0.5, 1.0]), request(3, [1.2, 0.1])],
        [request(4, [0.2, 0.2], 1), None, request(5, [0.3, 0.9], 0)],
        [None, None, request(6, [0.6, 0.6])],
    ]
    with many(color=color) as renderer, make_renderer("sapien", color=color) as alone:
        assert isinstance(renderer, AbstractParallelRenderer)
        renderer.open_all(shown)
        for requests in rounds:
            for thing, asked, frame in zip(
                shown, requests, renderer.render_all(requests), strict=True
            ):
                if asked is None:
                    assert frame is None
                    continue
                alone.open(thing)
                expected = alone.render(
                    asked.state, asked.camera_T_object, asked.camera, asked.only
                )
                assert frame is not None
                assert np.array_equal(frame.part, expected.part)
                assert np.abs(frame.depth - expected.depth).max() < 0.01 * MILLIMETRE
                assert (frame.part != 255).any()
                if color:
                    assert frame.color is not None
                    assert expected.color is not None
                    assert np.array_equal(frame.color, expected.color)
                else:
                    assert frame.color is None


def test_what_cannot_be_asked():
    renderer = many()
    with pytest.raises(RenderError, match="expected one open object, found 0"):
        renderer.render(np.zeros(1), np.eye(4), CAMERA)
    renderer.open_all(things("laptop", 0, 1))
    with pytest.raises(RenderError, match="expected a request for each of 2, found 1"):
        renderer.render_all([None])
    assert renderer.render_all([None, None]) == [None, None]
    other = RenderRequest(
        state=np.zeros(1), camera_T_object=np.eye(4), camera=Intrinsics.from_fov(1.0, 64, 64)
    )
    with pytest.raises(RenderError, match="same intrinsics in all sub-scenes, found 2"):
        renderer.render_all([request(1, [0.1]), other])
    renderer.close()
    renderer.close()


@pytest.mark.parametrize(
    ("category", "given"),
    [("laptop", {}), ("drawer", {"protocol": "isolated"}), ("eyeglasses", {"color": True})],
    ids=["joint", "isolated", "color"],
)
def test_samples_are_those_of_sapien(category: str, given: dict, tmp_path: Path):
    splits = {}
    for backend in ("sapien", "maniskill"):
        asked = DataOptions(count=24, instances=3, image_size=192, **given, backend=backend)
        request, assets = make_request(category, asked)
        found = versions(request.settings.backend)
        generate(request, assets, tmp_path / backend, found, Running(workers=0))
        splits[backend] = Split(tmp_path / backend)
    ours, theirs = splits["maniskill"], splits["sapien"]
    assert ours.manifest.plan_digest == theirs.manifest.plan_digest
    assert ours.manifest.versions["mani_skill"]
    names = ["points", "part", "camera_T_part", "joint_pivot", "joint_state", "visible"]
    names += ["color"] if "color" in given else []
    a, b = ours.arrays(*names), theirs.arrays(*names)
    assert np.abs(a["points"] - b["points"]).max() < 0.01 * MILLIMETRE
    for name in names[1:]:
        assert np.array_equal(a[name], b[name]), name
