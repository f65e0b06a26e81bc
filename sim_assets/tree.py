# SPDX-License-Identifier: MIT
"""Which link is the root, the joints from it outwards, and links that hang loose."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from sim_assets.robot import Joint, Link, Robot
from sim_assets.validate import Repairs, check_tree, refuse


def build_robot(
    path: Path, name: str, links: dict[str, Link], joints: dict[str, Joint], repairs: Repairs
) -> Robot:
    """A robot from its links and joints in any order.

    Raises:
        AssetError: They make no single tree.
    """
    check_tree(path, links, joints.values())
    root = _root(path, links, joints, repairs)
    ordered = {joint.name: joint for joint in _outwards(root, joints)}
    reached = (root, *(joint.child for joint in ordered.values()))
    robot = Robot(
        path=path,
        name=name,
        links={link: links[link] for link in reached},
        joints=ordered,
        root=root,
    )
    _hold_loose(robot, repairs)
    return robot


def _root(path: Path, links: dict[str, Link], joints: dict[str, Joint], repairs: Repairs) -> str:
    hung = {joint.child for joint in joints.values()}
    parents = {joint.parent for joint in joints.values()}
    roots = [name for name in links if name not in hung]
    used = [name for name in roots if name in parents or links[name].shapes]
    if len(used) > 1:
        listed = ", ".join(repr(name) for name in used[:4])
        raise refuse(path, "one root link", f"{len(used)}: {listed}")
    kept = used or roots[:1]
    for name in roots:
        if name not in kept:
            repairs.add("An empty link that nothing hangs on was dropped", f"link {name!r}")
    return kept[0]


def _outwards(root: str, joints: dict[str, Joint]) -> Iterator[Joint]:
    """Breadth first, in file order within a link."""
    below: dict[str, list[Joint]] = {}
    for joint in joints.values():
        below.setdefault(joint.parent, []).append(joint)
    links = [root]
    for link in links:
        for joint in below.get(link, ()):
            yield joint
            links.append(joint.child)


def _hold_loose(robot: Robot, repairs: Repairs) -> None:
    """A free joint may hang the whole object in the world; it may not hold a piece of it."""
    solid = {name for name, link in robot.links.items() if link.shapes}
    for joint in robot.joints.values():
        if joint.kind not in ("floating", "planar"):
            continue
        below = robot.subtree(joint)
        if solid & below and solid - below:
            raise refuse(
                robot.path,
                "joints that are revolute, continuous, prismatic or fixed",
                f"the {joint.kind} joint {joint.name!r} between visible links",
            )
        repairs.add(f"A {joint.kind} joint was held at its origin", f"joint {joint.name!r}")
