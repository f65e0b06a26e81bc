# SPDX-License-Identifier: MIT
"""Every file format that the programs read: a good file, how it is damaged, how it is read."""

from __future__ import annotations

import base64
import json
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from PIL import Image

from bench.run_files import read_metrics, read_timing
from bench.scoring.score_files import read_scores
from scapo.registry import load_method
from scapo.store import Split, StoreError, sha256_file
from scapo.store.folders import made_here, whole_folder
from scapo.store.manifest import Manifest, read_manifest
from scapo.store.predictions import Predictions
from scapo.training import fit
from scapo.training.run_folder import TIMING
from sim_assets.formats.pickled import UnpickleError
from sim_assets.generation.assets import ProceduralAsset
from sim_assets.generation.benchmark import RECORD, read_record
from sim_assets.generation.ledger import FINISHED, PLAN, GenerateError, Ledger
from sim_assets.generation.plan import Entry, instance_record
from sim_assets.importers import hoi4d, op_align_light, op_align_real, shape2motion
from sim_assets.importers.models import find_folders
from sim_assets.models.limits import bounded
from sim_assets.models.reader import read
from sim_assets.models.validate import AssetError
from sim_assets.objects import ArticulatedObject
from tests.fuzz import damage
from tests.fuzz.damage import Damage
from tests.helpers import boxes, foreign, made
from tests.helpers.scored import make_scores
from tests.helpers.tiny import tiny, tiny_data
from tests.helpers.urdfs import BODY, cabinet


@dataclass(frozen=True, slots=True, kw_only=True)
class Format:
    """One format."""

    make: Callable[[Path], Path]
    """Writes good files to a folder, and says which is to be damaged."""
    read: Callable[[Path], object]
    """Reads that file, or what lies around it."""
    damage: tuple[Damage, ...]
    errors: tuple[type[Exception], ...]
    """The project's own, in which a refusal comes."""
    cases: int
    """Tried in the tests."""


def oven(file: Path) -> ArticulatedObject:
    folder = next(up for up in file.parents if (up / "cabinet.urdf").exists())
    return read(folder / "cabinet.urdf", "oven", root=folder)


def mesh(form: str, *ways: Damage, cases: int = 40) -> Format:
    def make(folder: Path) -> Path:
        cabinet(folder, ("body.obj", f"body.{form}"))
        path = folder / f"meshes/body.{form}"
        box: Any = trimesh.creation.box(BODY)
        data = box.export(file_type="glb" if form == "gltf" else form)
        if form == "gltf":  # in one file
            size = int.from_bytes(data[12:16], "little")
            tree, rest = json.loads(data[20 : 20 + size]), data[28 + size :]
            uri = "data:application/octet-stream;base64," + base64.b64encode(rest).decode()
            tree["buffers"] = [{"byteLength": len(rest), "uri": uri}]
            data = json.dumps(tree).encode()
        path.write_bytes(data if isinstance(data, bytes) else data.encode())
        return path

    return Format(make=make, read=oven, damage=ways, errors=(AssetError,), cases=cases)


def textured(name: str) -> Callable[[Path], Path]:
    def make(folder: Path) -> Path:
        cabinet(folder)
        path = folder / "meshes/body.obj"
        rows = path.read_text().splitlines()
        corners = [line.split()[1:] for line in rows if line.startswith("f ")]
        faces = ["f " + " ".join(f"{c.split('/')[0]}/1" for c in row) for row in corners]
        points = [line for line in rows if line.startswith("v ")]
        path.write_text("\n".join(["mtllib m.mtl", *points, "vt 0 0", "usemtl m", *faces]))
        (folder / "meshes/m.mtl").write_text("newmtl m\nKd 1 0 0\nmap_Kd p.png\n")
        Image.fromarray(np.arange(48, dtype=np.uint8).reshape(4, 4, 3)).save(
            folder / "meshes/p.png"
        )
        return folder / "meshes" / name

    return make


def partnet(name: str) -> Callable[[Path], Path]:
    def make(folder: Path) -> Path:
        cabinet(folder, ('name="cabinet"', 'name="partnet_1"'))
        (folder / "semantics.txt").write_text("door hinge door\nbody static body\n")
        (folder / "mobility_v2.json").write_text('[{"id": 0, "joint": "hinge", "parts": []}]')
        return folder / name

    return make


def set_file(write: Callable[..., Path], name: str) -> Callable[[Path], Path]:
    def make(folder: Path) -> Path:
        return next(write(boxes.laptop(), folder, "Laptop").glob(name))

    return make


