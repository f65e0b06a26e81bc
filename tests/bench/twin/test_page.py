# SPDX-License-Identifier: MIT
"""The page of a twin: what is in it, and what a headless Chromium shows of it."""

from __future__ import annotations

import base64
import io
import json
import re
import zipfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yourdfpy

from bench.twin.export import write_twin
from bench.twin.page import write_page
from bench.twin.record import Twin
from scapo.categories import category
from tests.helpers.browser import Page, open_page
from tests.helpers.twins import cabinet

LISTEN = """
window.wrong = [];
for (const kind of ["error", "unhandledrejection", "securitypolicyviolation"])
  window.addEventListener(kind, (event) => window.wrong.push(kind + ": " + event.message));
for (const level of ["error", "warn"])
  console[level] = (...words) => window.wrong.push(words.join(" "));
"""


@pytest.fixture(scope="module")
def twin() -> Twin:
    return cabinet(
        joint_confidence=np.array([0.87]),
        part_confidence=np.array([0.91, 0.64]),
        evidence={"residual": 0.0123},
        model={"method": "registered"},
        warnings=("The cloud is small: <b>12</b> points.",),
    ).twin


@pytest.fixture(scope="module")
def folder(twin: Twin, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """With `page.html` and, in `object`, what it offers."""
    made = tmp_path_factory.mktemp("page")
    write_page(twin, made / "page.html", write_twin(twin, made / "object"))
    return made


def download(page: str, name: str) -> bytes:
    found = re.search(f'download="{re.escape(name)}" href="data:[^;]+;base64,([^"]+)"', page)
    assert found is not None, name
    return base64.b64decode(found[1])


def test_the_model_is_named_whole_and_its_digest_in_short(twin: Twin, tmp_path: Path):
    model = {"name": "oven", "method": "registered-labelled", "sha256": "0123456789abcdef" * 4}
    page = write_page(replace(twin, model=model), tmp_path / "page.html").read_text()
    assert "model: name oven, method registered-labelled, sha256 0123456789ab<" in page


def test_the_frame_of_the_numbers_is_said(twin: Twin, tmp_path: Path):
    for frame, words in (
        ("camera", "Joints in the camera&#x27;s frame: x right, y down, z forward."),
        ("input", "Joints in the frame of the input."),
    ):
        page = write_page(replace(twin, frame=frame), tmp_path / "page.html").read_text()
        assert words in page


def test_it_carries_the_numbers_and_the_files(folder: Path, tmp_path: Path):
    page = (folder / "page.html").read_text()
    for words in ("34.4°", "85.9°", "87% within 5°", "64% within 10°", "0.0123", "registered"):
        assert words in page
    assert "&lt;b&gt;12&lt;/b&gt;" in page
    assert "<b>12" not in page
    assert not re.search(r"@[A-Z]+@", page)
    assert re.search(r"(?:https?:)?//\w+\.\w+/", page) is None  # nothing from elsewhere
    for name in ("twin.glb", "twin.json"):
        assert download(page, name) == (folder / "object" / name).read_bytes()
    with zipfile.ZipFile(io.BytesIO(download(page, "urdf.zip"))) as archive:
        archive.extractall(tmp_path)
    robot = yourdfpy.URDF.load(str(tmp_path / "mobility.urdf"))
    assert robot.actuated_joint_names == ["door_joint"]
    assert len(robot.scene.geometry) == 2


def test_equal_twins_give_equal_pages_and_large_files_are_named_only(
    twin: Twin, folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    files = sorted((folder / "object").glob("twin.*"))
    first, second = (write_page(twin, tmp_path / name, files).read_bytes() for name in "ab")
    assert first == second
    monkeypatch.setattr("bench.twin.page.MAX_DOWNLOAD", 1000)
    page = write_page(twin, tmp_path / "c", files).read_text()
    assert "too large for this page" in page
    assert "model/gltf-binary" not in page
    assert json.loads(download(page, "twin.json"))["category"] == "safe"


def test_of_a_dense_cloud_few_points_hide_what_moves(
    twin: Twin, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    shown = len(twin.points) // 3
    monkeypatch.setattr("bench.twin.page.MAX_POINTS", shown)
    page = write_page(twin, tmp_path / "dense.html").read_text()
    found = re.search(r'<script type="application/json" id="data">(.*?)</script>', page)
    assert found is not None
    clouds = json.loads(found[1])["clouds"]
    count = [len(base64.b64decode(cloud["points"])) // 12 for cloud in clouds]
    assert sum(count) == shown
    assert len(count) == len(np.unique(twin.part))


def test_names_from_outside_are_text(twin: Twin, tmp_path: Path):
    """Also where they look like a field of the template, or end the script."""
    odd = replace(
        twin, name="</script><img src=x onerror=alert(1)>@DATA@", model={"<i>": "</title>"}
    )
    page = write_page(odd, tmp_path / "odd.html").read_text()
    assert "<img" not in page
    assert "<i>" not in page
    assert page.count("</script>") == 2
    assert "@DATA@" in page


def test_uncalibrated_confidence_and_a_part_without_surface_are_said(tmp_path: Path):
    made = cabinet(state=0.2, name="drawer")
    bare = replace(made.twin, part=np.zeros_like(made.twin.part), shape=None)
    assert bare.category == category("drawer")
    page = write_page(bare, tmp_path / "page.html").read_text()
    assert "drawer: no point of it was seen; it has no surface" in page
    assert page.count("not calibrated") == 3
    assert "20.0 cm" in page
    assert "Files</h2>\n<p" in page


def scene(page: Page, file: Path | None = None) -> np.ndarray:
    """The picture of the drawing, once it is painted."""
    page.evaluate("new Promise((go) => requestAnimationFrame(() => requestAnimationFrame(go)))")
    box = page.evaluate(
        "(({x, y, width, height}) => [x, y, width, height])"
        "(document.querySelector('canvas').getBoundingClientRect())"
    )
    x, y, width, height = (round(value) for value in box)
    return page.picture(file)[y + 4 : y + height - 4, x + 4 : x + width - 4].astype(int)


def contrast(one: np.ndarray, other: np.ndarray) -> float:
    """Of two sRGB colours (WCAG 2)."""
    share = np.stack([one, other]) / 255
    linear = np.where(share <= 0.04045, share / 12.92, ((share + 0.055) / 1.055) ** 2.4)
    light = sorted(linear @ [0.2126, 0.7152, 0.0722])
    return float((light[1] + 0.05) / (light[0] + 0.05))


def texts(page: Page) -> list[float]:
    """Contrast of every text with what is behind it."""
    colors = page.evaluate(
        """[...document.querySelectorAll("h1, h2, p, td, th, caption, label, span, output, button,"
        + " a, li, legend")].filter((e) => e.offsetParent && e.textContent.trim()).map((e) => {
          let back = e;
          const clear = () => getComputedStyle(back).backgroundColor === "rgba(0, 0, 0, 0)";
          while (back.parentElement && clear()) back = back.parentElement;
          return [getComputedStyle(e).color, getComputedStyle(back).backgroundColor]; })"""
    )
    found = [[np.array(re.findall(r"[\d.]+", c)[:3], float) for c in pair] for pair in colors]
    return [contrast(*pair) for pair in found]


@pytest.mark.filterwarnings("ignore::DeprecationWarning:websockets")
def test_chromium_moves_the_door_without_a_complaint(folder: Path, tmp_path: Path):
    with open_page((folder / "page.html").as_uri(), tmp_path / "profile") as page:
        page.call("Page.enable")
        page.call("Page.addScriptToEvaluateOnNewDocument", source=LISTEN)
        page.call("Network.enable")
        page.call("Network.emulateNetworkConditions", offline=True, latency=0,
                  downloadThroughput=0, uploadThroughput=0)  # fmt: skip
        page.call("Page.reload")
        page.evaluate(
            "new Promise((go) => document.readyState === 'complete' ? go() : "
            "window.addEventListener('load', go))"
        )
        before = scene(page, tmp_path / "observed.png")
        page.evaluate(
            "{ const s = document.getElementById('joint-0'); s.value = s.max;"
            "s.dispatchEvent(new Event('input')); }"
        )
        after = scene(page, tmp_path / "open.png")
        assert "85.9°" in page.text()
        assert page.evaluate("document.getElementById('joint-0').ariaValueText") == "85.9°"
        changed = np.abs(after - before).max(-1) > 40
        assert 0.005 < changed.mean() < 0.3  # the door, not the body nor the background
        rows, columns = np.nonzero(changed)
        assert np.ptp(rows) > 30
        assert np.ptp(columns) > 30
        page.evaluate("document.getElementById('reset').click()")
        assert (np.abs(scene(page) - before).max(-1) > 40).mean() < 0.001
        press = "document.querySelector('canvas').dispatchEvent(new KeyboardEvent('keydown', %s))"
        page.evaluate(press % "{key: 'ArrowLeft'}")
        assert (np.abs(scene(page) - before).max(-1) > 40).mean() > 0.01
        page.evaluate(press % "{key: '0'}")
        assert (np.abs(scene(page) - before).max(-1) > 40).mean() < 0.001
        assert min(texts(page)) >= 4.5
        page.call(
            "Emulation.setEmulatedMedia",
            features=[{"name": "prefers-color-scheme", "value": "dark"}],
        )
        dark = scene(page, tmp_path / "dark.png")
        assert before[2, 2].min() > 240
        assert dark[2, 2].max() < 60
        assert min(texts(page)) >= 4.5
        assert page.evaluate("window.wrong") == []
        assert page.evaluate(
            "[...document.querySelectorAll('input')].every((i) => i.labels.length)"
        )
