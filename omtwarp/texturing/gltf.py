"""Assembly of binary glTF 2.0 files: views of one buffer, accessors to them, pictures, and one mesh."""

from __future__ import annotations

import json
import struct

import numpy as np
from numpy.typing import NDArray

from omtwarp.errors import OmtwarpError
from omtwarp.mesh.write import ARRAY_BUFFER, ELEMENT_ARRAY_BUFFER
from omtwarp.options import TextureFormat
from omtwarp.texturing.image import png_bytes, webp_bytes

# Numbers of OpenGL that glTF 2.0 uses: wrapping and filters of samplers, types of components, modes.
REPEAT, CLAMP = 10497, 33071
LINEAR, LINEAR_MIPMAP_LINEAR = 9729, 9987
FLOAT, UNSIGNED_INT = 5126, 5125
TRIANGLES = 4
WEBP = "EXT_texture_webp"  # of textures: without it, pictures are PNG or JPEG
KINDS = {1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4"}


class GltfFile:
    """The parts of a file so far.

    Args:
        wraps: whether pictures repeat to the right.
        wraps_rows: whether they repeat upwards; on a sphere the poles would bleed into each other.
        texture_format: how pictures are encoded; WebP is the extension EXT_texture_webp of the format.
    """

    def __init__(self, wraps: bool, wraps_rows: bool, texture_format: TextureFormat = TextureFormat.PNG):
        self._format = texture_format
        self._buffer = bytearray()
        self._views: list[dict[str, object]] = []
        self._accessors: list[dict[str, object]] = []
        self._images: list[dict[str, object]] = []
        self._known: dict[int, int] = {}
        self._sampler = {
            "magFilter": LINEAR,
            "minFilter": LINEAR_MIPMAP_LINEAR,
            "wrapS": REPEAT if wraps else CLAMP,
            "wrapT": REPEAT if wraps_rows else CLAMP,
        }

    def _view(self, content: bytes, target: int | None = None) -> int:
        """Append bytes and return the number of their view."""
        self._buffer.extend(b"\0" * (-len(self._buffer) % 4))
        entry: dict[str, object] = {"buffer": 0, "byteOffset": len(self._buffer), "byteLength": len(content)}
        if target is not None:
            entry["target"] = target
        self._views.append(entry)
        self._buffer.extend(content)
        return len(self._views) - 1

    def accessor(self, array: NDArray[np.generic], bounds: bool = False) -> int:
        """Append rows of numbers, float32 or uint32 indices, and return the number of their accessor."""
        indices = array.dtype == np.uint32
        entry: dict[str, object] = {
            "bufferView": self._view(array.tobytes(), ELEMENT_ARRAY_BUFFER if indices else ARRAY_BUFFER),
            "componentType": UNSIGNED_INT if indices else FLOAT,
            "count": len(array),
            "type": KINDS[1 if array.ndim == 1 else array.shape[1]],
        }
        if bounds:
            entry["min"] = [float(x) for x in array.min(axis=0)]
            entry["max"] = [float(x) for x in array.max(axis=0)]
        self._accessors.append(entry)
        return len(self._accessors) - 1

    def texture(self, picture: NDArray[np.uint8], name: str) -> dict[str, int]:
        """Embed a picture, once however many materials share it, and return how a material refers to it."""
        if id(picture) not in self._known:
            self._known[id(picture)] = len(self._images)
            encoded = png_bytes(picture) if self._format is TextureFormat.PNG else webp_bytes(picture)
            view = self._view(encoded)
            self._images.append({"bufferView": view, "mimeType": f"image/{self._format}", "name": name})
        return {"index": self._known[id(picture)], "texCoord": 0}

    def content(self, primitives: list[dict[str, object]], materials: list[dict[str, object]]) -> bytes:
        """Return the whole file, with one mesh of triangles.

        Args:
            primitives: attributes and indices of each, by the numbers of their accessors.
            materials: of the primitives, one each.
        """
        document: dict[str, object] = {
            "asset": {"version": "2.0", "generator": "omtwarp"},
            "scene": 0,
            "scenes": [{"nodes": [0]}],
            "nodes": [{"mesh": 0, "name": "surface"}],
            "meshes": [
                {
                    "name": "surface",
                    "primitives": [
                        primitive | {"material": number, "mode": TRIANGLES}
                        for number, primitive in enumerate(primitives)
                    ],
                }
            ],
            "materials": materials,
        }
        if self._images:
            sources: list[dict[str, object]] = [{"source": source} for source in range(len(self._images))]
            if self._format is TextureFormat.WEBP:
                sources = [{"extensions": {WEBP: source}} for source in sources]
                document |= {"extensionsUsed": [WEBP], "extensionsRequired": [WEBP]}
            textures = [{"sampler": 0} | source for source in sources]
            document |= {"textures": textures, "samplers": [self._sampler], "images": self._images}
        blob = bytes(self._buffer) + b"\0" * (-len(self._buffer) % 4)
        buffers = [{"byteLength": len(blob)}]
        document |= {"accessors": self._accessors, "bufferViews": self._views, "buffers": buffers}
        text = json.dumps(document, separators=(",", ":")).encode()
        text += b" " * (-len(text) % 4)
        head = struct.pack("<4sII", b"glTF", 2, 12 + 8 + len(text) + 8 + len(blob))
        return head + struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(blob), b"BIN\0") + blob


def single_precision(values: NDArray[np.float64], name: str) -> NDArray[np.float32]:
    """Round numbers to single precision, the only one that the format has.

    Args:
        values: any shape.
        name: what to call them in a message.

    Raises:
        OmtwarpError: a number is too large for single precision.
    """
    largest = float(np.abs(values).max(initial=0.0))
    if largest > np.finfo(np.float32).max:
        raise OmtwarpError(
            f"cannot write {name} up to {largest:.3g} as GLB, which holds 32-bit numbers: scale the mesh down"
        )
    return np.ascontiguousarray(values, dtype=np.float32)


def flipped_rows(uv: NDArray[np.float64]) -> NDArray[np.float32]:
    """Move the origin of texture coordinates [N, 2] to the top left, where the format has it."""
    return np.ascontiguousarray(np.stack([uv[:, 0], 1.0 - uv[:, 1]], axis=1), dtype=np.float32)


__all__ = ["GltfFile", "flipped_rows", "single_precision"]
