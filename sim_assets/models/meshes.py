# SPDX-License-Identifier: MIT
"""The visual shapes of a link as surfaces in the link's coordinates, checked and two-sided.

URDF primitives as fine closed meshes: SAPIEN's own are off by millimetres.
"""

from __future__ import annotations

import io
import math
import re
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import trimesh
from jaxtyping import Float, Int
from trimesh.visual import ColorVisuals, TextureVisuals

from scapo.export.urdf import BOTH_SIDES
from scapo.geometry.matrices import moved
from sim_assets.models.resolver import MeshResolver, SourceFiles
from sim_assets.models.robot import Color, Robot, Shape, ShapeKind
from sim_assets.models.sides import two_sided, used_vertices
from sim_assets.models.textures import find_image, is_readable, only_pictures
from sim_assets.models.validate import MAX_COORDINATE, MAX_FACES, AssetError, check_mesh, refuse
from sim_assets.objects import Visual

SAGITTA = 5e-5
"""Largest distance of the mesh from the true surface, relative to the radius."""
FORMATS = ("obj", "stl", "ply", "glb", "gltf", "dae")
MIN_SIZE = 1e-9
"""Asset units."""
GREY: Color = (0.7, 0.7, 0.7, 1.0)


def load_links(robot: Robot, files: SourceFiles) -> dict[str, tuple[Visual, ...]]:
    """The surfaces of every link that has any, vertices in the link's coordinates (asset units).

    Raises:
        AssetError: A mesh is missing, broken, empty, outside the source folder, or all together
            are too large.
    """
    cache: dict[object, list[Visual]] = {}
    result: dict[str, tuple[Visual, ...]] = {}
    faces = 0
    for link in robot.links.values():
        visuals: list[Visual] = []
        for shape in link.shapes:
            pieces = _load_shape(shape, files, cache)
            faces += sum(len(piece.mesh.faces) for piece in pieces)
            if faces > MAX_FACES:  # before the many are placed that share what was loaded
                raise refuse(robot.path, f"at most {MAX_FACES} triangles", "more")
            visuals += [_placed(piece, shape, files, f"link {link.name!r}") for piece in pieces]
        if visuals:
            result[link.name] = tuple(visuals)
    if not result:
        raise refuse(robot.path, "triangles in some link", "none")
    return result


def _load_shape(
    shape: Shape, files: SourceFiles, cache: dict[object, list[Visual]]
) -> list[Visual]:
    key = files.locate(shape.filename) if shape.kind == "mesh" else (shape.kind, shape.size)
    if key not in cache:
        if isinstance(key, Path):
            cache[key] = load_mesh(key, files)
        else:
            cache[key] = [Visual(mesh=solid(shape.kind, shape.size), color=GREY)]
    return cache[key]


def load_mesh(path: Path, files: SourceFiles) -> list[Visual]:
    """The pieces of a mesh file, one per material, in the file's coordinates (metres for dae).

    Raises:
        AssetError: Unknown format, unreadable, empty or broken.
    """
    form = path.suffix.lower().lstrip(".")
    if form not in FORMATS:
        raise refuse(path, f"a mesh out of {', '.join(FORMATS)}", repr(path.suffix))
    data = files.read(path)
    if not data.strip():
        raise refuse(path, "a mesh", "an empty file")
    if _claimed_faces(form, data) > MAX_FACES:
        raise refuse(path, f"at most {MAX_FACES} triangles", "more")
    pieces, units = _parse(path, form, data, MeshResolver(files, path))
    if not pieces:
        raise refuse(path, "a mesh with triangles", "none")
    for piece in pieces:
        check_mesh(path, piece.mesh)
    add = not (form == "obj" and data.startswith(BOTH_SIDES.encode()))
    return _both_sides([_without_strays(piece) for piece in pieces], _unit(path, units), add)


def _claimed_faces(form: str, data: bytes) -> int:
    """How many faces a file says that it has; 0 where that takes parsing."""
    if form == "obj":
        return data.count(b"\nf ")
    if form == "stl":
        claimed = int.from_bytes(data[80:84], "little")
        return claimed if len(data) == 84 + 50 * claimed else data.count(b"endfacet")
    found = re.search(rb"^element face (\d{1,18})\s", data[:65536], re.MULTILINE)
    return int(found[1]) if form == "ply" and found else 0


