# SPDX-License-Identifier: MIT
"""`scapo.load`: a trained model from its run folder, checkpoint file or category, ready to use."""

from __future__ import annotations

from importlib.resources import files
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from scapo.categories import CATEGORIES, category
from scapo.method import Mode
from scapo.paper.method import Scapo, ScapoConfig
from scapo.registered.method import RegisteredConfig, RegisteredScapo
from scapo.store.checkpoint import config_from, load_arrays, read_checkpoint
from scapo.store.files import Arrays, Header
from scapo.store.schema import StoreError
from scapo.types import Joints, Observation, Prediction

RELEASED = "weights"
"""Folder in the package with one checkpoint per released category."""


class Predictor:
    """A trained SCAPO model, as published or `registered`, for clouds of one category."""

    def __init__(self, model: Scapo | RegisteredScapo, device: str) -> None:
        """Hold the model in eval mode on the device."""
        self.model = model.to(device).eval()
        self.device = device
        self.least = 16 if isinstance(model, RegisteredScapo) else model.config.encoder.neighbours

    def predict(
        self,
        points: np.ndarray | Tensor,
        mode: Mode = "fast",
        sensor: np.ndarray | Tensor | None = None,
    ) -> Prediction:
        """Parts, poses and joints of one cloud or of several.

        Args:
            points: (..., N, 3), camera frame, metres, numpy or torch.
            mode: `fast`, networks only, or `refine`.
            sensor: (..., 3), centre of the camera, metres, for clouds in another frame than the
                camera's. What `refine` of a `registered` model uses.

        Returns:
            Tensors on the CPU with the same leading dimensions; `np.asarray` takes them as they
            are.

        Raises:
            ValueError: Another shape, no cloud, fewer points than the encoder's neighbours,
                values that are not finite.
        """
        cloud = torch.as_tensor(points, dtype=torch.float32, device=self.device)
        short = cloud.ndim < 2 or cloud.shape[-1] != 3 or cloud.shape[-2] < self.least
        if short or cloud.numel() == 0:
            raise ValueError(
                f"points: expected shape (..., N, 3) with N at least {self.least} and at least one "
                f"cloud, found {tuple(cloud.shape)}"
            )
        shape = cloud.shape[:-2]
        flat = cloud.reshape(-1, *cloud.shape[-2:])
        centre = None
        if sensor is not None:
            centre = torch.as_tensor(sensor, dtype=torch.float32, device=self.device)
            centre = centre.expand(*shape, 3).reshape(-1, 3)
        observation = Observation(points=flat, sensor=centre)
        return _reshaped(self.model.predict(observation, mode), shape)


def load(path_or_category: str | Path, device: str = "cpu") -> Predictor:
    """A trained model.

    Args:
        path_or_category: A run folder, a checkpoint file, or the name of a category whose
            weights come with the package.
        device: Where it runs.

    Raises:
        StoreError: There is no checkpoint of SCAPO.
    """
    path = find(path_or_category)
    arrays, header = read_checkpoint(path)
    return Predictor(_model(header, arrays, path), device)


def _model(header: Header, arrays: Arrays, path: Path) -> Scapo | RegisteredScapo:
    """The method of a checkpoint with its weights."""
    kind = category(header["category"])
    where, none = f"{path}: config", torch.Generator()
    if header.get("method") == Scapo.name:
        model = Scapo(config_from(ScapoConfig, header["config"], where), kind, none)
    elif header.get("method") == RegisteredScapo.name:
        config = config_from(RegisteredConfig, header["config"], where)
        model = RegisteredScapo(config, kind, none)
    else:
        raise StoreError(
            f"{path}: expected method {Scapo.name!r} or {RegisteredScapo.name!r}, "
            f"found {header.get('method')!r}"
        )
    load_arrays(model, arrays, path)
    return model


def find(path_or_category: str | Path) -> Path:
    """The checkpoint's path.

    Raises:
        StoreError: Nothing of that name.
    """
    path = Path(path_or_category)
    if path.exists():
        return path
    released = Path(str(files("scapo"))) / RELEASED
    if str(path_or_category) in CATEGORIES:
        path = released / f"{path_or_category}.safetensors"
        if path.is_file():
            return path
    known = ", ".join(sorted(item.stem for item in released.glob("*.safetensors"))) or "none yet"
    raise StoreError(
        f"{path_or_category}: expected a run folder, a checkpoint or a category with released "
        f"weights ({known}), found none"
    )


def _reshaped(prediction: Prediction, shape: torch.Size) -> Prediction:
    def back(tensor: Tensor) -> Tensor:
        return tensor.reshape((*shape, *tensor.shape[1:])).cpu()

    def back_if(tensor: Tensor | None) -> Tensor | None:
        return None if tensor is None else back(tensor)

    joints = prediction.joints
    if joints is not None:
        joints = Joints(pivot=back(joints.pivot), axis=back(joints.axis), state=back(joints.state))
    return Prediction(
        part_weight=back(prediction.part_weight),
        camera_T_part=back_if(prediction.camera_T_part),
        joints=joints,
        canonical_points=back_if(prediction.canonical_points),
        confidence=back_if(prediction.confidence),
    )
