# SPDX-License-Identifier: MIT
"""A data set in the browser (viser): the cloud by part, joint axes, and the object itself.

The object is made or read again where that is possible; its joints are opened by hand, beside the
cloud that shows how they were. Everything in the scene hangs below one node, the camera frame;
turning that node shows the scene as the object stands (z up) or as the camera sees it.

Names come from files of anybody: they reach the page as text, never as HTML or Markdown.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Sequence
from dataclasses import dataclass, field
from html import escape
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8
from scipy.spatial.transform import Rotation

from scapo.drawing import BACKGROUND, PART_COLORS
from scapo.store import Split
from scapo.store.files import tensor_names
from scapo.store.manifest import Manifest
from scapo.store.schema import UNLABELLED
from scapo.text import one_line
from sim_assets.describe.info import describe_state, find_splits
from sim_assets.generation.assets import RecoverError, recover
from sim_assets.inspect.answers import Answers, read_answers
from sim_assets.inspect.server import start_server
from sim_assets.objects import ArticulatedObject

PAINTS = ("part", "colour")
ANSWERED = "predicted part"
"""A third way to paint the points, of a split with predictions."""
FRAMES = ("object", "camera")
OPACITY = 0.4
SHOWN = (
    "points",
    "part",
    "camera_T_part",
    "joint_pivot",
    "joint_axis",
    "joint_state",
    "visible",
    "camera",
    "instance",
)
"""Tensors of a split."""
LONGEST_TEXT = 300
"""Characters of a line from a file."""
AXIS = (17, 17, 17)
PREDICTED = (214, 90, 0)
"""Of a predicted axis, beside the true one."""
FRUSTUM = (120, 120, 120)
CAMERA, OBJECT = "/camera", "/camera/object"
FROM_FRONT, FROM_CAMERA = np.array([-1.0, -0.75, 0.6]), np.array([0.0, 0.0, -1.0])
"""Where a browser looks from, in units of the cloud's size."""


