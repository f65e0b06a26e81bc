# SPDX-License-Identifier: MIT
"""The cube that tells whether a renderer works."""

from __future__ import annotations

import json
from importlib import metadata

import numpy as np
import pytest

from sim_assets.rendering import probe
from sim_assets.rendering.base import Frame


class Mirror:
    """A renderer whose pictures show one depth and one part."""

    def __init__(self, depth: float, part: int) -> None:
        self.frame = Frame(
            depth=np.full((16, 16), depth, np.float32), part=np.full((16, 16), part, np.uint8)
        )

    def __enter__(self) -> Mirror:
        return self

    def __exit__(self, *exc: object) -> None: ...

    def open(self, thing: object) -> None: ...

    def render(self, *unused: object) -> Frame:
        return self.frame


def test_cube_is_one_metre_about_the_origin():
    np.testing.assert_allclose(probe.cube().part_mesh(0).bounds, [[-0.5] * 3, [0.5] * 3])


def test_ray_casting_draws_the_cube(capsys: pytest.CaptureFixture[str]):
    pytest.importorskip("embreex")
    probe.main("raycast")
    assert json.loads(capsys.readouterr().out) == f"CPU, embreex {metadata.version('embreex')}"


@pytest.mark.parametrize(("depth", "part"), [(1.502, 0), (1.5, 1), (0.0, 255)])
def test_a_wrong_picture_is_told(monkeypatch: pytest.MonkeyPatch, depth: float, part: int):
    monkeypatch.setattr(probe, "make_renderer", lambda backend: Mirror(depth, part))
    expected = f"raycast: expected depth 1.5 m of part 0, found {depth:.4f} m of part {part}"
    with pytest.raises(ValueError, match=expected):
        probe.draw_cube("raycast")


def test_the_right_picture_passes(monkeypatch: pytest.MonkeyPatch):
    pytest.importorskip("embreex")
    monkeypatch.setattr(probe, "make_renderer", lambda backend: Mirror(1.5, 0))
    assert probe.draw_cube("raycast").startswith("CPU")


def test_unknown_renderer():
    with pytest.raises(ValueError, match=r"expected one of .*sapien.*, found 'opengl'"):
        probe.main("opengl")
