# SPDX-License-Identifier: MIT
"""Samples, predictions and checkpoints on disk; what is read is validated here.

Layout: `DIR/<category>/<split>/manifest.json` and shards beside it. One file is written and read
by `write` and `read`, a split through `open_split` and `dataset`.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from scapo.store.files import (
    CHECKPOINT,
    PREDICTIONS,
    SAMPLES,
    Arrays,
    Header,
    canonical_json,
    read,
    read_header,
    sha256_bytes,
    sha256_file,
    write,
    write_bytes,
)
from scapo.store.schema import StoreError, check_shape
from scapo.store.split import Split, find_split, open_split

if TYPE_CHECKING:
    from scapo.store.samples import SampleDataset

__all__ = [
    "CHECKPOINT",
    "PREDICTIONS",
    "SAMPLES",
    "Arrays",
    "Header",
    "Split",
    "StoreError",
    "canonical_json",
    "check_shape",
    "dataset",
    "find_split",
    "open_split",
    "read",
    "read_header",
    "sha256_bytes",
    "sha256_file",
    "write",
    "write_bytes",
]


def dataset(
    folder: Path | str,
    category: str | None = None,
    split: str | None = None,
    names: Sequence[str] | None = None,
) -> SampleDataset:
    """A `torch.utils.data.Dataset` over a folder; see `scapo.store.samples.SampleDataset`.

    Args:
        folder: A data set, a category's or a split's folder.
        category: Needed where the folder holds several.
        split: train, val, test or another that is there; by default that of a split's folder,
            of any other train.
        names: Tensors of an item; None for all of the layout but `color`.

    Raises:
        StoreError: No such split, or more than one fits; a broken manifest.
    """
    from scapo.store.samples import TENSORS  # data reads through this module
    from scapo.store.samples import dataset as build

    return build(folder, category, split, TENSORS if names is None else names)