class Viewer:
    """A server that shows the splits of a data set until it is closed.

    Every browser that connects sees the same sample.
    """

    def __init__(
        self,
        path: Path,
        source: Path | None = None,
        host: str = "localhost",
        port: int = 8080,
        predictions: Path | None = None,
    ) -> None:
        """Start serving.

        Args:
            path: A data set, or a category or split of one.
            source: Folder of the models, for a data set made from some.
            host: Address to listen at.
            port: Port to listen at; the next free one is taken if it is in use.
            predictions: A file of predictions of one of the splits, to show beside the truth.

        Raises:
            StoreError: There is no data set, or it is broken; predictions of none of its splits.
            ValueError: `port` is out of range, or `host` is no address of this machine.
            RuntimeError: viser is not installed.
        """
        if not 1 <= port <= 65535:
            raise ValueError(f"port: expected 1 to 65535, found {port}")
        splits = [Split(folder) for folder in find_splits(path)]
        self.splits = {_name(path, split): split for split in splits}
        self.answered = None if predictions is None else read_answers(predictions, self.splits)
        self.source = source
        self.lock = threading.RLock()
        self.thing: ArticulatedObject | None = None
        self.missing = ""
        self.server = start_server(host, port)
        self.server.gui.configure_theme(show_logo=False, show_share_button=False)
        self.server.gui.set_panel_label("scapo-data view")
        name = f"[{host}]" if ":" in host else host
        self.url = f"http://{name}:{self.server.get_port()}"
        self.scene = SampleScene(scene=self.server.scene)
        try:
            self._controls()
            self._open()
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """Stop serving."""
        self.server.stop()

    def _controls(self) -> None:
        """What is there for every split; `_open` adds the sample slider, `_load` the joints'."""
        gui = self.server.gui
        names = tuple(self.splits)
        first = names[0] if self.answered is None else self.answered[0]
        paints = PAINTS if self.answered is None else (*PAINTS, ANSWERED)
        self.split_box = gui.add_dropdown("Data", names, initial_value=first, order=0)
        self.sample_box: Any = None
        self.paint_box = gui.add_dropdown("Points by", paints, initial_value=PAINTS[0])
        self.frame_box = gui.add_dropdown("Frame", FRAMES, initial_value=FRAMES[0])
        self.cloud_box = gui.add_checkbox("Cloud", initial_value=True)
        self.axes_box = gui.add_checkbox("Joint axes", initial_value=True)
        self.answer_box = gui.add_checkbox(
            "Predicted axes", initial_value=True, visible=self.answered is not None
        )
        self.camera_box = gui.add_checkbox("Camera", initial_value=False)
        self.mesh_box = gui.add_checkbox("Object", initial_value=True)
        self.opacity_box = gui.add_slider("Opacity", 0.1, 1.0, 0.05, OPACITY)
        self.joints_folder = gui.add_folder("Joints of the object")
        self.joint_boxes: list[Any] = []
        self.legend = gui.add_html("")
        self.text = gui.add_html("")
        self.split_box.on_update(lambda _: self._open())
        self.paint_box.on_update(lambda _: self._draw())
        self.frame_box.on_update(lambda _: self._draw(turned=True))
        boxes = (self.cloud_box, self.axes_box, self.answer_box, self.camera_box, self.mesh_box)
        for box in boxes:
            box.on_update(lambda _: self._hide())
        self.opacity_box.on_update(lambda _: self._fade())

    def _open(self) -> None:
        """Open a split and show its first sample."""
        with self.lock:
            self.split = self.splits[self.split_box.value]
            manifest = self.split.manifest
            shards = manifest.shards
            names = tensor_names(self.split.folder / shards[0].file) if shards else set()
            colored = "color" in names
            self.samples = self.split.arrays(*SHOWN, *(["color"] if colored else []))
            self.paint_box.disabled = not colored and self._answers() is None
            if self.sample_box is not None:
                self.sample_box.remove()
            last = max(manifest.count - 1, 1)
            self.sample_box = self.server.gui.add_slider("Sample", 0, last, 1, 0, order=0.5)
            self.sample_box.on_update(lambda _: self.show(int(self.sample_box.value)))
            self.legend.content = _legend(manifest)
            self.instance = -1
            self.show(0)
            self._draw(turned=True)

    def _answers(self) -> Answers | None:
        """Predictions of the split that is shown."""
        shown = self.answered is not None and self.answered[0] == self.split_box.value
        return self.answered[1] if self.answered is not None and shown else None

    def show(self, number: int) -> None:
        """Show a sample of the split."""
        with self.lock:
            self.number = min(number, self.split.manifest.count - 1)
            self.row = {name: array[self.number] for name, array in self.samples.items()}
            if int(self.row["instance"]) != self.instance:
                self.instance = int(self.row["instance"])
                self._load()
            for box, joint, state in zip(
                self.joint_boxes, self.split.manifest.joints, self.row["joint_state"], strict=False
            ):
                if math.isfinite(state):
                    box.value = round(float(state) * _unit(joint.kind)[0], 2)
            self.text.content = self._describe()
            self._draw()

    def _load(self) -> None:
        """The object of the sample, if it can be had, and a slider for each of its joints."""
        manifest = self.split.manifest
        try:
            self.thing, self.missing = recover(manifest, self.instance, self.source), ""
        except RecoverError as error:
            self.thing, self.missing = None, str(error)
        for box in self.joint_boxes:
            box.remove()
        self.joint_boxes = []
        self.joints_folder.visible = self.thing is not None
        for j, joint in enumerate(manifest.joints if self.thing is not None else ()):
            factor, unit = _unit(joint.kind)
            top = round(float(self.thing.upper[j]) * factor, 2) if self.thing else 0.0
            with self.joints_folder:
                name = f"{one_line(manifest.parts[joint.child], LONGEST_TEXT)} ({unit})"
                box = self.server.gui.add_slider(name, 0.0, top, 0.01, 0.0)
            box.on_update(lambda _: self._pose())
            self.joint_boxes.append(box)
        self.scene.load(self.thing, self.opacity_box.value)

    def _draw(self, *, turned: bool = False) -> None:
        """The sample as the controls say; `turned`: look at it anew."""
        with self.lock:
            sample = self._displayed()
            upright = self.frame_box.value == FRAMES[0]
            self.scene.draw(sample, upright)
            if turned:
                look(self.server.initial_camera, sample, upright)
            self._hide()
            self._pose()

    def _displayed(self) -> DisplayedSample:
        row, part, said = self.row, self.row["part"], self._answers()
        if self.paint_box.value == ANSWERED and said is not None:
            part = said.part[self.number]
        digits = "".join(color[1:] for color in (*PART_COLORS, BACKGROUND))
        colors = np.frombuffer(bytes.fromhex(digits), np.uint8).reshape(-1, 3)
        paint = colors[np.where(part == UNLABELLED, len(PART_COLORS), part % len(PART_COLORS))]
        if self.paint_box.value == PAINTS[1] and "color" in row:
            paint = row["color"]
        return DisplayedSample(
            points=row["points"],
            colors=paint,
            camera_T_object=row["camera_T_part"][0].astype(float),
            pivot=row["joint_pivot"].astype(float),
            axis=row["joint_axis"].astype(float),
            camera=row["camera"].astype(float),
            predicted=None if said is None else (said.pivot[self.number], said.axis[self.number]),
        )

    def _pose(self) -> None:
        """Put the parts of the object where the joint sliders say."""
        with self.lock:
            if self.thing is not None:
                joints = zip(self.joint_boxes, self.split.manifest.joints, strict=True)
                state = [box.value / _unit(joint.kind)[0] for box, joint in joints]
                self.scene.pose(self.thing.pose(np.array(state)))

    def _hide(self) -> None:
        with self.lock:
            for box, handles in (
                (self.cloud_box, self.scene.cloud),
                (self.axes_box, self.scene.axes),
                (self.answer_box, self.scene.answers),
                (self.camera_box, self.scene.camera),
                (self.mesh_box, self.scene.parts),
            ):
                for handle in handles:
                    handle.visible = box.value

    def _fade(self) -> None:
        with self.lock:
            for handle in self.scene.meshes:
                handle.opacity = self.opacity_box.value

    def _describe(self) -> str:
        manifest, row = self.split.manifest, self.row
        seen = ", ".join(
            f"{name} {100 * share:.0f} %"
            for name, share in zip(manifest.parts, row["visible"], strict=True)
        )
        states = ", ".join(
            f"{manifest.parts[joint.child]} {describe_state(float(value), joint.kind)}"
            for joint, value in zip(manifest.joints, row["joint_state"], strict=True)
        )
        lines = [
            f"Sample {self.number} of {manifest.count}: {manifest.instances[self.instance].id}",
            f"State: {states}",
            f"Surface seen: {seen}",
            *([] if (said := self._answers()) is None else [f"Predicted by {said.title}: orange"]),
            *([f"No mesh: {self.missing}"] if self.missing else []),
        ]
        return _html(lines)


