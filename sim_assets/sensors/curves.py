# SPDX-License-Identifier: MIT
"""Measured errors of the noise models beside the published curves, as one picture.

Made by `python -m sim_assets.sensors.curves docs/sensor-noise.png`.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from io import BytesIO
from pathlib import Path
from statistics import NormalDist

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from scapo.geometry.camera import Intrinsics
from scapo.store import write_bytes
from sim_assets.sensors.disparity import depth_sigma, depth_step, disparity
from sim_assets.sensors.kinect import FOCAL, axial_sigma, kinect, lateral_sigma
from sim_assets.sensors.surface import rays

MODELS = {"kinect": kinect, "disparity": disparity}
COLORS = {"kinect": "tab:blue", "disparity": "tab:orange"}
SIZE = 120
"""Side of the picture of a plate, pixels."""
PLATES = 16
"""Pictures that an error is measured on."""
DEPTHS = np.linspace(0.5, 4.0, 15)
ANGLES = np.linspace(0, 80, 17)


def plate(z: float, angle: float) -> tuple[Float[np.ndarray, "H W"], Intrinsics]:
    """Depth of a plane that meets the optical axis at z, turned about the y axis by `angle` rad."""
    camera = Intrinsics(fx=FOCAL, fy=FOCAL, cx=SIZE / 2, cy=SIZE / 2, width=SIZE, height=SIZE)
    x, _ = rays((SIZE, SIZE), camera)
    row = z / (1 - np.tan(angle) * x)
    return np.repeat(row, SIZE, 0).astype(np.float32), camera


def depth_error(
    model: str, z: float, angle: float, rng: np.random.Generator
) -> tuple[float, float]:
    """Mean and standard deviation of the depth error in the middle of a plate, m.

    Over plates at slightly different z, as rounded disparities err by where z is between two steps.
    """
    errors = []
    middle = slice(SIZE // 2 - 4, SIZE // 2 + 4)  # where the angle is nearly that of the axis
    for place in np.linspace(-0.5, 0.5, PLATES, endpoint=False):
        depth, camera = plate(z + place * float(depth_step(np.array([z]))[0]), angle)
        noisy, _ = MODELS[model](depth, np.zeros(depth.shape, np.uint8), camera, rng)
        errors.append((noisy - depth)[:, middle])
    found = np.stack(errors).astype(np.float64)
    return float(found.mean()), float(found.std())


def outline_error(model: str, angle: float, rng: np.random.Generator) -> float:
    """Standard deviation of where the edge of a plate at 1 m is seen, pixels.

    A pixel next to the edge sees the other side where its shift s ~ N(0, sigma^2) exceeds 1/2.
    """
    depth, camera = plate(1.0, angle)
    part = np.zeros(depth.shape, np.uint8)
    part[:, SIZE // 2 :] = 255
    depth[:, SIZE // 2 :] = 3.0
    beside, wrong = slice(SIZE // 2 - 1, SIZE // 2 + 1), []
    for _ in range(PLATES):
        _, label = MODELS[model](depth, part, camera, rng)
        wrong.append((label != part)[:, beside].mean())
    return 0.5 / NormalDist().inv_cdf(1 - float(np.mean(wrong)))


def draw(path: Path, seed: int = 0) -> None:
    """Write the picture.

    Args:
        path: FILE.png.
        seed: Of the noise.
    """
    figure = Figure(figsize=(10, 3.2), layout="constrained")
    FigureCanvasAgg(figure)
    axes: Sequence[Axes] = figure.subplots(1, 3)
    rng = np.random.default_rng(seed)
    _draw_depths(axes[0], rng)
    _draw_angles(axes[1], rng)
    _draw_outlines(axes[2], rng)
    for ax in axes:
        ax.grid(alpha=0.3)
        ax.legend(fontsize=6.5)
    buffer = BytesIO()
    figure.savefig(buffer, format="png", dpi=100, metadata={"Software": None})
    write_bytes(path, buffer.getvalue())


def _draw_depths(ax: Axes, rng: np.random.Generator) -> None:
    for model, color in COLORS.items():
        found = [1000 * depth_error(model, z, np.radians(10.0), rng)[1] for z in DEPTHS]
        ax.plot(DEPTHS, found, "o", ms=3, color=color, label=f"{model}, measured at 10°")
    head_on = np.full(len(DEPTHS), np.radians(10.0))
    ax.plot(
        DEPTHS, 1000 * axial_sigma(DEPTHS, head_on), color="tab:blue", lw=1, label="Nguyen 2012"
    )
    ax.plot(
        DEPTHS, 1000 * depth_sigma(DEPTHS), color="tab:orange", lw=1, label="Barron 2013, no shift"
    )
    ax.plot(DEPTHS, 1.425 * DEPTHS**2, "k:", lw=1, label="Khoshelham 2012, measured")
    ax.set(xlabel="distance (m)", ylabel="deviation of depth (mm)", title="Plate by distance")


def _draw_angles(ax: Axes, rng: np.random.Generator) -> None:
    for model, color in COLORS.items():
        found = [1000 * depth_error(model, 1.0, np.radians(a), rng)[1] for a in ANGLES]
        ax.plot(ANGLES, found, "o", ms=3, color=color, label=f"{model}, measured at 1 m")
    one, fine = np.ones(81), np.radians(np.arange(81.0))
    ax.plot(1000 * axial_sigma(one, fine), color="tab:blue", lw=1, label="Nguyen 2012")
    shifted = np.hypot(depth_sigma(one), np.tan(fine) / 2 / FOCAL)
    ax.plot(1000 * shifted, color="tab:orange", lw=1, label="Barron 2013, with shift")
    ax.set(xlabel="angle (degrees)", ylabel="deviation of depth (mm)", title="Plate by angle")


def _draw_outlines(ax: Axes, rng: np.random.Generator) -> None:
    for model, color in COLORS.items():
        found = [outline_error(model, np.radians(a), rng) for a in ANGLES]
        ax.plot(ANGLES, found, "o", ms=3, color=color, label=f"{model}, measured")
    fine = np.radians(np.arange(81.0))
    ax.plot(lateral_sigma(fine), color="tab:blue", lw=1, label="Nguyen 2012")
    ax.axhline(0.5, color="tab:orange", lw=1, label="Barron 2013")
    ax.set(xlabel="angle (degrees)", ylabel="deviation (pixels)", title="Edge of a plate")
    ax.set_ylim(0, 1.6)


if __name__ == "__main__":
    draw(Path(sys.argv[1]))
