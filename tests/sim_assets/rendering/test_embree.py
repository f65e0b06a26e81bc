# SPDX-License-Identifier: MIT
"""Ray casting against depths known by hand, and its two ways against each other."""

from __future__ import annotations

import numpy as np
import pytest

from scapo.geometry.camera import Intrinsics
from sim_assets.models.textures import Paint
from sim_assets.objects import Visual
from sim_assets.procedural import generate
from sim_assets.rendering import embree as raycast
from sim_assets.rendering.backends import resolve_backend
from sim_assets.rendering.base import BACKGROUND, RenderError, pixel_rays
from sim_assets.rendering.embree import RaycastRenderer
from sim_assets.sampling.viewpoints import Outline, draw_views, generator
from tests.helpers.boxes import above, box, laptop

CAMERA = Intrinsics.from_fov(np.radians(60), 128, 128)
OPEN = np.array([np.radians(90)])


@pytest.fixture
def caster():
    with RaycastRenderer() as renderer:
        yield renderer


def test_depth_is_z_of_the_surface_at_the_pixels_centre(caster):
    caster.open(laptop(thickness=0.02))
    frame = caster.render(np.array([0.0]), above(0.5), CAMERA)
    assert set(np.unique(frame.part)) == {1, BACKGROUND}
    np.testing.assert_allclose(frame.depth[frame.part == 1], 0.48, atol=1e-7)
    assert (frame.depth[frame.part == BACKGROUND] == 0).all()
    # The nearest face spans 0.36 m along the object's y: image columns.
    half = 0.18 / 0.48 * CAMERA.fx
    columns = np.flatnonzero((frame.part == 1).any(0))
    assert columns.min() == np.ceil(64 - half - 0.5)
    assert columns.max() == np.floor(64 + half - 0.5)


def test_an_opened_screen_stands_where_the_joint_puts_it(caster):
    caster.open(laptop(depth=0.25, thickness=0.02))
    frame = caster.render(OPEN, above(0.5), CAMERA)
    # Turned by 90 degrees about the hinge at z = 0: the base's top is seen at 0.5, the screen's
    # edge at 0.5 - 0.25.
    np.testing.assert_allclose(frame.depth[frame.part == 0], 0.5, atol=1e-7)
    assert frame.depth[frame.part == 1].min() == pytest.approx(0.25, abs=1e-6)


def test_a_part_alone_is_drawn_as_if_the_other_were_not_there(caster):
    caster.open(laptop())
    assert set(np.unique(caster.render(OPEN, above(0.5), CAMERA, 0).part)) == {0, BACKGROUND}
    assert set(np.unique(caster.render(OPEN, above(0.5), CAMERA, 1).part)) == {1, BACKGROUND}


def test_large_and_small_objects_are_cast_alike(monkeypatch):
    thing = generate("oven", "train", 0, 0)
    views = draw_views(Outline(thing), [generator(i) for i in range(4)], CAMERA)
    frames = {}
    for limit in (0, 10**9):
        monkeypatch.setattr(raycast, "REBUILD_BELOW", limit)
        with RaycastRenderer(color=True) as renderer:
            renderer.open(thing)
            frames[limit] = [
                renderer.render(view.states[0], view.camera_T_object, CAMERA, only)
                for view in views
                for only in (None, 1)
            ]
    different = pixels = 0
    for a, b in zip(frames[0], frames[10**9], strict=True):
        same = a.part == b.part
        different += int((~same).sum())
        pixels += same.size
        assert np.percentile(np.abs(a.depth - b.depth)[same], 99.9) < 1e-6
        assert a.color is not None
        assert b.color is not None
        assert (a.color[same] != b.color[same]).any(-1).mean() < 2e-3
    assert different <= pixels / 5000


def test_the_ray_rectangle_leaves_nothing_out(caster, monkeypatch):
    thing = laptop()
    (view,) = draw_views(Outline(thing), [generator("r")], CAMERA)
    caster.open(thing)
    narrow = caster.render(view.states[0], view.camera_T_object, CAMERA)

    def everywhere(camera, points):
        del points
        rays = pixel_rays(camera)
        return np.arange(len(rays)), rays

    monkeypatch.setattr(raycast, "_rays", everywhere)
    wide = caster.render(view.states[0], view.camera_T_object, CAMERA)
    assert np.array_equal(narrow.part, wide.part)
    assert np.array_equal(narrow.depth, wide.depth)


def test_both_sides_of_a_sheet_are_seen(caster):
    thing = laptop()
    sheet = thing.visuals[1][0].mesh.copy()
    sheet.update_faces(sheet.face_normals[:, 2] < -0.5)  # its underside alone
    single = type(thing)(
        category=thing.category,
        instance="sheet",
        visuals=(thing.visuals[0], (Visual(mesh=sheet),)),
        pivot=thing.pivot,
        axis=thing.axis,
        upper=thing.upper,
        origin=thing.origin,
    )
    caster.open(single)
    frame = caster.render(np.array([0.0]), above(0.5), CAMERA, 1)
    np.testing.assert_allclose(frame.depth[frame.part == 1], 0.5, atol=1e-6)


def test_face_colours_follow_the_order_of_the_parts_mesh():
    red = Visual(mesh=box((1, 1, 1), (0, 0, 0)).mesh, color=(1.0, 0.0, 0.0, 1.0))
    grey = box((1, 1, 1), (2, 0, 0))
    colors = Paint((red, grey)).colors(np.arange(24), np.zeros((24, 3)))
    assert colors.shape == (24, 3)
    assert (colors[:12] == (255, 0, 0)).all()
    assert (colors[12:] == 179).all()  # 0.7


def test_rendering_nothing_and_unknown_backends_are_refused(caster):
    with pytest.raises(RenderError, match="expected an open object, found none"):
        caster.render(OPEN, above(1.0), CAMERA)
    with pytest.raises(
        RenderError, match=r"expected auto or one of sapien, raycast, .* found 'blender'"
    ):
        resolve_backend("blender")
    assert resolve_backend("raycast") == "raycast"