def _name(path: Path, split: Split) -> str:
    """Where a split is below `path`; what it holds where it is `path` itself."""
    name = split.folder.relative_to(path).as_posix()
    return f"{split.manifest.category}/{split.manifest.split}" if name == "." else name


def _unit(kind: str) -> tuple[float, str]:
    """Factor from rad or m, and the unit shown."""
    return (180 / math.pi, "deg") if kind == "revolute" else (100.0, "cm")


def _legend(manifest: Manifest) -> str:
    dots = [
        f'<span style="color:{PART_COLORS[p % len(PART_COLORS)]}">&#9679;</span> {_text(name)}'
        for p, name in enumerate(manifest.parts)
    ]
    return f'<div style="padding:0 1em;font-size:90%">{"&emsp;".join(dots)}</div>'


def _html(lines: Sequence[str]) -> str:
    paragraphs = "".join(f"<p>{_text(line)}</p>" for line in lines)
    return f'<div style="padding:0 1em;font-size:90%;overflow-wrap:anywhere">{paragraphs}</div>'


def _text(words: str) -> str:
    """Words from a file as they stand, in HTML."""
    return escape(one_line(words, LONGEST_TEXT))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class DisplayedSample:
    """One sample, camera frame."""

    points: Float[np.ndarray, "N 3"]
    colors: UInt8[np.ndarray, "N 3"]
    camera_T_object: Float[np.ndarray, "4 4"]
    pivot: Float[np.ndarray, "J 3"]
    axis: Float[np.ndarray, "J 3"]
    camera: Float[np.ndarray, " 6"]
    predicted: tuple[Float[np.ndarray, "J 3"], Float[np.ndarray, "J 3"]] | None = None
    """Pivots and unit axes that a method says."""

    @property
    def placed(self) -> bool:
        """Whether the object's pose is known."""
        return bool(np.isfinite(self.camera_T_object).all())

    @property
    def reach(self) -> float:
        """Longest side of the box around the middle 98 % of the points, m."""
        low, high = np.quantile(self.points, (0.01, 0.99), axis=0)
        return max(float((high - low).max()), 1e-3)


