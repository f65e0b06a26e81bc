# SPDX-License-Identifier: MIT
"""A data set in the browser (viser): the cloud by part, joint axes, and the object itself.

The object is made or read again where that is possible; its joints are opened by hand, beside the
cloud that shows how they were.
"""

from __future__ import annotations

import math
import threading
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from scapo.data import TENSORS, SampleDataset
from scapo.draw import BACKGROUND, PART_COLORS
from scapo.manifest import Manifest
from scapo.store import Split
from sim_assets.articulated import ArticulatedObject
from sim_assets.info import describe_state, find_splits
from sim_assets.recover import RecoverError, recover
from sim_assets.view_scene import Shown, Stage, look

MISSING = "view: expected the package viser (pip install 'scapo[view]'), found none"
PAINTS = ("part", "colour")
FRAMES = ("object", "camera")
OPACITY = 0.4


class Viewer:
    """A server that shows the splits of a data set until it is closed.

    Every browser that connects sees the same sample.
    """

    def __init__(
        self, path: Path, source: Path | None = None, host: str = "localhost", port: int = 8080
    ) -> None:
        """Start serving.

        Args:
            path: A data set, or a category or split of one.
            source: Folder of the models, for a data set made from some.
            host: Address to listen at.
            port: Port to listen at; the next free one is taken if it is in use.

        Raises:
            StoreError: There is no data set, or it is broken.
            ValueError: `port` is out of range.
            RuntimeError: viser is not installed.
        """
        if not 1 <= port <= 65535:
            raise ValueError(f"port: expected 1 to 65535, found {port}")
        splits = [Split(folder) for folder in find_splits(path)]
        self.splits = {_name(path, split): split for split in splits}
        self.source = source
        self.lock = threading.RLock()
        self.thing: ArticulatedObject | None = None
        self.missing = ""
        self.server = _viser().ViserServer(host=host, port=port, label="scapo", verbose=False)
        self.server.gui.configure_theme(show_logo=False, show_share_button=False)
        self.server.gui.set_panel_label("scapo-data view")
        self.url = f"http://{host}:{self.server.get_port()}"
        self.stage = Stage(scene=self.server.scene)
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
        self.split_box = gui.add_dropdown("Data", names, initial_value=names[0], order=0)
        self.sample_box: Any = None
        self.paint_box = gui.add_dropdown("Points by", PAINTS, initial_value=PAINTS[0])
        self.frame_box = gui.add_dropdown("Frame", FRAMES, initial_value=FRAMES[0])
        self.cloud_box = gui.add_checkbox("Cloud", initial_value=True)
        self.axes_box = gui.add_checkbox("Joint axes", initial_value=True)
        self.camera_box = gui.add_checkbox("Camera", initial_value=False)
        self.mesh_box = gui.add_checkbox("Object", initial_value=True)
        self.opacity_box = gui.add_slider("Opacity", 0.1, 1.0, 0.05, OPACITY)
        self.joints_folder = gui.add_folder("Joints of the object")
        self.joint_boxes: list[Any] = []
        self.legend = gui.add_html("")
        self.text = gui.add_markdown("")
        self.split_box.on_update(lambda _: self._open())
        self.paint_box.on_update(lambda _: self._draw())
        self.frame_box.on_update(lambda _: self._draw(turned=True))
        for box in (self.cloud_box, self.axes_box, self.camera_box, self.mesh_box):
            box.on_update(lambda _: self._hide())
        self.opacity_box.on_update(lambda _: self._fade())

    def _open(self) -> None:
        """Open a split and show its first sample."""
        with self.lock:
            self.split = self.splits[self.split_box.value]
            manifest = self.split.manifest
            colored = bool(manifest.options.get("color"))
            self.samples = SampleDataset(self.split, (*TENSORS, "color") if colored else TENSORS)
            self.paint_box.disabled = not colored
            if self.sample_box is not None:
                self.sample_box.remove()
            last = max(manifest.count - 1, 1)
            self.sample_box = self.server.gui.add_slider("Sample", 0, last, 1, 0, order=0.5)
            self.sample_box.on_update(lambda _: self.show(int(self.sample_box.value)))
            self.legend.content = _legend(manifest)
            self.instance = -1
            self.show(0)
            self._draw(turned=True)

    def show(self, number: int) -> None:
        """Show a sample of the split."""
        with self.lock:
            self.number = min(number, self.split.manifest.count - 1)
            self.row = {name: t.numpy() for name, t in self.samples[self.number].items()}
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
                name = f"{manifest.parts[joint.child]} ({unit})"
                box = self.server.gui.add_slider(name, 0.0, top, 0.01, 0.0)
            box.on_update(lambda _: self._pose())
            self.joint_boxes.append(box)
        self.stage.load(self.thing, self.opacity_box.value)

    def _draw(self, *, turned: bool = False) -> None:
        """The sample as the controls say; `turned`: look at it anew."""
        with self.lock:
            shown = self._shown()
            upright = self.frame_box.value == FRAMES[0]
            self.stage.draw(shown, upright)
            if turned:
                look(self.server.initial_camera, shown, upright)
            self._hide()
            self._pose()

    def _shown(self) -> Shown:
        row, part = self.row, self.row["part"]
        digits = "".join(color[1:] for color in (*PART_COLORS, BACKGROUND))
        colors = np.frombuffer(bytes.fromhex(digits), np.uint8).reshape(-1, 3)
        paint = colors[np.where(part < 0, len(PART_COLORS), part % len(PART_COLORS))]
        if self.paint_box.value == PAINTS[1] and "color" in row:
            paint = row["color"]
        return Shown(
            points=row["points"],
            colors=paint,
            camera_T_object=row["camera_T_part"][0].astype(float),
            pivot=row["joint_pivot"].astype(float),
            axis=row["joint_axis"].astype(float),
            camera=row["camera"].astype(float),
        )

    def _pose(self) -> None:
        """Put the parts of the object where the joint sliders say."""
        with self.lock:
            if self.thing is not None:
                joints = zip(self.joint_boxes, self.split.manifest.joints, strict=True)
                state = [box.value / _unit(joint.kind)[0] for box, joint in joints]
                self.stage.pose(self.thing.pose(np.array(state)))

    def _hide(self) -> None:
        with self.lock:
            for box, handles in (
                (self.cloud_box, self.stage.cloud),
                (self.axes_box, self.stage.axes),
                (self.camera_box, self.stage.camera),
                (self.mesh_box, self.stage.parts),
            ):
                for handle in handles:
                    handle.visible = box.value

    def _fade(self) -> None:
        with self.lock:
            for handle in self.stage.meshes:
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
            f"Sample {self.number} of {manifest.count}: `{manifest.instances[self.instance].id}`",
            f"State: {states}",
            f"Surface seen: {seen}",
            *([f"No mesh: {self.missing}"] if self.missing else []),
        ]
        return "\n\n".join(lines)


def _viser() -> Any:  # noqa: ANN401 - of an extra that may be missing
    try:
        return import_module("viser")
    except ImportError as error:
        raise RuntimeError(MISSING) from error


def _name(path: Path, split: Split) -> str:
    """Where a split is below `path`; what it holds where it is `path` itself."""
    name = split.folder.relative_to(path).as_posix()
    return f"{split.manifest.category}/{split.manifest.split}" if name == "." else name


def _unit(kind: str) -> tuple[float, str]:
    """Factor from rad or m, and the unit shown."""
    return (180 / math.pi, "deg") if kind == "revolute" else (100.0, "cm")


def _legend(manifest: Manifest) -> str:
    dots = [
        f'<span style="color:{PART_COLORS[p % len(PART_COLORS)]}">&#9679;</span> {name}'
        for p, name in enumerate(manifest.parts)
    ]
    return f'<div style="padding:0 1em;font-size:90%">{"&emsp;".join(dots)}</div>'
