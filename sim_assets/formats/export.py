# SPDX-License-Identifier: MIT
"""Data sets in formats that are read without this package: WebDataset, Parquet, npz.

OUT/SPLIT/ (as the splits lie below the data set) gets the manifest and the card as they are, and a
file for each shard:

- `webdataset`: `00000.tar`; of each sample `KEY.TENSOR.npy` for every tensor, and `KEY.json`.
- `parquet`: `00000.parquet`; a row for each sample, tensors as lists of fixed length, row by row.
  Their shapes are in the file's metadata, entry `scapo`, as JSON.
- `npz`: `00000.npz`; the tensors stacked as in the shard, with `key`, `index` and `instance_id`.

KEY is CATEGORY-SPLIT-INDEX; `index` counts in the split, `instance_id` names the object.
"""

from __future__ import annotations

import io
import json
import shutil
import tarfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any, Literal

import numpy as np

from scapo.store import Arrays, Split
from scapo.store.folders import refuse_inside, whole_folder
from scapo.store.manifest import Manifest

FORMAT = "scapo-export/1"
ExportFormat = Literal["webdataset", "parquet", "npz"]
KEPT = ("manifest.json", "card.md")
"""Files of a split that are copied."""
README = "README.md"


@dataclass(frozen=True, slots=True, kw_only=True)
class Keys:
    """What tells the samples of a shard apart."""

    key: list[str]
    index: list[int]
    instance_id: list[str]


@dataclass(frozen=True, slots=True, kw_only=True)
class Exported:
    """One split that was written."""

    name: str
    samples: int
    files: int


Writer = Callable[[Path, Arrays, Keys, Manifest], None]


def export(root: Path, splits: Sequence[Path], out: Path, form: ExportFormat) -> list[Exported]:
    """Write splits in another format; the folder appears whole, or not at all.

    Args:
        root: Of the data set, whose folders are kept below `out`.
        splits: Folders with a manifest, at `root` or below it.
        out: Folder to write; only one that this function wrote is replaced.
        form: Which format.

    Raises:
        StoreError: A split is damaged.
        ValueError: Something else is in the way, `out` lies in the data set or around it, or the
            format's library is not installed.
    """
    suffix, writer = _writers(form)
    refuse_inside(out, root)
    done = []
    with whole_folder(out) as folder:
        for path in splits:
            split = Split(path)
            split.verify()
            inside = path.relative_to(root)
            if not inside.parts:
                inside = Path(split.manifest.category, split.manifest.split)
            target = folder / inside
            target.mkdir(parents=True)
            for name in KEPT:
                if (path / name).is_file():
                    shutil.copyfile(path / name, target / name)
            shards = zip(split.manifest.shards, split.shards(), strict=True)
            for number, (shard, arrays) in enumerate(shards):
                keys = _keys(split.manifest, shard.first, arrays)
                writer(target / f"{number:05d}{suffix}", arrays, keys, split.manifest)
            manifest = split.manifest
            done.append(
                Exported(name=inside.as_posix(), samples=manifest.count, files=len(manifest.shards))
            )
        (folder / README).write_text(_READ[form], encoding="utf-8")
    return done


def _writers(form: ExportFormat) -> tuple[str, Writer]:
    if form == "webdataset":
        return ".tar", _write_tar
    if form == "npz":
        return ".npz", _write_npz
    try:
        import_module("pyarrow.parquet")  # an extra, which only this format needs
    except ImportError as error:
        raise ValueError(
            "format parquet: expected pyarrow, found none (pip install 'scapo[export]')"
        ) from error
    return ".parquet", _write_parquet


def _keys(manifest: Manifest, first: int, arrays: Arrays) -> Keys:
    index = [first + k for k in range(len(arrays["instance"]))]
    stem = f"{manifest.category}-{manifest.split}".replace(".", "_")
    return Keys(
        key=[f"{stem}-{i:07d}" for i in index],
        index=index,
        instance_id=[manifest.instances[int(i)].id for i in arrays["instance"]],
    )