def _parse(path: Path, form: str, data: bytes, resolver: MeshResolver) -> tuple[list[Visual], str]:
    """Pieces in the scene's frame, and its units; whatever a loader raises is a refusal."""
    where, repairs = resolver.mesh.name, resolver.files.repairs
    try:
        with _silent(), only_pictures(lambda why: repairs.add(why, where)):
            scene = trimesh.load_scene(
                io.BytesIO(data), file_type=form, resolver=resolver, process=False
            )
            _check_textures(scene, resolver)
            meshes = [mesh for mesh in scene.dump() if isinstance(mesh, trimesh.Trimesh)]
            return [_piece(mesh) for mesh in meshes if len(mesh.faces)], str(scene.units)
    except (AssetError, MemoryError):
        raise
    except ImportError as error:
        package = {"dae": "pycollada"}.get(form, str(error.name))
        raise refuse(path, f"the package {package} to read it", "it is not installed") from error
    except RecursionError as error:
        raise refuse(path, f"a valid {form} file", "nodes nested too deeply") from error
    except Exception as error:
        raise refuse(path, f"a valid {form} file", f"{type(error).__name__}: {error}") from error


@contextmanager
def _silent() -> Iterator[None]:
    """Without what the loaders print of what they leave out: it is said in our words."""
    logger = trimesh.util.log
    before, logger.disabled = logger.disabled, True
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        logger.disabled = before


def _check_textures(scene: trimesh.Scene, resolver: MeshResolver) -> None:
    """Leave out those that are no pictures; the surface then has its material's colour."""
    for mesh in scene.geometry.values():
        material = getattr(mesh.visual, "material", None)
        image = find_image(material)
        if image is not None and not is_readable(image):
            setattr(material, "image" if hasattr(material, "image") else "baseColorTexture", None)
            name = resolver.mesh.name
            resolver.files.repairs.add("A texture that cannot be read was left out", name)


def _piece(mesh: trimesh.Trimesh) -> Visual:
    """A mesh with its main colour; a texture with coordinates stays on it."""
    vertices, faces = np.asarray(mesh.vertices, float), np.asarray(mesh.faces, np.int64)
    if vertices.shape != (len(vertices), 3) or faces.shape != (len(faces), 3):
        raise ValueError(f"vertices and faces of three numbers, not {vertices.shape[1:]}")
    plain = trimesh.Trimesh(vertices, faces, process=False, validate=False)
    visual = mesh.visual
    if not isinstance(visual, TextureVisuals):
        color = visual.main_color if visual is not None and visual.defined else None
        return Visual(mesh=plain, color=_rgba(color))
    material = visual.material
    uv = np.asarray([] if visual.uv is None else visual.uv, float)
    if find_image(material) and uv.shape == (len(vertices), 2) and np.isfinite(uv).all():
        plain.visual = TextureVisuals(uv=uv, material=material)
    return Visual(mesh=plain, color=_rgba(getattr(material, "main_color", None)))


def _rgba(color: object) -> Color:
    """0..255 in any array-like to [0, 1]."""
    if color is None:
        return GREY
    values = np.asarray(color, float).reshape(-1) / 255
    if len(values) not in (3, 4) or not np.isfinite(values).all():
        return GREY
    red, green, blue, alpha = np.append(values, 1.0)[:4].clip(0, 1).tolist()
    return red, green, blue, alpha


def _without_strays(piece: Visual) -> Visual:
    """Without vertices that no triangle names: they are nothing to see, and may lie anywhere."""
    mesh = piece.mesh
    used = used_vertices(mesh.faces)
    if len(used) == len(mesh.vertices):
        return piece
    place = np.zeros(len(mesh.vertices), np.int64)
    place[used] = np.arange(len(used))
    kept = trimesh.Trimesh(mesh.vertices[used], place[mesh.faces], process=False, validate=False)
    if isinstance(mesh.visual, TextureVisuals):
        kept.visual = TextureVisuals(uv=mesh.visual.uv[used], material=mesh.visual.material)
    return Visual(mesh=kept, color=piece.color)


