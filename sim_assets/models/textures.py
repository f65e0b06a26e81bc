# SPDX-License-Identifier: MIT
"""Colours of surfaces: one per visual, or a texture's at the point that is seen.

A texture is looked up as the graphics card does it (bilinear between texel centres, repeated
outside [0, 1], no mipmaps), so that ray casting, SAPIEN and ManiSkill show the same colour. As in
SAPIEN's `trivial` shader it replaces the material's colour, and is not lit; only a glTF base colour
factor is multiplied in, as that format says.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np
import PIL.Image
from jaxtyping import Float, Int, UInt8
from PIL.Image import Image
from trimesh.visual import TextureVisuals

from sim_assets.models.sides import are_added_reverses, fronts_and_backs
from sim_assets.objects import Visual

MAX_TEXELS = 1 << 26
"""Of a texture: 8192 x 8192."""
FORMATS = ("PNG", "JPEG", "BMP", "TGA", "WEBP", "GIF")
"""Of textures, told by their content: Pillow knows formats that are programs (EPS is PostScript,
which it hands to Ghostscript). Of an animation the first picture counts."""
LEFT_OUT = f"A texture was left out that is none of {', '.join(FORMATS)}, or is damaged"

Texels = UInt8[np.ndarray, "H W 3"]


def find_image(material: object) -> Image | None:
    """The picture of a trimesh material, or None."""
    for name in ("image", "baseColorTexture"):
        image = getattr(material, name, None)
        if isinstance(image, Image):
            return image
    return None


@contextmanager
def only_pictures(on_left_out: Callable[[str], None]) -> Iterator[None]:
    """While mesh loaders run, which open pictures themselves: refuse all but `FORMATS`, small ones.

    Args:
        on_left_out: Told why, for each picture that a loader is refused; it goes on without.
    """
    before = PIL.Image.open

    def opened(file: Any, mode: Any = "r", formats: object = None) -> Image:  # noqa: ANN401
        del formats
        try:
            image = before(file, mode, FORMATS)
            if not 0 < image.width * image.height <= MAX_TEXELS:
                raise ValueError(f"{image.width} x {image.height} texels")
        except Exception:
            on_left_out(LEFT_OUT)
            raise
        return image

    PIL.Image.open = opened
    try:
        yield
    finally:
        PIL.Image.open = before


def is_readable(image: Image) -> bool:
    """Whether a picture can be decoded and is not absurdly large; remembers what it decoded."""
    if not 0 < image.width * image.height <= MAX_TEXELS:
        return False
    try:
        image.load()
    except (OSError, ValueError, SyntaxError, EOFError):  # what Pillow's readers raise
        return False
    return True


def read_texels(material: object) -> Texels | None:
    """The material's texture in sRGB, first row on top (v = 1); None if it has none."""
    image = find_image(material)
    if image is None:
        return None
    texels = np.asarray(image.convert("RGB"))
    factor = getattr(material, "baseColorFactor", None)
    if factor is None:
        return texels
    share = np.asarray(factor, float).reshape(-1)[:3] / 255  # trimesh keeps it in 0..255
    return np.clip(texels * share + 0.5, 0, 255).astype(np.uint8)


def texture_of(visual: Visual) -> TextureVisuals | None:
    """Coordinates and material of the visual's texture, if it has one."""
    found = visual.mesh.visual
    if not isinstance(found, TextureVisuals) or found.uv is None:
        return None
    return None if find_image(found.material) is None else found


def look_up(texels: Texels, uv: Float[np.ndarray, "K 2"]) -> UInt8[np.ndarray, "K 3"]:
    """Colours at texture coordinates (v upwards)."""
    height, width = texels.shape[:2]
    x, y = uv[:, 0] * width - 0.5, (1 - uv[:, 1]) * height - 0.5
    left, top = np.floor(x).astype(np.int64), np.floor(y).astype(np.int64)
    right, down = ((x - left)[:, None], (y - top)[:, None])
    rows, columns = (top % height, (top + 1) % height), (left % width, (left + 1) % width)
    above = texels[rows[0], columns[0]] * (1 - right) + texels[rows[0], columns[1]] * right
    below = texels[rows[1], columns[0]] * (1 - right) + texels[rows[1], columns[1]] * right
    return np.clip(above * (1 - down) + below * down + 0.5, 0, 255).astype(np.uint8)


