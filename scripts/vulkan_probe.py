# SPDX-License-Identifier: MIT
"""Render one cube with SAPIEN, check its depth and print the device's name; fails where none works.

Run in a process of its own, since a broken driver can end it. The picture itself is checked because
a device that is found need not be one that draws.
"""

from __future__ import annotations

import sys

import sapien

HALF_SIZE, DISTANCE = 0.5, 2.0  # m: cube in front of the camera, whose nearest face is at 1.5 m


def first_device() -> sapien.Device:
    """The first of CUDA and the PCI devices that can draw."""
    for name in ("cuda", "pci:0", "pci:1", "cpu"):
        try:
            device = sapien.Device(name)
        except RuntimeError:
            continue
        if device.can_render() or name == "cpu":  # 'cpu' says False although a scene on it may draw
            return device
    sys.exit("no device")


def main() -> None:
    """Draw the cube and compare the depth at the picture's centre."""
    sapien.render.set_camera_shader_dir("trivial")
    device = first_device()
    scene = sapien.Scene([sapien.physx.PhysxCpuSystem(), sapien.render.RenderSystem(device)])
    builder = scene.create_actor_builder()
    builder.add_box_visual(half_size=(HALF_SIZE, HALF_SIZE, HALF_SIZE))
    builder.build_kinematic(name="cube").set_pose(sapien.Pose([DISTANCE, 0, 0]))
    camera = scene.add_camera("camera", width=16, height=16, fovy=1.0, near=0.1, far=10.0)
    scene.update_render()
    camera.take_picture()
    depth = -float(camera.get_picture("Position")[8, 8, 2])
    if abs(depth - (DISTANCE - HALF_SIZE)) > 1e-3:
        sys.exit(f"depth {depth} m, expected {DISTANCE - HALF_SIZE} m")
    print(device.name or device)


if __name__ == "__main__":
    main()
