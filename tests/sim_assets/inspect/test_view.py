# SPDX-License-Identifier: MIT
"""The browser viewer: what it shows of a data set, seen by a headless Chromium."""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest

from scapo.drawing import PART_COLORS
from scapo.store import write_bytes
from scapo.store.manifest import read_manifest
from scapo.store.schema import StoreError
from sim_assets.generation.assets import ProceduralAsset, RecoverError, recover
from sim_assets.generation.build import build
from sim_assets.generation.generate import Running, generate
from sim_assets.generation.request import make_request, versions
from sim_assets.inspect.view import DisplayedSample, Viewer
from sim_assets.options import DataOptions
from tests.helpers.browser import open_page
from tests.helpers.odd_names import PARTS

pytestmark = [
    pytest.mark.skipif(
        find_spec("viser") is None, reason="the package viser (extra [view]) is not installed"
    ),
    pytest.mark.filterwarnings("ignore::DeprecationWarning:websockets"),
]


def make(folder: Path, category: str, **options) -> Path:
    given = DataOptions(protocol="full", count=6, instances=3, **{"points": 512, **options})
    request, assets = make_request(category, given)
    place = folder / category / "train"
    generate(request, assets, place, versions(request.settings.backend), Running(workers=0))
    return place


@pytest.fixture(scope="module")
def data(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("data")
    make(folder, "laptop")
    make(folder, "drawer")
    return folder


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("localhost", 0))
        return probe.getsockname()[1]


@pytest.fixture
def viewer(data: Path) -> Iterator[Viewer]:
    shown = Viewer(data, port=free_port())
    yield shown
    shown.close()


def wait_for(what: Callable[[], bool], seconds: float = 60.0) -> None:
    until = time.monotonic() + seconds
    while not what():
        assert time.monotonic() < until, f"not within {seconds} s"
        time.sleep(0.2)


def test_colours_are_shown_of_data_that_only_hold_them(tmp_path: Path):
    """As imported clouds do, and any that others wrote: the manifest need not say it."""
    place = make(tmp_path, "laptop", color=True)
    told = read_manifest(place / "manifest.json")
    options = {name: value for name, value in told.options.items() if name != "color"}
    write_bytes(place / "manifest.json", replace(told, options=options).to_json().encode())
    viewer = Viewer(tmp_path, port=free_port())
    try:
        assert not viewer.paint_box.disabled
        viewer.paint_box.value = "colour"
        viewer.show(1)
        assert (np.asarray(viewer.scene.cloud[0].colors) == viewer.row["color"]).all()
    finally:
        viewer.close()


def test_splits_samples_and_the_object_of_each(viewer: Viewer):
    assert tuple(viewer.splits) == ("drawer/train", "laptop/train")
    thing = viewer.thing
    assert thing is not None
    assert thing.instance == "drawer-train-1-00000"
    state = float(viewer.row["joint_state"][0])
    assert viewer.joint_boxes[0].value == pytest.approx(100 * state, abs=0.006)
    for p, pose in enumerate(thing.pose(np.array([viewer.joint_boxes[0].value / 100]))):
        assert np.allclose(viewer.scene.parts[p].position, pose[:3, 3])
    viewer.joint_boxes[0].value = 0.0
    assert np.allclose(viewer.scene.parts[1].position, 0)
    viewer.show(5)
    assert viewer.thing is not None
    assert viewer.thing.instance == "drawer-train-1-00002"
    assert "Sample 5 of 6" in viewer.text.content
    viewer.split_box.value = "laptop/train"
    assert viewer.number == 0
    assert viewer.thing is not None
    assert viewer.thing.category.name == "laptop"
    degrees = viewer.joint_boxes[0].value
    assert degrees == pytest.approx(np.degrees(viewer.row["joint_state"][0]), abs=0.006)


def test_object_and_cloud_are_at_the_same_place(viewer: Viewer):
    """Each point, mapped into its part's frame, lies on that part's mesh in the scene."""
    viewer.split_box.value = "laptop/train"
    viewer.show(3)
    thing, row = viewer.thing, viewer.row
    assert thing is not None
    for p in range(2):
        part_T_camera = np.linalg.inv(row["camera_T_part"][p].astype(float))
        points = row["points"][row["part"] == p] @ part_T_camera[:3, :3].T + part_T_camera[:3, 3]
        distance = thing.part_mesh(p).nearest.on_surface(points)[1]
        assert distance.max() < 1e-4