def _both_sides(pieces: list[Visual], scale: float, add: bool) -> list[Visual]:
    """Two-sided pieces, scaled; whether a shell is closed is asked of the whole file.

    Where nothing is to be added (`add`) the file has both sides of what is open.
    """
    result = []
    offsets = np.cumsum([0, *(len(piece.mesh.vertices) for piece in pieces)])
    stacked = np.concatenate([piece.mesh.vertices for piece in pieces])
    joined = [piece.mesh.faces + start for piece, start in zip(pieces, offsets, strict=False)]
    faces = np.concatenate(joined)
    faces = two_sided(stacked, faces) if add else faces
    for piece, start, end in zip(pieces, offsets[:-1], offsets[1:], strict=True):
        mine = (faces[:, 0] >= start) & (faces[:, 0] < end)
        if not mine.any():
            continue
        mesh = remade(piece.mesh, piece.mesh.vertices * scale, faces[mine] - start)
        result.append(Visual(mesh=mesh, color=piece.color))
    return result


def _unit(path: Path, units: str) -> float:
    """Metres per unit: trimesh writes a dae's as "0.0254 * meters"; other formats are as URDF."""
    found = re.match(r"^(\S+) \* meters$", units)
    scale = float(found[1]) if found else 1.0
    if not 0 < scale < math.inf:
        raise refuse(path, "a unit of some length", f"{scale:g} m")
    return scale


def _placed(piece: Visual, shape: Shape, files: SourceFiles, where: str) -> Visual:
    """Scaled, mirrored meshes rewound, and moved to where the shape sits on its link."""
    vertices, faces = piece.mesh.vertices, piece.mesh.faces
    if shape.kind == "mesh":
        vertices = vertices * np.array(shape.size)
        if np.prod(shape.size) < 0:
            files.repairs.add("A mirrored mesh was wound anew", where)
            faces = faces[:, ::-1]
    placed = moved(vertices, shape.link_T_shape)
    used = used_vertices(faces)
    if not (np.abs(placed[used]) <= MAX_COORDINATE).all():
        raise refuse(files.urdf, f"{where}: coordinates below {MAX_COORDINATE:g}", "larger ones")
    if not np.ptp(placed[used], axis=0).max() > MIN_SIZE:
        raise refuse(files.urdf, f"{where}: a shape larger than {MIN_SIZE:g}", "a smaller one")
    mesh = remade(piece.mesh, placed, faces)
    if shape.color is None:
        return Visual(mesh=mesh, color=piece.color)
    mesh.visual = ColorVisuals()  # the URDF's colour stands in for the file's material
    return Visual(mesh=mesh, color=shape.color)


def remade(
    mesh: trimesh.Trimesh, vertices: Float[np.ndarray, "V 3"], faces: Int[np.ndarray, "F 3"]
) -> trimesh.Trimesh:
    """The mesh with other positions and faces. A texture is shared: copying images is slow."""
    result = trimesh.Trimesh(vertices, faces, process=False, validate=False)
    if isinstance(mesh.visual, TextureVisuals):
        result.visual = TextureVisuals(uv=mesh.visual.uv, material=mesh.visual.material)
    return result


def solid(kind: ShapeKind, size: tuple[float, ...]) -> trimesh.Trimesh:
    """A box, cylinder, sphere or capsule about the origin, axis z, as URDF defines them.

    Args:
        kind: Not "mesh".
        size: As in `Shape.size`.
    """
    if kind == "box":
        return trimesh.creation.box(extents=size)
    if kind == "sphere":
        return trimesh.creation.icosphere(subdivisions=5, radius=size[0])
    sections = math.ceil(math.pi / math.acos(1 - SAGITTA) / 4) * 4
    radius, length = size
    if kind == "cylinder":
        return trimesh.creation.cylinder(radius=radius, height=length, sections=sections)
    # trimesh sets a capsule's lower centre on the origin in some versions: built by revolution.
    turn = np.linspace(-np.pi / 2, np.pi / 2, sections // 2 + 2)
    outline = np.stack([radius * np.cos(turn), radius * np.sin(turn)], 1)
    half = len(outline) // 2
    outline[:half, 1] -= length / 2
    outline[half:, 1] += length / 2
    outline[[0, -1], 0] = 0.0
    return trimesh.creation.revolve(outline, sections=sections)