@dataclass(slots=True, kw_only=True, eq=False)
class SampleScene:
    """A sample and its object in a viser scene, by kind, so that they can be hidden and moved."""

    scene: Any
    """Of a viser server."""
    cloud: list[Any] = field(default_factory=list)
    axes: list[Any] = field(default_factory=list)
    answers: list[Any] = field(default_factory=list)
    """Predicted axes."""
    camera: list[Any] = field(default_factory=list)
    parts: list[Any] = field(default_factory=list)
    """A frame per part of the object, above its meshes."""
    meshes: list[Any] = field(default_factory=list)

    def draw(self, sample: DisplayedSample, upright: bool) -> None:
        """Put a sample in the place of the one before; `upright` in the object frame."""
        upright = upright and sample.placed
        self.scene.set_up_direction("+z" if upright else "-y")
        self._frame(CAMERA, np.linalg.inv(sample.camera_T_object) if upright else np.eye(4))
        if sample.placed:
            self._frame(OBJECT, sample.camera_T_object)
        reach = sample.reach
        points = self.scene.add_point_cloud(
            f"{CAMERA}/cloud",
            sample.points,
            sample.colors,
            point_size=0.008 * reach,
            point_shape="circle",
            precision="float32",
            point_shading="flat",
        )
        self.cloud = [points]
        for handle in (*self.axes, *self.answers):
            handle.remove()
        self.axes = self._arrows("axis", (sample.pivot, sample.axis), reach, AXIS)
        said = sample.predicted
        self.answers = [] if said is None else self._arrows("predicted", said, reach, PREDICTED)
        self.camera = [self._frustum(sample.camera, reach)] if sample.camera[1] > 0 else []

    def load(self, thing: ArticulatedObject | None, opacity: float) -> None:
        """Show this object from now on, or none."""
        self.scene.remove_by_name(OBJECT)
        self.parts, self.meshes = [], []
        if thing is None:
            return
        self._frame(OBJECT, np.eye(4))
        for p, visuals in enumerate(thing.visuals):
            self.parts.append(self.scene.add_frame(f"{OBJECT}/part{p}", show_axes=False))
            for k, visual in enumerate(visuals):
                mesh = self.scene.add_mesh_simple(
                    f"{OBJECT}/part{p}/mesh{k}",
                    np.asarray(visual.mesh.vertices, np.float32),
                    np.asarray(visual.mesh.faces, np.uint32),
                    color=tuple(round(255 * c) for c in visual.color[:3]),
                    opacity=opacity,
                    flat_shading=True,
                    side="double",
                )
                self.meshes.append(mesh)

    def pose(self, poses: Float[np.ndarray, "P 4 4"]) -> None:
        """Put the object's parts there, object frame."""
        for handle, pose in zip(self.parts, poses, strict=True):
            _place(handle, pose)

    def _frame(self, name: str, pose: Float[np.ndarray, "4 4"]) -> None:
        handle = self.scene.get_handle_by_name(name)
        if handle is None:
            handle = self.scene.add_frame(name, show_axes=False)
        _place(handle, pose)

    def _arrows(
        self,
        name: str,
        lines: tuple[Float[np.ndarray, "J 3"], Float[np.ndarray, "J 3"]],
        reach: float,
        color: tuple[int, int, int],
    ) -> list[Any]:
        """An arrow for each pivot and axis that are known."""
        return [
            self.scene.add_arrows(
                f"{CAMERA}/{name}{j}",
                np.stack([pivot - 0.4 * reach * axis, pivot + 0.6 * reach * axis])[None],
                color,
                shaft_radius=0.005 * reach,
                head_radius=0.016 * reach,
                head_length=0.05 * reach,
            )
            for j, (pivot, axis) in enumerate(zip(*lines, strict=True))
            if np.isfinite([pivot, axis]).all()
        ]

    def _frustum(self, camera: Float[np.ndarray, " 6"], reach: float) -> Any:  # noqa: ANN401
        _, fy, _, _, width, height = camera.tolist()
        return self.scene.add_camera_frustum(
            f"{CAMERA}/frustum",
            fov=2 * math.atan(height / (2 * fy)),
            aspect=width / height,
            scale=0.1 * reach,
            thickness=0.004 * reach,
            color=FRUSTUM,
        )


def look(camera: Any, sample: DisplayedSample, upright: bool) -> None:  # noqa: ANN401
    """Where browsers that connect look from: from the front, or from the camera's side."""
    centre = np.median(sample.points, axis=0).astype(float)
    upright = upright and sample.placed
    if upright:
        object_T_camera = np.linalg.inv(sample.camera_T_object)
        centre = object_T_camera[:3, :3] @ centre + object_T_camera[:3, 3]
    offset = FROM_FRONT if upright else FROM_CAMERA
    camera.up = (0.0, 0.0, 1.0) if upright else (0.0, -1.0, 0.0)
    camera.look_at = tuple(centre)
    camera.position = tuple(centre + 1.2 * sample.reach * offset)


def _place(handle: Any, pose: Float[np.ndarray, "4 4"]) -> None:  # noqa: ANN401
    x, y, z, w = Rotation.from_matrix(pose[:3, :3]).as_quat().tolist()
    handle.wxyz, handle.position = (w, x, y, z), tuple(pose[:3, 3])