def test_boxes_hide_and_fade(viewer: Viewer):
    viewer.cloud_box.value = False
    viewer.mesh_box.value = False
    viewer.opacity_box.value = 0.8
    viewer.show(1)
    assert not viewer.scene.cloud[0].visible
    assert not any(part.visible for part in viewer.scene.parts)
    assert viewer.scene.axes[0].visible
    assert not viewer.scene.camera[0].visible
    assert {mesh.opacity for mesh in viewer.scene.meshes} == {0.8}


def test_objects_are_recovered_or_the_reason_is_said(data: Path, tmp_path: Path):
    manifest = read_manifest(data / "laptop/train/manifest.json")
    thing = recover(manifest, 2)
    expected = ProceduralAsset(category="laptop", split="train", seed=1, index=2).load()
    assert thing.origin.sha256 == expected.origin.sha256
    changed = replace(manifest.instances[0], sha256="0" * 64)
    with pytest.raises(RecoverError, match=r"has changed since"):
        recover(replace(manifest, instances=(changed,)), 0)
    with pytest.raises(RecoverError, match="expected procedural objects or URDF models, found set"):
        recover(replace(manifest, options={"source": "set"}), 0)
    models = tmp_path / "models"
    list(build("laptop", count=3, seed=4, out=models, split="train"))
    place = make(tmp_path / "set", "laptop", source=str(models))
    manifest = read_manifest(place / "manifest.json")
    with pytest.raises(RecoverError, match=r"the folder of models \(--source\), found none"):
        recover(manifest, 0)
    for index, instance in enumerate(manifest.instances):
        assert recover(manifest, index, models).origin.sha256 == instance.sha256
    with pytest.raises(RecoverError, match=r"expected the model .*mobility\.urdf, found none"):
        recover(manifest, 0, tmp_path / "nowhere")


def test_a_cloud_without_object_or_pose_is_shown(data: Path, tmp_path: Path):
    """Clouds of another set: no object to make again."""
    for path in (data / "laptop/train").iterdir():
        text = path.read_bytes()
        if path.name == "manifest.json":
            text = text.replace(b'"source": "procedural"', b'"source": "their-set"')
        write_bytes(tmp_path / path.name, text)
    viewer = Viewer(tmp_path, port=free_port())
    try:
        assert tuple(viewer.splits) == ("laptop/train",)
        assert viewer.thing is None
        assert viewer.joint_boxes == []
        assert "No mesh: laptop-train-1-00000: expected procedural" in viewer.text.content
        viewer.frame_box.value = "camera"
        viewer.show(1)
        assert len(viewer.scene.axes) == 1
    finally:
        viewer.close()


def test_the_size_of_a_cloud_is_not_that_of_its_stray_points():
    points = np.zeros((1000, 3), np.float32)
    points[:, 0] = np.linspace(0, 1, 1000)
    points[5] = 50
    sample = DisplayedSample(
        points=points,
        colors=np.zeros((1000, 3), np.uint8),
        camera_T_object=np.full((4, 4), np.nan),
        pivot=np.zeros((0, 3)),
        axis=np.zeros((0, 3)),
        camera=np.zeros(6),
    )
    assert sample.reach == pytest.approx(0.98, abs=0.002)
    assert not sample.placed


def near(picture: np.ndarray, color: str) -> int:
    """Pixels of a colour."""
    wanted = np.array(list(bytes.fromhex(color[1:])))
    return int((np.abs(picture.astype(int) - wanted).max(-1) < 12).sum())


def test_names_from_files_are_text_in_a_browser(data: Path, tmp_path: Path):
    for path in (data / "laptop/train").iterdir():
        write_bytes(tmp_path / "data" / path.name, path.read_bytes())
    manifest = json.loads((tmp_path / "data/manifest.json").read_text())
    manifest["parts"] = PARTS
    manifest["instances"][2]["id"] = odd = "<b onclick=alert()>laptop</b>"
    write_bytes(tmp_path / "data/manifest.json", json.dumps(manifest).encode())
    viewer = Viewer(tmp_path / "data", port=free_port())
    try:
        assert "<img" not in viewer.legend.content + viewer.text.content
        with open_page(viewer.url, tmp_path / "profile") as page:
            wait_for(lambda: all(name in page.text() for name in PARTS))
            assert f"{PARTS[1]} (deg)" in page.text()
            viewer.show(5)
            wait_for(lambda: f"Sample 5 of 6: {odd}" in page.text())
            assert page.evaluate("document.title") not in ("1", "2", "3", "4")
            assert page.evaluate("document.querySelectorAll('img[src=x], b').length") == 0
    finally:
        viewer.close()


