# SPDX-License-Identifier: MIT
"""Pictures show what they are given: parts in their colours, axes where they are, one scale."""

from __future__ import annotations

import io

import numpy as np
import pytest
import torch

pytest.importorskip("matplotlib")
from matplotlib.colors import to_rgb
from PIL import Image

from scapo.drawing import PART_COLORS
from scapo.pictures import OBLIQUE, Panel, PictureData, render


def square(side: float) -> torch.Tensor:
    """A grid in the image plane of the camera view."""
    line = torch.linspace(-side / 2, side / 2, 40)
    x, y = torch.meshgrid(line, line, indexing="ij")
    return torch.stack([x.flatten(), y.flatten(), torch.ones(1600)], -1)


def picture(*panels: Panel) -> PictureData:
    return PictureData(panels=panels, view="camera")


def where(pixels: np.ndarray, color: str) -> np.ndarray:
    wanted = np.round(255 * np.array(to_rgb(color)))
    return np.argwhere(np.abs(pixels.astype(int) - wanted).max(-1) < 12)


def test_parts_have_their_colours_and_places() -> None:
    points = square(1.0)
    part = (points[:, 1] > 0).long()  # y points down: part 1 is below
    _, pixels = render(picture(Panel(points=points, part=part)))
    upper, lower = where(pixels, PART_COLORS[0]), where(pixels, PART_COLORS[1])
    assert len(upper) > 500
    assert len(lower) > 500
    assert upper[:, 0].max() <= lower[:, 0].min() + 2


def test_all_panels_have_one_scale() -> None:
    _, pixels = render(picture(Panel(points=square(1.0)), Panel(points=square(0.5))))
    middle = pixels.shape[1] // 2
    found = where(pixels, PART_COLORS[0])
    left, right = found[found[:, 1] < middle, 1], found[found[:, 1] >= middle, 1]
    assert np.ptp(right) == pytest.approx(np.ptp(left) / 2, rel=0.1)


def test_an_axis_is_a_line_through_the_cloud() -> None:
    pivot, axis = torch.tensor([[5.0, 0.0, 1.0]]), torch.tensor([[1.0, 0.0, 0.0]])
    panel = Panel(points=square(1.0), pivot=pivot, axis=axis)
    _, pixels = render(picture(panel))
    rows, columns = where(pixels, "black").T
    seen = where(pixels, PART_COLORS[0])
    line = rows[(columns > seen[:, 1].min()) & (rows > seen[:, 0].min())]
    assert np.ptp(line) <= 3
    assert abs(line.mean() - seen[:, 0].mean()) < 4


def test_the_png_is_the_picture() -> None:
    png, pixels = render(picture(Panel(points=square(1.0), beneath=square(1.5), title="a")))
    with Image.open(io.BytesIO(png)) as image:
        assert (np.asarray(image.convert("RGB")) == pixels).mean() > 0.99
    assert pixels.dtype == np.uint8
    again, _ = render(picture(Panel(points=square(1.0), beneath=square(1.5), title="a")))
    assert again == png


def test_the_oblique_view_is_a_rotation() -> None:
    np.testing.assert_allclose(OBLIQUE @ OBLIQUE.T, np.eye(3), atol=0.02)
    assert np.linalg.det(OBLIQUE) > 0
    assert OBLIQUE[1, 2] < 0  # up is up


def test_nothing_to_show_is_no_error() -> None:
    assert render(PictureData(panels=()))[0].startswith(b"\x89PNG")


def test_captions_are_not_parsed() -> None:
    panel = Panel(points=square(1.0), title=r"$\frac{$")
    png, _ = render(PictureData(panels=(panel,), caption="$\\frac{$ [/x] a_b", view="camera"))
    assert png.startswith(b"\x89PNG")
