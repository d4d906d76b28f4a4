"""A mesh that was cut along the seams of its texture, and the texture."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

import numpy as np
from numpy.typing import NDArray

from omtwarp.texturing.atlas import Atlas
from omtwarp.texturing.baking import sample
from omtwarp.texturing.image import as_bytes

ROUGHNESS = 0.65  # of the material: half matt, so that a pattern is not lost in highlights; by convention

if TYPE_CHECKING:
    import trimesh
    from PIL.Image import Image

Floats = NDArray[np.float64]
Ints = NDArray[np.int32]


@dataclass
class TexturedMesh:
    """A mesh cut along the seams of its texture, and the texture.

    The surface is the input's, to round-off. The input's vertices come first, in their order; copies of them at seams
    and the few vertices made by cuts follow.

    Attributes:
        vertices: float64, shape [N, 3], in the units of the input.
        faces: int32, shape [M, 3].
        uv: texture coordinates, float64, shape [N, 2], v up (0 is the bottom row of the image).
        normals: unit vectors, shape [N, 3], from the uncut mesh: the same on both sides of a seam.
        image: uint8, shape [H, W, 3], or [H, W, 4] where something is transparent; row 0 on top.
        sphere: the map at every vertex, unit vectors, shape [N, 3].
        source_vertex: the input's vertex that each vertex is or is a copy of, -1 for one made by a cut, shape [N].
        source_face: the input's face that each face is a part of, shape [M].
        welded: vertices with the same number are the same point of the uncut mesh, shape [N].
        chart: chart of the atlas that each face lies in, shape [M].
        atlas: how the sphere is laid out on the image.
        rotation: the texture's rotation on the sphere, shape [3, 3].
        original_vertices, original_faces, original_sphere: the input.
        source_image: the file that the texture was made from, if any; an export never replaces it.
    """

    vertices: Floats
    faces: Ints
    uv: Floats
    normals: Floats
    image: NDArray[np.uint8]
    sphere: Floats
    source_vertex: Ints
    source_face: Ints
    welded: Ints
    chart: Ints
    atlas: Atlas
    rotation: Floats
    original_vertices: Floats = field(repr=False)
    original_faces: Ints = field(repr=False)
    original_sphere: Floats = field(repr=False)
    source_image: Path | None = field(default=None, repr=False)

    def __repr__(self) -> str:
        height, width = self.image.shape[:2]
        return (
            f"{type(self).__name__}({self.original_vertex_count} vertices cut into {len(self.vertices)}, "
            f"{len(self.faces)} faces, {self.atlas.name} texture {width}x{height})"
        )

    @property
    def original_vertex_count(self) -> int:
        """The number of vertices of the input, which come first."""
        return len(self.original_vertices)

    @property
    def wraps(self) -> bool:
        """Whether the image is periodic in u, so that a sampler has to repeat there (and clamp in v)."""
        return self.atlas.wraps

    @property
    def wraps_rows(self) -> bool:
        """Whether the image is periodic in v, too: never on a sphere."""
        return False

    @property
    def vertex_colours(self) -> NDArray[np.uint8]:
        """Red, green, blue and alpha of the texture at the input's vertices, uint8, shape [V, 4]."""
        values = sample(self.image, self.original_sphere @ self.rotation, self.atlas, device="cpu")
        colours = np.full((len(values), 4), 255, dtype=np.uint8)
        colours[:, : values.shape[1]] = as_bytes(values.astype(np.float32))
        return colours

    def pil(self) -> Image:
        """Return the texture as a PIL image."""
        from PIL import Image

        return Image.fromarray(self.image)

    def trimesh(self) -> trimesh.Trimesh:
        """Return the cut mesh as a :class:`trimesh.Trimesh` with its material, vertices in this object's order."""
        return with_material(self)


class TexturedArrays(Protocol):
    """A mesh with a texture; fields as of :class:`TexturedMesh`."""

    vertices: Floats
    faces: Ints
    uv: Floats
    normals: Floats
    image: NDArray[np.uint8]


def with_material(textured: TexturedArrays) -> trimesh.Trimesh:
    """Return a textured mesh as a :class:`trimesh.Trimesh` whose material shows the picture, its vertices in order."""
    import trimesh
    from PIL import Image

    material = trimesh.visual.material.PBRMaterial(
        name="texture",
        baseColorTexture=Image.fromarray(textured.image),
        baseColorFactor=[255, 255, 255, 255],
        metallicFactor=0.0,
        roughnessFactor=ROUGHNESS,
    )
    return trimesh.Trimesh(
        vertices=textured.vertices,
        faces=textured.faces,
        vertex_normals=textured.normals,
        visual=trimesh.visual.TextureVisuals(uv=textured.uv, material=material),
        process=False,
        validate=False,
    )
