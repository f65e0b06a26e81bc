# SPDX-License-Identifier: MIT
"""`scapo.load`: a trained model from its run folder, checkpoint file or category, ready to use."""

from __future__ import annotations

from pathlib import Path
from typing import get_args

import numpy as np
import torch
from torch import Tensor

from scapo.alignment import Alignment
from scapo.answer import answered
from scapo.method import AbstractMethod, Mode
from scapo.records import map_tensors
from scapo.registry import load_method
from scapo.released import find
from scapo.store.checkpoint import check_header
from scapo.types import Observation, Prediction

GRAIN = 1e-3
"""Share of an object's size to which its points are told at least."""


class Predictor:
    """A trained method, for clouds of one category.

    >>> from scapo.categories import CATEGORIES
    >>> from scapo.registered.config import RegisteredConfig
    >>> from scapo.registered.method import TemplateRegistration
    >>> config = RegisteredConfig(points=64, width=8)
    >>> # `load` gives a trained one.
    >>> method = TemplateRegistration(config, CATEGORIES["oven"], torch.Generator())
    >>> clouds = np.random.default_rng(0).normal(size=(3, 100, 3))
    >>> found = Predictor(method, "cpu").predict(clouds, "fast")
    >>> found.part_weight.shape, found.joints.axis.shape, found.camera_T_part.shape
    (torch.Size([3, 100, 2]), torch.Size([3, 1, 3]), torch.Size([3, 2, 4, 4]))
    """

    def __init__(
        self, model: AbstractMethod, device: str, alignment: Alignment | None = None
    ) -> None:
        """Hold the model in eval mode on the device.

        Args:
            model: Of one category.
            device: Where it runs.
            alignment: What brings its answers to the object's frame; None where it learned that
                frame itself, or nobody knows it.
        """
        self.model = model.to(device).eval()
        self.device, self.alignment = device, alignment
        self.model.up = None if alignment is None else alignment.up(model.axes())

    @property
    def in_object_frame(self) -> bool:
        """Whether poses, order of parts and states are the category's, not the method's own."""
        return self.alignment is not None or "pose" in self.model.supervision

    @property
    def knows_up(self) -> bool:
        """Whether it can be told which way is up."""
        return self.model.takes_up and self.model.up is not None

    def predict(
        self,
        points: np.ndarray | Tensor,
        mode: Mode | None = None,
        sensor: np.ndarray | Tensor | None = None,
        color: np.ndarray | Tensor | None = None,
        *,
        up: np.ndarray | Tensor | None = None,
        own_frame: bool = False,
    ) -> Prediction:
        """Parts, poses and joints of one cloud or of several.

        A part's pose maps the object's frame at rest (z up, the front towards -x) to the camera,
        where `in_object_frame`; else a frame that the method found for itself.

        Args:
            points: (..., N, 3), camera frame, metres, numpy or torch.
            mode: `fast`, networks only, `quick` or `refine`, or `whole` for clouds that show all
                of an object; by default the method's own choice, `quick` for template registration.
            sensor: (..., 3), centre of the camera, metres, for clouds in another frame than the
                camera's. What a `registered` model uses.
            color: (..., N, 3), in [0, 1], for methods that look at it.
            up: (..., 3), against gravity, any length, in the frame of the points, where the object
                stands as its category does. What a `registered` model uses.
            own_frame: Answer in the method's own frames, order of parts and states.

        Returns:
            Tensors on the CPU with the same leading dimensions; `np.asarray` takes them as they
            are.

        Raises:
            ValueError: Another shape, no cloud, fewer points than the method needs, values that
                are not finite, another mode, an up for a model that cannot use it.
        """
        mode = self.model.usual if mode is None else mode
        if mode not in get_args(Mode):
            raise ValueError(f"mode: expected one of {', '.join(get_args(Mode))}, found {mode!r}")
        cloud, least = self._tensor(points), self.model.least_points
        short = cloud.ndim < 2 or cloud.shape[-1] != 3 or cloud.shape[-2] < least
        if short or cloud.numel() == 0:
            raise ValueError(
                f"points: expected shape (..., N, 3) with N at least {least} and at least one "
                f"cloud, found {tuple(cloud.shape)}"
            )
        _check_coordinates(cloud)
        shape = cloud.shape[:-2]
        centre = None if sensor is None else self._tensor(sensor).expand(*shape, 3).reshape(-1, 3)
        tint = None if color is None else self._tensor(color)
        if tint is not None and tint.shape != cloud.shape:
            wanted, other = tuple(cloud.shape), tuple(tint.shape)
            raise ValueError(f"color: expected the shape of points, {wanted}, found {other}")
        observation = Observation(
            points=cloud.reshape(-1, *cloud.shape[-2:]),
            color=None if tint is None else tint.reshape(-1, *cloud.shape[-2:]),
            sensor=centre,
            up=None if up is None else self._unit(up).expand(*shape, 3).reshape(-1, 3),
        )
        found = answered(self.model, observation, mode, None if own_frame else self.alignment)
        return map_tensors(found, lambda one: one.reshape((*shape, *one.shape[1:])).cpu())

    def _unit(self, up: np.ndarray | Tensor) -> Tensor:
        way = self._tensor(up)
        length = way.norm(dim=-1, keepdim=True)
        if not bool((torch.isfinite(length) & (length > 0)).all()):
            raise ValueError("up: expected finite vectors of some length, found another")
        if not self.knows_up:
            raise ValueError(
                "up: expected a model of template registration that labels told which way is up, "
                f"found one of {self.model.name} that cannot use it"
            )
        return way / length

    def _tensor(self, values: np.ndarray | Tensor) -> Tensor:
        if not isinstance(values, Tensor):
            values = np.asarray(values)
            if values.dtype.kind not in "fiub":
                raise ValueError(f"expected real numbers, found an array of {values.dtype}")
            with np.errstate(over="ignore"):  # an infinity, which is refused where it may not be
                values = np.array(values, np.float32, order="C")  # any strides and byte order
        elif values.is_complex():
            raise ValueError(f"expected real numbers, found a tensor of {values.dtype}")
        made = torch.as_tensor(values, dtype=torch.float32, device=self.device)
        return made.detach().contiguous()  # another layout is rounded otherwise


