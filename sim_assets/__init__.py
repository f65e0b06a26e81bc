# SPDX-License-Identifier: MIT
"""Articulated assets and the labelled point clouds rendered from them (`scapo-data`)."""

from __future__ import annotations

TYPE_CHECKING = False  # as typing's own, whose import an interrupt would find outside of `main`
if TYPE_CHECKING:
    from collections.abc import Iterator
    from typing import Any

    from scapo.categories import Category
    from scapo.types import Sample

__all__ = ["generate_samples"]


def generate_samples(category: str | Category, **options: Any) -> Iterator[Sample]:  # noqa: ANN401
    """Yield the samples that `scapo-data generate` would write, without touching the disk.

    Args:
        category: One of `scapo.CATEGORIES` by its name, or a category of your own.
        options: The fields of `sim_assets.options.DataOptions`: count, instances, seed, split,
            points, protocol, backend, source, ...

    Yields:
        Samples in order, tensors without batch dimension, float32 on the CPU.

    Raises:
        ValueError: An option is out of range, or an object cannot be used.
        TypeError: No such option.
        RenderError: The backend does not work here.

    Example:
        >>> from sim_assets import generate_samples
        >>> sample = next(generate_samples("laptop", protocol="full", count=1))
        >>> sample.observation.points.shape
        torch.Size([1024, 3])
    """
    from sim_assets.generation.stream import (
        stream,  # here, so that `doctor` works without the extra `sim`
    )

    return stream(category, **options)
