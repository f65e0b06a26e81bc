# SPDX-License-Identifier: MIT
"""SAPIEN's pictures against ray casting, against known depths, and against SAPIEN's own loader."""

from __future__ import annotations

import warnings
from pathlib import Path

import numpy as np
import pytest
from jaxtyping import Float

from scapo.categories import CATEGORIES
from scapo.geometry.camera import Intrinsics
from sim_assets.generation.build import write_object
from sim_assets.models.reader import find, read
from sim_assets.objects import ArticulatedObject
from sim_assets.procedural import RECIPES, generate
from sim_assets.rendering.backends import make_renderer, resolve_backend
from sim_assets.rendering.base import BACKGROUND, AbstractRenderer, Frame, RenderError
from sim_assets.sampling.viewpoints import Outline, View, draw_views, generator
from tests.helpers.boxes import above, laptop

pytestmark = pytest.mark.render

CAMERA = Intrinsics.from_fov(np.radians(60), 256, 256)
REAL = {
    "oven": "oven",
    "eyeglasses": "eyeglasses",
    "laptop": "laptop",
    "storage": "drawer",
    "scissors": "scissors",
}


@pytest.fixture(scope="module", autouse=True)
def device() -> None:
    try:
        resolve_backend("sapien")
    except RenderError as error:
        pytest.skip(str(error))


@pytest.fixture(scope="module")
def sapien_renderer(device):
    with make_renderer("sapien") as renderer:
        yield renderer


@pytest.fixture(scope="module")
def caster():
    with make_renderer("raycast") as renderer:
        yield renderer


def views(thing: ArticulatedObject, count: int) -> list[View]:
    rngs = [generator(thing.instance, i) for i in range(count)]
    return draw_views(Outline(thing), rngs, CAMERA)


def compare(
    a: AbstractRenderer, b: AbstractRenderer, thing: ArticulatedObject, count: int
) -> tuple[Float[np.ndarray, " K"], int, int]:
    """Depth differences where both see the object, labels that differ, pixels."""
    a.open(thing)
    b.open(thing)
    depths, labels, pixels = [], 0, 0
    for k, view in enumerate(views(thing, count)):
        only = k % len(thing.visuals) if k % 4 == 3 else None
        frames = [r.render(view.states[0], view.camera_T_object, CAMERA, only) for r in (a, b)]
        both = (frames[0].part != BACKGROUND) & (frames[1].part != BACKGROUND)
        depths.append(np.abs(frames[0].depth - frames[1].depth)[both])
        labels += int((frames[0].part != frames[1].part).sum())
        pixels += frames[0].part.size
    return np.concatenate(depths), labels, pixels


def agree(depths: Float[np.ndarray, " K"], labels: int, pixels: int) -> None:
    assert len(depths) > 1000
    assert (depths <= 1e-5).mean() >= 0.99
    assert labels <= pixels / 10_000


@pytest.mark.parametrize("category", RECIPES)
def test_sapien_agrees_with_ray_casting(category, sapien_renderer, caster):
    results = [
        compare(sapien_renderer, caster, generate(category, "train", 3, i), 8) for i in range(3)
    ]
    agree(
        np.concatenate([r[0] for r in results]),
        sum(r[1] for r in results),
        sum(r[2] for r in results),
    )


@pytest.mark.parametrize("folder", REAL)
def test_sapien_agrees_with_ray_casting_on_real_models(folder, shared_dir, sapien_renderer, caster):
    results = []
    for urdf in find(shared_dir / "assets" / folder)[:3]:
        thing = read(urdf, REAL[folder], root=shared_dir / "assets" / folder)
        results.append(compare(sapien_renderer, caster, thing, 6))
    agree(
        np.concatenate([r[0] for r in results]),
        sum(r[1] for r in results),
        sum(r[2] for r in results),
    )


def test_depth_and_part_of_a_box_from_above(sapien_renderer):
    sapien_renderer.open(laptop(thickness=0.02))
    frame = sapien_renderer.render(np.array([0.0]), above(0.5), CAMERA)
    assert frame.part[128, 128] == 1
    np.testing.assert_allclose(frame.depth[frame.part == 1], 0.48, atol=2e-6)
    assert frame.depth[0, 0] == 0
    assert frame.part[0, 0] == BACKGROUND
    width = (frame.part == 1).any(0).sum()
    assert abs(width - 0.36 / 0.48 * CAMERA.fx) <= 1


def test_a_part_alone_and_all_again(sapien_renderer):
    sapien_renderer.open(laptop())
    pose, state = above(0.5), np.array([0.0])
    whole = sapien_renderer.render(state, pose, CAMERA)
    base = sapien_renderer.render(state, pose, CAMERA, 0)
    assert set(np.unique(base.part)) == {0, BACKGROUND}
    np.testing.assert_allclose(base.depth[base.part == 0], 0.5, atol=2e-6)
    again = sapien_renderer.render(state, pose, CAMERA)
    assert np.array_equal(again.depth, whole.depth)
    assert np.array_equal(again.part, whole.part)