def _write_npz(path: Path, arrays: Arrays, keys: Keys, manifest: Manifest) -> None:
    del manifest
    told = {
        "key": np.array(keys.key),
        "index": np.array(keys.index, np.int64),
        "instance_id": np.array(keys.instance_id),
    }
    np.savez(path, allow_pickle=False, **{**arrays, **told})


def _write_tar(path: Path, arrays: Arrays, keys: Keys, manifest: Manifest) -> None:
    with tarfile.open(path, "w", format=tarfile.USTAR_FORMAT) as file:
        for k, key in enumerate(keys.key):
            for name in sorted(arrays):
                buffer = io.BytesIO()
                np.save(buffer, arrays[name][k], allow_pickle=False)
                _add(file, f"{key}.{name}.npy", buffer.getvalue())
            told = {
                "category": manifest.category,
                "split": manifest.split,
                "index": keys.index[k],
                "instance_id": keys.instance_id[k],
            }
            _add(file, f"{key}.json", json.dumps(told, sort_keys=True).encode())


def _add(file: tarfile.TarFile, name: str, data: bytes) -> None:
    """A member without date or owner, so that equal data give equal bytes."""
    member = tarfile.TarInfo(name)
    member.size, member.mode = len(data), 0o644
    file.addfile(member, io.BytesIO(data))


def _write_parquet(path: Path, arrays: Arrays, keys: Keys, manifest: Manifest) -> None:
    library = import_module("pyarrow")
    columns: dict[str, Any] = {
        "key": library.array(keys.key),
        "index": library.array(keys.index, library.int64()),
        "instance_id": library.array(keys.instance_id),
    }
    for name in sorted(arrays):
        array = arrays[name]
        flat = library.array(np.ascontiguousarray(array).reshape(-1))
        length = int(np.prod(array.shape[1:]))
        nested = array.ndim > 1
        columns[name] = library.FixedSizeListArray.from_arrays(flat, length) if nested else flat
    told = {
        "format": FORMAT,
        "category": manifest.category,
        "split": manifest.split,
        "shapes": {name: list(array.shape[1:]) for name, array in sorted(arrays.items())},
    }
    table = library.table(columns).replace_schema_metadata({"scapo": json.dumps(told)})
    import_module("pyarrow.parquet").write_table(table, path, compression="zstd")


_READ: dict[str, str] = {
    "webdataset": """# How to read it

```python
import io, json, tarfile
import numpy as np

with tarfile.open("laptop/train/00000.tar") as file:
    members = {member.name: file.extractfile(member).read() for member in file}
key = next(name for name in members if name.endswith(".json")).removesuffix(".json")
points = np.load(io.BytesIO(members[f"{key}.points.npy"]))  # (N, 3), camera frame, metres
told = json.loads(members[f"{key}.json"])  # category, split, index, instance_id
```

The `webdataset` package reads the same files. Tensors, frames, units: `manifest.json`, `card.md`.
""",
    "parquet": """# How to read it

```python
import json
import numpy as np
import pandas as pd
import pyarrow.parquet

file = "laptop/train/00000.parquet"
rows = pd.read_parquet(file)  # a row for each sample
shapes = json.loads(pyarrow.parquet.read_schema(file).metadata[b"scapo"])["shapes"]
points = np.stack(rows["points"]).reshape(-1, *shapes["points"])  # (S, N, 3), camera frame, metres
```

Tensors, frames and units: `manifest.json`, `card.md`.
""",
    "npz": """# How to read it

```python
import numpy as np

shard = np.load("laptop/train/00000.npz")
points = shard["points"]  # (S, N, 3), camera frame, metres
shard["key"], shard["index"], shard["instance_id"]
```

Tensors, frames and units: `manifest.json`, `card.md`.
""",
}
