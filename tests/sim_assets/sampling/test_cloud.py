# SPDX-License-Identifier: MIT
"""Points, poses, joints and visibility of clouds, against hand-computed values."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from scapo.geometry.camera import Intrinsics
from scapo.geometry.rigid import joint_motion
from sim_assets.options import Sampling
from sim_assets.rendering.base import BACKGROUND, Frame
from sim_assets.rendering.embree import RaycastRenderer
from sim_assets.sampling.cloud import (
    TOLERANCE,
    Cloud,
    SurfaceSamples,
    choose,
    choose_far,
    sample_frames,
    sample_surface,
    truth,
    visible_pixels,
)
from sim_assets.sampling.viewpoints import Outline, draw_views, generator
from tests.helpers.boxes import above, box, laptop

CAMERA = Intrinsics.from_fov(np.radians(60), 256, 256)


def picture(thing, state: float, pose: np.ndarray) -> Frame:
    with RaycastRenderer() as renderer:
        renderer.open(thing)
        return renderer.render(np.array([state]), pose, CAMERA)


def draw(frames: list[Frame], count: int, sampling: Sampling = "random") -> Cloud:
    return sample_frames(frames, visible_pixels(frames), CAMERA, count, generator("draw"), sampling)


def test_truth_follows_the_joint():
    thing = laptop()
    (view,) = draw_views(Outline(thing), [generator("truth")], CAMERA)
    known = truth(thing, view.states[0], view.camera_T_object)
    tensors = [torch.from_numpy(x) for x in (known.pivot, known.axis, known.state)]
    motion = joint_motion(tensors[0][0], tensors[1][0], tensors[2][0], "revolute").numpy()
    # In the camera frame: the child is the parent moved about the joint.
    np.testing.assert_allclose(known.camera_T_part[1], motion @ known.camera_T_part[0], atol=1e-12)
    np.testing.assert_allclose(known.camera_T_part[0], view.camera_T_object, atol=0)
    assert np.linalg.norm(known.axis) == pytest.approx(1)


def test_sampled_points_are_the_pixels_surface_points():
    thing = laptop(thickness=0.02)
    frame = picture(thing, 0.0, above(0.5))
    cloud = draw([frame], 500)
    np.testing.assert_allclose(cloud.points[:, 2], 0.48, atol=1e-7)
    assert (np.abs(cloud.points[:, 0]) <= 0.18).all()
    assert (np.abs(cloud.points[:, 1]) <= 0.125).all()
    assert len(np.unique(cloud.points, axis=0)) == 500  # without replacement
    assert (cloud.part == 1).all()
    assert cloud.points.dtype == np.float32
    assert cloud.color is None


def test_pictures_of_single_parts_are_merged():
    thing = laptop()
    with RaycastRenderer(color=True) as renderer:
        renderer.open(thing)
        frames = [renderer.render(np.array([0.0]), above(0.5), CAMERA, part) for part in (0, 1)]
    cloud = draw(frames, 2000)
    # Closed, each part is as large in the image as the other, though only one would be seen.
    assert abs((cloud.part == 0).mean() - 0.5) < 0.06
    np.testing.assert_allclose(cloud.points[cloud.part == 0, 2], 0.5, atol=1e-6)
    np.testing.assert_allclose(cloud.points[cloud.part == 1, 2], 0.48, atol=1e-6)
    assert cloud.color is not None
    assert (cloud.color == 179).all()
    pixels = visible_pixels(frames)
    assert [len(seen) for seen in pixels] == [(f.part != BACKGROUND).sum() for f in frames]


def test_fewer_pixels_than_points_are_drawn_with_replacement():
    assert sorted(choose(10, 10, generator("c"))) == list(range(10))
    chosen = choose(10, 25, generator("c"))
    assert len(chosen) == 25
    assert chosen.max() < 10


def test_farthest_points_are_spread():
    rng = generator("far")
    points = rng.uniform(size=(2000, 3))
    far, near = points[choose_far(points, 64, rng)], points[choose(2000, 64, rng)]

    def least(cloud: np.ndarray) -> float:
        distance = np.linalg.norm(cloud[:, None] - cloud, axis=-1)
        return distance[~np.eye(len(cloud), dtype=bool)].min()

    assert least(far) > 3 * least(near)
    assert len(choose_far(points[:20], 30, rng)) == 30
    cloud = draw([picture(laptop(), 1.0, above(0.6))], 64, "fps")
    assert least(cloud.points.astype(float)) > 0.01


def test_visible_share_of_boxes_seen_from_above():
    """Closed: the screen shows its top and no side; the base shows nothing."""
    width, depth, thickness = 0.36, 0.25, 0.02
    thing = laptop(width=width, depth=depth, thickness=thickness)
    pose = above(1.0)
    frame = picture(thing, 0.0, pose)
    surface = SurfaceSamples(thing)
    shares = surface.visible([frame], CAMERA, truth(thing, np.zeros(1), pose).camera_T_part)
    area = 2 * (width * depth + (width + depth) * thickness)
    top = surface.points[1, :, 2] > thickness - 1e-9
    assert shares[1] == pytest.approx(top.mean(), abs=0.01)
    assert shares[1] == pytest.approx(width * depth / area, abs=0.06)
    assert shares[0] < 0.01


def test_visible_tells_the_sides_of_a_thin_panel_apart():
    thing = laptop(thickness=0.002)
    pose = above(1.0)
    assert np.linalg.norm(thing.extents()) * TOLERANCE < 0.002
    frame = picture(thing, 0.0, pose)
    shares = SurfaceSamples(thing).visible(
        [frame], CAMERA, truth(thing, np.zeros(1), pose).camera_T_part
    )
    assert 0.4 < shares[1] < 0.55
    assert shares[0] == 0


def test_nothing_is_visible_outside_the_picture():
    thing = laptop()
    behind = np.eye(4)
    behind[2, 3] = -2.0
    empty = Frame(depth=np.zeros((256, 256), np.float32), part=np.full((256, 256), 255, np.uint8))
    for pose in (behind, above(0.5)):
        known = truth(thing, np.zeros(1), pose)
        assert (SurfaceSamples(thing).visible([empty], CAMERA, known.camera_T_part) == 0).all()


def test_surface_samples_are_uniform_by_area_and_on_the_surface():
    mesh = box((1.0, 2.0, 3.0), (0, 0, 0)).mesh
    points, face = sample_surface(mesh, 20_000, generator("area"))
    share = np.bincount(face, minlength=12) / 20_000
    np.testing.assert_allclose(share, mesh.area_faces / mesh.area, atol=0.012)
    on_side = np.isclose(np.abs(points), np.array([0.5, 1.0, 1.5]), atol=1e-12).any(-1)
    assert on_side.all()


def test_the_whole_surface_gives_each_part_its_share_and_at_least_some_points():
    thing = laptop()
    small = box((0.004, 0.004, 0.004), (0, 0, 0.05))
    tiny = type(thing)(
        category=thing.category,
        instance="tiny",
        visuals=(thing.visuals[0], (small,)),
        pivot=thing.pivot,
        axis=thing.axis,
        upper=thing.upper,
        origin=thing.origin,
    )
    pose = above(0.5)
    for sampling in ("random", "fps"):
        known = truth(tiny, np.zeros(1), pose)
        cloud = SurfaceSamples(tiny).sample(
            known.camera_T_part, 256, 16, generator("full"), sampling
        )
        assert cloud.points.shape == (256, 3)
        if sampling == "random":
            assert (cloud.part == 1).sum() >= 16
        back = (cloud.points - pose[:3, 3]) @ pose[:3, :3]
        on_small = np.abs(back[cloud.part == 1] - (0, 0, 0.05)).max(-1)
        np.testing.assert_allclose(on_small, 0.002, atol=1e-6)
