# SPDX-License-Identifier: MIT
"""Finding the files that a URDF names, never outside its source folder."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath

from trimesh.resolvers import Resolver

from sim_assets.models.validate import MAX_MESH_BYTES, Repairs, read_file, refuse

MAX_MATERIALS = 10_000
_SCHEME = re.compile(r"^([A-Za-z][A-Za-z0-9+.-]+)://?(.*)$", re.DOTALL)
_DRIVE = re.compile(r"^[A-Za-z]:[/\\]")


@dataclass(slots=True, kw_only=True)
class SourceFiles:
    """The files of one asset: finds, reads and remembers them."""

    urdf: Path
    root: Path
    """No file outside of this folder is opened."""
    repairs: Repairs
    hashes: dict[str, str] = field(default_factory=dict)
    """Path relative to the root -> SHA-256, of all files read."""

    def locate(self, name: str) -> Path:
        """The file that a mesh's `filename` means.

        `package://` and `model://` are looked up in the folders above the URDF, `file://` and
        plain names beside it, then in the folders above.

        Raises:
            AssetError: Another scheme, a place outside the root, or no such file.
        """
        if "\\" in name:
            self.repairs.add("Backslashes in file names were read as slashes", name)
            name = name.replace("\\", "/")
        scheme, rest = self._scheme(name)
        if not rest.strip("/ ") or "\0" in rest:
            raise refuse(self.urdf, "the name of a mesh file", repr(name))
        for candidate in self._candidates(scheme, rest):
            found = self._existing(candidate)
            if found is not None:
                return self._inside(found, name)
        # Say "outside" rather than "missing" of a name that leaves the folder.
        self._inside(self.urdf.parent / rest, name)
        raise refuse(self.urdf, f"the mesh file {name!r}", "no such file in the source folder")

    def read(self, path: Path) -> bytes:
        """The bytes of a file below the root, entered in `hashes`.

        Raises:
            AssetError: Unreadable or too large.
        """
        data = read_file(path, MAX_MESH_BYTES)
        relative = path.resolve().relative_to(self.root.resolve()).as_posix()
        self.hashes[relative] = hashlib.sha256(data).hexdigest()
        return data

    def digest(self) -> str:
        """SHA-256 over the names and hashes of all files read, in order of name."""
        lines = (f"{name} {digest}\n" for name, digest in sorted(self.hashes.items()))
        return hashlib.sha256("".join(lines).encode()).hexdigest()

    def _scheme(self, name: str) -> tuple[str, str]:
        found = None if _DRIVE.match(name) else _SCHEME.match(name)
        if found is None:
            return "", name
        scheme = found[1].lower()
        if scheme not in ("package", "model", "file"):
            raise refuse(self.urdf, "a file name, package://, model:// or file://", repr(name))
        return scheme, found[2]

    def _candidates(self, scheme: str, rest: str) -> Iterator[Path]:
        above = self._above()
        if scheme in ("package", "model"):
            package, _, inner = rest.lstrip("/").partition("/")
            for folder in above:
                yield folder / package / inner
                if folder.name == package:
                    yield folder / inner
            rest = inner
        elif Path(rest).is_absolute():
            yield Path(rest)
            return
        for folder in above:
            yield folder / rest

    def _above(self) -> list[Path]:
        """The URDF's folder and those above it, up to the root."""
        root = self.root.resolve()
        folder = self.urdf.resolve().parent
        return [folder, *(up for up in folder.parents if up == root or root in up.parents)]

    def _existing(self, path: Path) -> Path | None:
        try:
            if path.is_file():
                return path
            if not path.parent.is_dir():
                return None
            wanted = path.name.lower()
            same = [other for other in path.parent.iterdir() if other.name.lower() == wanted]
        except (OSError, ValueError):
            return None
        if len(same) == 1 and same[0].is_file() and self.is_inside(same[0]):
            self.repairs.add("File names were matched whatever their case", path.name)
            return same[0]
        return None

    def is_inside(self, path: Path) -> bool:
        """Whether a path, links followed, lies below the root; not for links in a circle."""
        try:
            return self.root.resolve() in path.resolve().parents
        except (OSError, RuntimeError):
            return False

    def _inside(self, path: Path, name: str) -> Path:
        if not self.is_inside(path):
            raise refuse(self.urdf, f"mesh files inside the folder {self.root.name!r}", repr(name))
        return path


class MeshResolver(Resolver):
    """Gives a mesh loader its material, texture and buffer files, inside the root only."""

    def __init__(self, files: SourceFiles, mesh: Path) -> None:
        self.files = files
        self.mesh = mesh

    def get(self, key: str) -> bytes:
        """The bytes of a file named in a mesh; `FileNotFoundError` tells the loader to go on."""
        clean = PurePosixPath(str(key).strip().replace("\\", "/"))
        path = self.mesh.parent / clean
        if "\0" in str(clean) or not self.files.is_inside(path) or not path.is_file():
            if clean.suffix.lower() != ".mtl":
                self.files.repairs.add("A file that a mesh names is not there", str(key))
            raise FileNotFoundError(str(key))
        data = self.files.read(path)
        if data.count(b"newmtl") > MAX_MATERIALS:  # a loader opens the picture of each
            self.files.repairs.add(f"Materials were left out of a file of over {MAX_MATERIALS}")
            raise FileNotFoundError(str(key))
        return data

    def namespaced(self, namespace: str) -> MeshResolver:
        """The same for a folder below."""
        return MeshResolver(self.files, self.mesh.parent / namespace / self.mesh.name)

    def keys(self) -> list[str]:
        """Names beside the mesh."""
        return sorted(path.name for path in self.mesh.parent.iterdir() if path.is_file())

    def write(self, name: str, data: bytes) -> None:
        """Source folders are never written to."""
        raise PermissionError(f"{name}: mesh sources are read only ({len(data)} bytes)")