def set_model(module: Any, marks: tuple[str, ...]) -> Callable[[Path], object]:
    def read_one(file: Path) -> object:
        folder = next(up for up in file.parents if any((up / mark).exists() for mark in marks))
        (found,) = find_folders(folder, marks)
        with bounded(folder):
            return module.read(found)

    return read_one


def view() -> foreign.View:
    return foreign.view_of(boxes.laptop(), [0.5], seed=0, count=256)


def real_file(folder: Path) -> Path:
    path = folder / "laptop_output/train/a/b/input_2/1.npz"
    path.parent.mkdir(parents=True, exist_ok=True)
    record = np.full((), foreign.real_record(view(), np.eye(3)), dtype=object)
    np.savez_compressed(path, record)
    return path


def light_file(folder: Path) -> Path:
    record = foreign.light_record(view(), np.eye(3), 0.42, (0, 1))
    return foreign.write_pt(record, folder / "pc/full/laptop_h/train/100.pt")


def cloud(module: Any) -> Callable[[Path], object]:
    def read_one(path: Path) -> object:
        top = next(up for up in path.parents if up.name in ("laptop_output", "pc")).parent
        (file,) = module.find(top)
        with bounded(path):
            return module.read(file, path.read_bytes())

    return read_one


def split_file(name: str) -> Callable[[Path], Path]:
    def make(folder: Path) -> Path:
        return made.make_data(folder, count=6, train=2, points=16).folder / name

    return make


def shard(file: Path) -> object:
    """Its values, where the manifest believes its bytes."""
    record = file.parent / "manifest.json"
    tree = json.loads(record.read_text())
    tree["shards"][0]["sha256"] = sha256_file(file)
    record.write_text(json.dumps(tree))
    return Split(file.parent).arrays("points", "part", "camera_T_part", "joint_axis")


def begun(name: str) -> Callable[[Path], Path]:
    """A split that was begun."""

    def make(folder: Path) -> Path:
        asset = ProceduralAsset(category="laptop", split="train", seed=1, index=0)
        entry = Entry(asset=asset, instance=instance_record(asset.load()), geometry="0" * 64)
        with Ledger(folder / "split", {"count": 1}, {"a": "1"}) as ledger:
            ledger.begin([entry], {"other": "expected x, found y"})
        (folder / "split" / FINISHED).write_text(f"{'0' * 64}  00000.safetensors\n")
        return folder / "split" / name

    return make


def ledger_of(file: Path) -> object:
    asset = ProceduralAsset(category="laptop", split="train", seed=1, index=0)
    with Ledger(file.parent, {"count": 1}, {"a": "1"}) as ledger:
        return ledger.finished(), ledger.entries([asset]) if ledger.plan else None


def predictions_file(folder: Path) -> Path:
    return made.write_truth(folder / "p.safetensors", made.make_data(folder / "d", points=16))


def predictions(path: Path) -> object:
    split = Split(path.parent / "d/laptop/test")
    with Predictions(path, split) as opened:
        rows = [opened.rows(first, 4) for first in range(0, split.manifest.count, 4)]
        opened.finish()
        return len(rows)


def run_file(name: str) -> Callable[[Path], Path]:
    def make(folder: Path) -> Path:
        for path in _run().items():
            (folder / path[0]).write_bytes(path[1])
        return folder / name

    return make


CONFIG = fit.FitConfig(log_every=2, checkpoint_every=0.0, pictures_every=None)


@cache
def _run() -> dict[str, bytes]:
    with tempfile.TemporaryDirectory() as place:
        fit.fit(tiny(), tiny_data(), Path(place), CONFIG)
        return {p.name: p.read_bytes() for p in Path(place).iterdir() if p.is_file()}


def resumed(file: Path) -> object:
    fit.fit(tiny(), tiny_data(), file.parent, CONFIG, resume=True)
    return None


def scores_file(suffix: str) -> Callable[[Path], Path]:
    def make(folder: Path) -> Path:
        make_scores(folder, "scapo", "laptop", samples=16)
        return next(folder.glob(f"*{suffix}"))

    return make


def scores(file: Path) -> object:
    return len(read_scores(next(file.parent.glob("*.csv.gz"))))


def marker(folder: Path) -> Path:
    with whole_folder(folder / "made") as place:
        (place / "a").write_text("a")
    return folder / "made/.made.json"


