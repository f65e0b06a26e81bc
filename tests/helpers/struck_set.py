# SPDX-License-Identifier: MIT
"""A set of clouds whose files strike the process that reads them; imported by workers, so light."""

from __future__ import annotations

import os
import signal
from pathlib import Path

import numpy as np

from sim_assets.importers.clouds import CloudFile, RawCloud


class Struck:
    """A set whose files say how often reading them kills the process."""

    SET = "struck"

    @staticmethod
    def find(path: Path) -> list[CloudFile]:
        return [
            CloudFile(path=file, name=file.name, category="laptop", split="train", instance="one")
            for file in sorted(path.glob("*.txt"))
        ]

    @staticmethod
    def read(file: CloudFile, data: bytes) -> RawCloud:
        marks = file.path.with_suffix(".left")
        left = marks.read_text().split() if marks.exists() else []
        if left:
            marks.write_text(" ".join(left[1:]))
            os.kill(os.getpid(), signal.Signals[left[0]])
        poses = np.tile(np.eye(4), (2, 1, 1))
        rng = np.random.default_rng(list(data))
        return RawCloud(
            points=rng.normal(size=(20, 3)),
            part=np.zeros(20, np.uint8),
            color=None,
            camera_T_part=poses,
            pivot=np.zeros((1, 3)),
            axis=np.array([[0.0, 0.0, 1.0]]),
            state=np.zeros(1),
            visible=np.ones(2),
            camera=(1.0, 1.0, 1.0, 1.0, 2.0, 2.0),
        )