def test_the_server_has_cloud_object_and_controls(viewer: Viewer):
    """What a browser is given to show; `near` of the test below sees it there."""
    viewer.split_box.value = "laptop/train"
    cloud, colors = viewer.scene.cloud[0], [bytes.fromhex(color[1:]) for color in PART_COLORS]
    painted = [bytes(color) for color in np.asarray(cloud.colors, np.uint8)]
    assert painted == [colors[part] for part in viewer.row["part"]]
    assert set(painted) == set(colors[:2])
    assert np.allclose(cloud.points, viewer.row["points"])
    viewer.cloud_box.value = False
    assert not cloud.visible
    assert viewer.thing is not None
    for handle, visual in zip(viewer.scene.meshes, sum(viewer.thing.visuals, ()), strict=True):
        assert np.allclose(handle.vertices, visual.mesh.vertices)
    assert viewer.joint_boxes[0].label == "screen (deg)"
    assert [viewer.split_box.label, viewer.sample_box.label] == ["Data", "Sample"]
    assert viewer.axes_box.label == "Joint axes"
    assert "laptop-train-1-00000" in viewer.text.content
    assert "base" in viewer.legend.content


@pytest.mark.slow
def test_chromium_shows_cloud_object_and_controls(viewer: Viewer, tmp_path: Path):
    viewer.split_box.value = "laptop/train"
    viewer.mesh_box.value = False
    with open_page(viewer.url, tmp_path / "profile") as page:
        wait_for(lambda: "Joints of the object" in page.text())
        wait_for(lambda: near(page.picture()[:, :900], PART_COLORS[1]) > 300)
        text = page.text()
        cloud = page.picture(tmp_path / "cloud.png")[:, :900]
        viewer.cloud_box.value = False
        wait_for(lambda: near(page.picture()[:, :900], PART_COLORS[1]) < 20)
        viewer.mesh_box.value = True
        viewer.opacity_box.value = 1.0
        wait_for(lambda: (page.picture()[:, 320:900] < 245).any(-1).sum() > 5000)
        as_seen = page.picture()[:, 320:900].astype(int)
        viewer.joint_boxes[0].value = 0.0  # the lid closes
        wait_for(lambda: (np.abs(page.picture()[:, 320:900] - as_seen).max(-1) > 30).mean() > 0.01)
    for words in ("Data", "Sample", "Joint axes", "screen (deg)", "laptop-train-1-00000", "base"):
        assert words in text
    assert near(cloud, PART_COLORS[0]) > 300


def test_the_command_ends_cleanly_on_ctrl_c(data: Path, repository: Path):
    command = [sys.executable, "-m", "sim_assets", "view", data, "--port", str(free_port())]
    process = subprocess.Popen(
        command,
        cwd=repository,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env={**os.environ, "PYTHONUNBUFFERED": "1"},
    )
    assert process.stdout is not None
    for line in process.stdout:
        if "(Ctrl-C ends it)" in line:
            break
    process.send_signal(signal.SIGINT)
    out, err = process.communicate(timeout=60)
    assert process.returncode == 0, out + err
    assert err == ""


def test_what_cannot_be_shown_is_refused(data: Path, tmp_path: Path, monkeypatch):
    with pytest.raises(StoreError, match="expected a data set"):
        Viewer(tmp_path)
    with pytest.raises(ValueError, match="port: expected 1 to 65535, found 0"):
        Viewer(data, port=0)
    with pytest.raises(ValueError, match="host: expected an address of this machine, found '192"):
        Viewer(data, host="192.0.2.1")
    monkeypatch.setitem(sys.modules, "viser", None)  # as if it were not installed
    with pytest.raises(RuntimeError, match=r"pip install 'scapo\[view\]'"):
        Viewer(data)