def record(folder: Path) -> Path:
    entry = {"samples": 1, "bytes": 1, "seconds": 1.0, "digest": "0", "shards_kept": 0}
    text = {"format": "scapo-benchmark/1", "benchmark": "sim-art/1", "splits": {"a": entry}}
    (folder / RECORD).write_text(json.dumps({**text, "total": {}}))
    return folder / RECORD


def manifest_of(file: Path) -> object:
    found: Manifest = read_manifest(file)
    assert json.loads(found.to_json())["format"]  # what is accepted can be written
    return found


Read = Callable[[Path], object]
Make = Callable[[Path], Path]


def asset(make: Make, *ways: Damage, read_one: Read = oven, cases: int = 60) -> Format:
    errors = (AssetError, UnpickleError)
    return Format(make=make, read=read_one, damage=ways, errors=errors, cases=cases)


def stored(
    make: Make,
    read_one: Read,
    *ways: Damage,
    errors: tuple[type[Exception], ...] = (StoreError,),
    cases: int = 100,
) -> Format:
    return Format(make=make, read=read_one, damage=ways, errors=errors, cases=cases)


def from_set(module: Any, name: str, *ways: Damage) -> Format:
    marks = S2M if module is shape2motion else HOI
    write = foreign.shape2motion if module is shape2motion else foreign.hoi4d
    return asset(set_file(write, name), *ways, read_one=set_model(module, marks))


TREE, WORDS, BYTES = damage.in_json, damage.in_words, damage.in_bytes
TENSORS, GZIP = damage.in_safetensors, damage.in_gzip
S2M = (shape2motion.MESH, shape2motion.LABELS, shape2motion.MOTION)
HOI = (hoi4d.TREE, hoi4d.MOTION)
BEGUN = (GenerateError,)

FORMATS: dict[str, Format] = {
    "URDF": asset(cabinet, WORDS, BYTES, cases=80),
    "OBJ": mesh("obj", WORDS, BYTES),
    "STL": mesh("stl", damage.in_head, BYTES),
    "PLY": mesh("ply", damage.in_head, BYTES),
    "DAE": mesh("dae", WORDS, BYTES),
    "GLB": mesh("glb", damage.in_glb),
    "glTF": mesh("gltf", TREE),
    "MTL": asset(textured("m.mtl"), WORDS, BYTES, cases=30),
    "PNG": asset(textured("p.png"), damage.in_png, cases=40),
    "semantics.txt": asset(partnet("semantics.txt"), WORDS, BYTES, cases=20),
    "mobility_v2.json": asset(partnet("mobility_v2.json"), TREE, cases=20),
    "shape2motion OBJ": from_set(shape2motion, S2M[0], WORDS, BYTES),
    "shape2motion NPY": from_set(shape2motion, S2M[1], BYTES, damage.in_head),
    "shape2motion JSON": from_set(shape2motion, S2M[2], TREE),
    "HOI4D tree": from_set(hoi4d, HOI[0], TREE),
    "HOI4D joints": from_set(hoi4d, HOI[1], TREE),
    "OP-Align NPZ": asset(real_file, damage.in_zip, read_one=cloud(op_align_real), cases=12),
    "OP-Align PT": asset(light_file, damage.in_zip, read_one=cloud(op_align_light)),
    "manifest": stored(split_file("manifest.json"), manifest_of, TREE, cases=200),
    "shard": stored(split_file("00000.safetensors"), shard, TENSORS),
    "plan": stored(begun(PLAN), ledger_of, TREE, errors=BEGUN),
    "finished": stored(begun(FINISHED), ledger_of, WORDS, BYTES, errors=BEGUN, cases=40),
    "predictions": stored(predictions_file, predictions, TENSORS),
    "checkpoint": stored(run_file("checkpoint.safetensors"), load_method, TENSORS, cases=60),
    "training state": stored(run_file("training.safetensors"), resumed, TENSORS, cases=30),
    "metrics": stored(run_file("metrics.jsonl"), read_metrics, damage.in_lines),
    "timing": stored(run_file(TIMING), lambda file: read_timing(file.parent), TREE),
    "scores CSV": stored(scores_file(".csv.gz"), scores, GZIP(WORDS), GZIP(BYTES), cases=60),
    "scores JSON": stored(scores_file(".json"), scores, TREE, cases=60),
    "made marker": stored(marker, lambda file: made_here(file.parent), TREE, cases=40),
    "benchmark record": stored(record, read_record, TREE, errors=(ValueError,)),
}