def test_other_picture_sizes_and_off_centre_cameras(sapien_renderer, caster):
    thing = laptop()
    camera = Intrinsics(fx=100.0, fy=120.0, cx=40.0, cy=35.5, width=96, height=64)
    (view,) = views(thing, 1)
    frames = []
    for renderer in (sapien_renderer, caster):
        renderer.open(thing)
        renderer.render(view.states[0], view.camera_T_object, CAMERA)
        frames.append(renderer.render(view.states[0], view.camera_T_object, camera))
    assert frames[0].depth.shape == (64, 96)
    assert (frames[0].part != frames[1].part).sum() <= 1
    both = (frames[0].part != BACKGROUND) & (frames[1].part != BACKGROUND)
    assert both.sum() > 200
    assert np.abs(frames[0].depth - frames[1].depth)[both].max() < 2e-5


def test_colour_is_that_of_the_surface(sapien_renderer, caster):
    thing = generate("laptop", "train", 3, 0)
    (view,) = views(thing, 1)
    frames: list[Frame] = []
    for backend in ("sapien", "raycast"):
        with make_renderer(backend, color=True) as renderer:
            renderer.open(thing)
            frames.append(renderer.render(view.states[0], view.camera_T_object, CAMERA))
    ours, cast = (frame.color for frame in frames)
    assert ours is not None
    assert cast is not None
    difference = np.abs(ours.astype(int) - cast.astype(int)).max(-1)
    assert (difference > 1).mean() < 1e-3
    caster.open(thing)
    plain = caster.render(view.states[0], view.camera_T_object, CAMERA)
    assert (plain.part != frames[0].part).sum() <= 6


@pytest.mark.parametrize("category", ["laptop", "drawer"])
def test_sapiens_own_loader_sees_the_same_in_a_built_folder(category, tmp_path, caster):
    """What `build` writes, through URDFLoader and SAPIEN's own shader: poses, depth and parts."""
    thing = generate(category, "test", 4, 1)
    urdf = write_object(thing, tmp_path / "object")
    (view,) = views(thing, 1)
    depth, part, poses = through_the_loader(urdf, thing, view)
    np.testing.assert_allclose(poses, thing.pose(view.states[0])[:, :3, :3], atol=2e-6)
    caster.open(thing)
    frame = caster.render(view.states[0], view.camera_T_object, CAMERA)
    assert (frame.part != part).sum() <= 6
    both = (frame.part != BACKGROUND) & (part != BACKGROUND)
    assert np.percentile(np.abs(frame.depth - depth)[both], 99) <= 1e-5


def through_the_loader(
    urdf: Path, thing: ArticulatedObject, view: View
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Depth, part, and rotation of each link."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        import sapien  # noqa: TID251 - the loader itself is what is compared

        from sim_assets.rendering.sapien import CAMERA_T_ROBOT, COLOR_SHADER, find_device

        systems = [sapien.physx.PhysxCpuSystem(), sapien.render.RenderSystem(find_device())]
        scene = sapien.Scene(systems)
        loader = scene.create_urdf_loader()
        loader.fix_root_link = True
        robot = loader.load(str(urdf))
    names = [joint.name for joint in robot.get_active_joints()]
    robot.set_qpos([view.states[0][thing.origin.joint_names.index(name)] for name in names])
    links = [part.replace(" ", "_") for part in thing.category.parts]
    entities = [robot.find_link_by_name(name).entity for name in links]
    eye = np.linalg.inv(view.camera_T_object)
    eye[:3, :3] = eye[:3, :3] @ CAMERA_T_ROBOT
    holder = sapien.Entity()
    camera = sapien.render.RenderCameraComponent(256, 256, str(COLOR_SHADER))
    holder.add_component(camera)
    scene.add_entity(holder)
    camera.set_perspective_parameters(0.01, 10, CAMERA.fx, CAMERA.fy, CAMERA.cx, CAMERA.cy, 0)
    holder.set_pose(sapien.Pose(eye))
    scene.update_render()
    camera.take_picture()
    ids = camera.get_picture("Segmentation")[..., 1]
    part = np.full(ids.shape, BACKGROUND, np.uint8)
    for number, entity in enumerate(entities):
        part[ids == entity.per_scene_id] = number
    poses = [entity.pose.to_transformation_matrix()[:3, :3] for entity in entities]
    return -camera.get_picture("Position")[..., 2], part, np.stack(poses)


def test_rendering_nothing_is_refused():
    renderer = make_renderer("sapien")
    with pytest.raises(RenderError, match="expected an open object"):
        renderer.render(np.array([0.0]), above(1.0), CAMERA)


def test_every_category_is_either_procedural_or_real_here():
    assert set(RECIPES) <= set(CATEGORIES)
    assert set(REAL.values()) <= set(CATEGORIES)