class Paint:
    """Colours of one part, whose faces are those of `ArticulatedObject.part_mesh`."""

    def __init__(self, visuals: Sequence[Visual]) -> None:
        """Read the textures; surfaces that share one share what was read."""
        sizes = [len(visual.mesh.faces) for visual in visuals]
        plain = np.array([visual.color[:3] for visual in visuals])
        self.plain = np.repeat(np.clip(plain * 255 + 0.5, 0, 255).astype(np.uint8), sizes, axis=0)
        self.first = np.cumsum([0, *sizes])
        self.front, self.back = seen_faces(visuals)
        self.textured: list[tuple[int, Visual, np.ndarray, Texels]] = []
        corners = [visual.mesh.vertices[visual.mesh.faces] for visual in visuals]
        a, b, c = np.concatenate(corners).transpose(1, 0, 2)
        self.normals = np.cross(b - a, c - a)
        read: dict[int, Texels | None] = {}
        for k, visual in enumerate(visuals):
            found = texture_of(visual)
            if found is None:
                continue
            if id(found.material) not in read:
                read[id(found.material)] = read_texels(found.material)
            texels = read[id(found.material)]
            if texels is not None:
                self.textured.append((k, visual, np.asarray(found.uv, float), texels))

    def colors(
        self,
        face: Int[np.ndarray, " K"],
        points: Float[np.ndarray, "K 3"],
        rays: Float[np.ndarray, "K 3"] | None = None,
    ) -> UInt8[np.ndarray, "K 3"]:
        """SRGB at points of the part's surface.

        Args:
            face: The face that each point lies on.
            points: Part frame, m.
            rays: Along which they are seen, of any length, part frame; None: from in front.
        """
        if rays is None:
            face = self.front[face]
        else:
            behind = (self.normals[face] * rays).sum(-1) > 0
            other = np.where(self.back[face] >= 0, self.back[face], self.front[face])
            face = np.where(behind, other, self.front[face])
        result = self.plain[face]
        for k, visual, uv, texels in self.textured:
            mine = np.flatnonzero((face >= self.first[k]) & (face < self.first[k + 1]))
            if len(mine):
                corners = visual.mesh.faces[face[mine] - self.first[k]]
                weights = barycentric(visual.mesh.vertices[corners], points[mine])
                result[mine] = look_up(texels, (weights[:, :, None] * uv[corners]).sum(1))
        return result


def seen_faces(
    visuals: Sequence[Visual],
) -> tuple[Int[np.ndarray, " F"], Int[np.ndarray, " F"]]:
    """`sides.fronts_and_backs` of a part."""
    starts = np.cumsum([0, *(len(visual.mesh.vertices) for visual in visuals[:-1])])
    faces = [v.mesh.faces + start for v, start in zip(visuals, starts, strict=True)]
    return fronts_and_backs(
        np.concatenate([visual.mesh.vertices for visual in visuals]),
        np.concatenate(faces),
        np.concatenate([are_added_reverses(visual.mesh.faces) for visual in visuals]),
    )


def one_per_side(visuals: Sequence[Visual]) -> list[Int[np.ndarray, "F 3"]]:
    """Faces of each visual such that from either side one is seen at a place."""
    front, back = seen_faces(visuals)
    shown = front == np.arange(len(front))
    ends = np.cumsum([len(visual.mesh.faces) for visual in visuals])[:-1]
    return [
        np.concatenate([visual.mesh.faces[keep], visual.mesh.faces[keep & alone][:, ::-1]])
        for visual, keep, alone in zip(
            visuals, np.split(shown, ends), np.split(back < 0, ends), strict=True
        )
    ]


def barycentric(
    triangles: Float[np.ndarray, "K 3 3"], points: Float[np.ndarray, "K 3"]
) -> Float[np.ndarray, "K 3"]:
    """Weights of the corners at points in the triangles' planes; a sliver's first corner is it."""
    a, b, c = (np.asarray(triangles[:, i], float) for i in range(3))
    normal = np.cross(b - a, c - a)
    square = (normal**2).sum(-1)
    scale = 1 / np.where(square > 0, square, 1)
    v = (np.cross(points - a, c - a) * normal).sum(-1) * scale
    w = (np.cross(b - a, points - a) * normal).sum(-1) * scale
    return np.stack([1 - v - w, v, w], -1)
