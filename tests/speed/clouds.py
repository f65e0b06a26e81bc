# SPDX-License-Identifier: MIT
"""Clouds per second against a bare SAPIEN loop: `python tests/speed/clouds.py CATEGORY`.

The bare loop is the least that a user of SAPIEN writes: load the URDF, then for each picture set
the joints, move the camera, render with the `trivial` shader at 256 x 256, read depth and part
back. Ours makes objects, draws views, renders, samples, labels and checks. Both are timed in one
process, in turn, by processor time, since the machine may be busy with other work.
"""

from __future__ import annotations

import json
import sys
import time
import warnings
from pathlib import Path
from statistics import median
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from sim_assets.build import write_object
from sim_assets.options import DataOptions
from sim_assets.procedural import generate
from sim_assets.renderer import make_renderer
from sim_assets.request import make_request
from sim_assets.samples import Shooter
from sim_assets.views import Outline, View, draw_views, generator

OBJECTS, EACH, ROUNDS = 4, 50, 5


def bare_loop(urdf: Path, views: list[View]) -> float:
    """Seconds per picture."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        import sapien  # noqa: TID251 - the bare loop is what we are compared with

        from sim_assets.scene import CAMERA_T_ROBOT, COLOR_SHADER, find_device

        scene = sapien.Scene(
            [sapien.physx.PhysxCpuSystem(), sapien.render.RenderSystem(find_device())]
        )
        loader = scene.create_urdf_loader()
        loader.fix_root_link = True
        robot: Any = loader.load(str(urdf))
    eye, lens = sapien.Entity(), sapien.render.RenderCameraComponent(256, 256, str(COLOR_SHADER))
    eye.add_component(lens)
    scene.add_entity(eye)
    lens.set_fovy(np.radians(60))
    poses = []
    for view in views:
        pose = np.linalg.inv(view.camera_T_object)
        pose[:3, :3] = pose[:3, :3] @ CAMERA_T_ROBOT
        poses.append(sapien.Pose(pose))
    started, pictures = 0.0, OBJECTS * EACH
    for k in range(-5, pictures):  # the first pictures of a scene take longer
        if k == 0:
            started = time.process_time()
        robot.set_qpos(views[k % EACH].states[0])
        eye.set_pose(poses[k % EACH])
        scene.update_render()
        lens.take_picture()
        lens.get_picture("Position")[..., 2]
        lens.get_picture("Segmentation")[..., 1]
    return (time.process_time() - started) / pictures


def our_loop(category: str, seed: int) -> float:
    """Seconds per labelled cloud, objects made and opened included."""
    options = DataOptions(count=OBJECTS * EACH, instances=OBJECTS, seed=seed, backend="sapien")
    request, assets = make_request(category, options)
    with make_renderer("sapien") as renderer:
        started = time.process_time()
        for number, asset in enumerate(assets):
            shooter = Shooter(renderer, asset.load(), request.settings)
            keys = [request.key(view) for view in range(number * EACH, (number + 1) * EACH)]
            for _ in shooter.shots(keys):
                pass
        return (time.process_time() - started) / (OBJECTS * EACH)


def compare(category: str) -> dict[str, float]:
    """Rates of both, the median of some rounds."""
    bare, ours = [], []
    camera = make_request(category, DataOptions(count=1))[0].settings.camera
    with TemporaryDirectory() as folder:
        for round_ in range(-1, ROUNDS):
            thing = generate(category, "train", round_ + 1, 0)
            urdf = write_object(thing, Path(folder) / str(round_))
            rngs = [generator(i) for i in range(EACH)]
            times = (
                bare_loop(urdf, draw_views(Outline(thing), rngs, camera)),
                our_loop(category, round_ + 1),
            )
            if round_ >= 0:  # the first warms up
                bare.append(times[0])
                ours.append(times[1])
    ratio = median(b / o for b, o in zip(bare, ours, strict=True))
    return {"clouds": 1 / median(ours), "bare": 1 / median(bare), "ratio": ratio}


if __name__ == "__main__":
    sys.stdout.write(json.dumps(compare(sys.argv[1])) + "\n")