def _check_coordinates(cloud: Tensor) -> None:
    """They are finite; far from the origin single precision would round them."""
    if lost := int((~torch.isfinite(cloud).all(-1)).sum()):
        raise ValueError(
            f"points: expected finite coordinates, found NaN or infinity in {lost:,} of "
            f"{cloud[..., 0].numel():,} points; leave those out"
        )
    extent = float((cloud.amax(-2) - cloud.amin(-2)).amax(-1).amin())
    far = float(cloud.abs().amax())
    grain = float(np.spacing(np.float32(far)))
    if 0 < extent < grain / GRAIN:
        raise ValueError(
            f"points: expected coordinates nearer to the origin, found {far:.4g} m, where single "
            f"precision tells {grain:.2g} m apart; take one offset from points and sensor"
        )


def load(path_or_category: str | Path, device: str = "cpu") -> Predictor:
    """A trained model, of the library's own methods or of another package's.

    >>> from safetensors.numpy import load_file  # here a cloud from a checkout of the project
    >>> points, *_ = load_file("results/checks/oven.safetensors")["points"]  # (1024, 3), metres
    >>> found = load("oven").predict(points)
    >>> found.joints.axis.shape, found.joints.state.shape, found.camera_T_part.shape
    (torch.Size([1, 3]), torch.Size([1]), torch.Size([2, 4, 4]))
    >>> door = found.part_weight.argmax(-1) == 1
    >>> 0.05 < float(door.float().mean()) < 0.5
    True

    Args:
        path_or_category: A run folder, a checkpoint file, or the name of a category whose
            weights come with the package, such as `oven`; `oven/scapo` for those of a method that
            is not the default.
        device: Where it runs.

    Raises:
        StoreError: There is no checkpoint of a method that is known here.
    """
    path = find(path_or_category)
    method, header = load_method(path)
    return Predictor(method, device, check_header(header, str(path)).alignment)
