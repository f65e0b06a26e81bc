# SPDX-License-Identifier: MIT
"""Clouds per second against a bare SAPIEN loop: `python tests/speed/clouds.py CATEGORY [WORKERS]`.

The bare loop is the least that a user of SAPIEN writes: load the URDF, then for each picture set
the joints, move the camera, render with the `trivial` shader at 256 x 256, read depth and part
back. Ours makes objects, draws views, renders, samples, labels and checks. Both are timed in one
process, in turn, by processor time, since the machine may be busy with other work.

With WORKERS, `generate --workers WORKERS` against as many bare loops side by side, both by the
clock: what a run costs to start is taken off by the difference of a long and a short run.
"""

from __future__ import annotations

import json
import multiprocessing
import subprocess
import sys
import time
import warnings
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from statistics import median
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from sim_assets.generation.build import write_object
from sim_assets.generation.request import make_request
from sim_assets.options import DataOptions
from sim_assets.procedural import generate
from sim_assets.rendering.backends import make_renderer
from sim_assets.sampling.samples import SampleMaker
from sim_assets.sampling.viewpoints import Outline, View, draw_views, generator

OBJECTS, EACH, ROUNDS = 4, 50, 5
SHORT, LONG = 1000, 5000


def bare_loop(
    urdf: Path,
    views: list[View],
    pictures: int = OBJECTS * EACH,
    clock: Callable[[], float] = time.process_time,
) -> float:
    """Seconds per picture."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        import sapien  # noqa: TID251 - the bare loop is what we are compared with

        from sim_assets.rendering.sapien import CAMERA_T_ROBOT, COLOR_SHADER, find_device

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
    started = 0.0
    for k in range(-5, pictures):  # the first pictures of a scene take longer
        if k == 0:
            started = clock()
        robot.set_qpos(views[k % EACH].states[0])
        eye.set_pose(poses[k % EACH])
        scene.update_render()
        lens.take_picture()
        lens.get_picture("Position")[..., 2]
        lens.get_picture("Segmentation")[..., 1]
    return (clock() - started) / pictures


def our_loop(category: str, seed: int) -> float:
    """Seconds per labelled cloud, objects made and opened included."""
    options = DataOptions(count=OBJECTS * EACH, instances=OBJECTS, seed=seed, backend="sapien")
    request, assets = make_request(category, options)
    with make_renderer("sapien") as renderer:
        started = time.process_time()
        for number, asset in enumerate(assets):
            maker = SampleMaker(renderer, asset.load(), request.settings)
            keys = [request.key(view) for view in range(number * EACH, (number + 1) * EACH)]
            for _ in maker.render_views(keys):
                pass
        return (time.process_time() - started) / (OBJECTS * EACH)


def fresh(category: str, seed: int, folder: Path) -> tuple[Path, list[View]]:
    """An object's URDF and views of it."""
    camera = make_request(category, DataOptions(count=1))[0].settings.camera
    thing = generate(category, "train", seed, 0)
    urdf = write_object(thing, folder / str(seed))
    return urdf, draw_views(Outline(thing), [generator(i) for i in range(EACH)], camera)


def compare(category: str) -> dict[str, float]:
    """Rates of both, the median of some rounds."""
    bare, ours = [], []
    with TemporaryDirectory() as folder:
        for round_ in range(-1, ROUNDS):
            urdf, views = fresh(category, round_ + 1, Path(folder))
            times = bare_loop(urdf, views), our_loop(category, round_ + 1)
            if round_ >= 0:  # the first warms up
                bare.append(times[0])
                ours.append(times[1])
    ratio = median(b / o for b, o in zip(bare, ours, strict=True))
    return {"clouds": 1 / median(ours), "bare": 1 / median(bare), "ratio": ratio}


def _bare_rate(category: str, seed: int) -> float:
    """Pictures per second by the clock."""
    with TemporaryDirectory() as folder:
        urdf, views = fresh(category, seed, Path(folder))
        return 1 / bare_loop(urdf, views, LONG // 2, time.perf_counter)


def command_seconds(category: str, count: int, workers: int) -> float:
    """Of `generate`."""
    with TemporaryDirectory() as folder:
        command = [sys.executable, "-W", "ignore", "-m", "sim_assets", "generate", category]
        command += ["--count", str(count), "--workers", str(workers), "--out", f"{folder}/out"]
        started = time.perf_counter()
        subprocess.run(command, check=True, capture_output=True)
        return time.perf_counter() - started


def compare_command(category: str, workers: int) -> dict[str, float]:
    """Rates of `generate` and of bare loops, each with a process for each worker.

    The better of two rounds each, in turn: other work on the machine only ever slows down.
    """
    bare, ours = [], []
    for _ in range(2):
        with ProcessPoolExecutor(workers, mp_context=multiprocessing.get_context("spawn")) as pool:
            bare.append(sum(pool.map(_bare_rate, [category] * workers, range(workers))))
        short, long = (command_seconds(category, count, workers) for count in (SHORT, LONG))
        ours.append((LONG - SHORT) / (long - short))
    return {"clouds": max(ours), "bare": max(bare), "ratio": max(ours) / max(bare)}


if __name__ == "__main__":
    name, *number = sys.argv[1:]
    rates = compare_command(name, int(number[0])) if number else compare(name)
    sys.stdout.write(json.dumps(rates) + "\n")
