"""Writing of meshes with vertices and faces unchanged, in double precision where the format has it."""

import os
import warnings
from collections.abc import Iterable, Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from omtwarp.errors import OmtwarpError, OmtwarpWarning
from omtwarp.files.output import as_path, staged
from omtwarp.mesh.arrays import Floats, Ints, by_name, norms, real_numbers, single_precision, whole_numbers
from omtwarp.mesh.neuro import FREESURFER_SUFFIXES, write_freesurfer_surface, write_gifti_surface
from omtwarp.mesh.vtk import distinct_words, write_vtk

SUFFIXES = (".ply", ".obj", ".off", ".stl", ".glb", ".gii", ".vtk", *FREESURFER_SUFFIXES)


def write_mesh(
    path: str | os.PathLike[str],
    vertices: NDArray,
    faces: NDArray,
    *,
    beside: Mapping[str, NDArray] | None = None,
    spherical: bool = False,
    like: Path | None = None,
    structure: str | None = None,
) -> None:
    """Write a triangle mesh; vertex order and faces are kept, except that STL has only triangles.

    Args:
        path: .ply and .vtk (binary, double), .obj and .off (all digits of a double), .stl, .glb, GIFTI (.surf.gii) or a
            FreeSurfer surface (lh.sphere, ...), which have single precision.
        vertices: float64, shape [V, 3].
        faces: shape [F, 3].
        beside: further numbers per vertex by name, each shape [V]; for .ply and .vtk alone.
        spherical: it is a sphere, which GIFTI records.
        like: the file that the mesh comes from; GIFTI keeps its metadata, FreeSurfer's format its volume geometry.
        structure: the part of the brain, such as ``CortexLeft``, which GIFTI names where that file does not say it; by
            default what the names of the files say.

    Raises:
        OmtwarpError: arrays of another type or shape, another suffix, or the file cannot be written; then an older file
            is as it was.
    """
    file = as_path(path)
    suffix = file.suffix.lower()
    points = real_numbers(vertices, "vertices", (None, 3), finite=False)
    triangles = whole_numbers(faces, "faces", (None, 3)).astype(np.int32)
    for name, column in by_name(beside, "beside").items():
        real_numbers(column, f"beside, '{name}'", (len(points),), finite=False)
    if suffix not in SUFFIXES:
        raise OmtwarpError(f"cannot write '{file}': unknown suffix '{file.suffix}', use {', '.join(SUFFIXES)}")
    if beside and suffix not in (".ply", ".vtk"):
        raise OmtwarpError(f"cannot write '{file}': only .ply and .vtk hold numbers at the vertices")
    with staged(file) as place:
        if suffix == ".gii":
            write_gifti_surface(place, points, triangles, spherical, like, structure)
        elif suffix in FREESURFER_SUFFIXES:
            write_freesurfer_surface(place, points, triangles, like)
        elif suffix == ".vtk":
            write_vtk(place, points, triangles, beside)
        elif suffix == ".ply":
            place.write_bytes(ply_bytes(points, triangles, (beside or {}).items()))
        elif suffix == ".obj":
            rows = [f"v {x!r} {y!r} {z!r}\n" for x, y, z in points.tolist()]
            rows += [f"f {a} {b} {c}\n" for a, b, c in (triangles + 1).tolist()]
            place.write_text("".join(rows), "ascii")
        elif suffix == ".off":
            rows = [f"OFF\n{len(points)} {len(triangles)} 0\n"]
            rows += [f"{x!r} {y!r} {z!r}\n" for x, y, z in points.tolist()]
            rows += [f"3 {a} {b} {c}\n" for a, b, c in triangles.tolist()]
            place.write_text("".join(rows), "ascii")
        elif suffix == ".glb":
            content = GltfFile()
            content.add_triangles(triangles, {"POSITION": in_single_precision(points, triangles, "vertices")})
            place.write_bytes(content.encoded())
        else:
            import trimesh

            in_single_precision(points, triangles, "vertices")  # which STL has, too
            trimesh.Trimesh(points, triangles, process=False).export(place)


def in_single_precision(points: Floats, faces: NDArray[np.integer], name: str) -> NDArray[np.float32]:
    """Round points as formats of single precision hold them, and warn where they are too far away for their edges.

    Args:
        points: shape [V, 3].
        faces: shape [F, 3].
        name: what to call them in a message.

    Raises:
        OmtwarpError: they are out of the range of single precision.
    """
    rounded = single_precision(points, name)

    def changed(at: Floats) -> int:
        """Return how many triangles have an edge that rounding makes longer or shorter by a tenth."""
        there = at.astype(np.float32).astype(np.float64)
        before, after = (norms(x[faces] - x[np.roll(faces, 1, axis=1)]) for x in (at, there))
        return int((np.abs(after - before) > 0.1 * before).any(axis=1).sum())

    # Slivers along the charts of a texture change at the origin too; one triangle in a thousand may be as small
    lost, few = changed(points), len(faces) / 1000
    if lost > few and lost > few + changed(points - points.mean(axis=0)):
        what = f"single precision changes edges of {lost} of {len(faces)} faces by more than a tenth"
        warnings.warn(f"{what}: move the mesh to the origin, or write .ply or .obj", OmtwarpWarning, stacklevel=3)
    return rounded


class GltfFile:
    """A binary glTF 2.0 file with one mesh of triangles, as pygltflib writes it.

    Attributes:
        names: what the format has, the module pygltflib.
        content: what the file holds so far.
    """

    def __init__(self) -> None:
        import pygltflib

        self.names = pygltflib
        self.content = pygltflib.GLTF2(
            asset=pygltflib.Asset(generator="omtwarp"),
            scene=0,
            scenes=[pygltflib.Scene(nodes=[0])],
            nodes=[pygltflib.Node(mesh=0, name="surface")],
            meshes=[pygltflib.Mesh(name="surface")],
        )
        self._buffer = bytearray()

    def add_triangles(
        self, faces: NDArray[np.integer], rows: Mapping[str, NDArray], material: int | None = None
    ) -> None:
        """Append triangles with values at the rows that are their corners.

        Args:
            faces: shape [F, 3].
            rows: by the format's names, shape [N, K].
            material: its number.
        """
        numbers = {name: self._accessor(values.astype(np.float32), name == "POSITION") for name, values in rows.items()}
        corners = self._accessor(faces.ravel().astype(np.uint32))
        attributes = self.names.Attributes(**numbers)
        triangles = self.names.Primitive(attributes=attributes, indices=corners, material=material)
        self.content.meshes[0].primitives.append(triangles)

    def add_picture(self, encoded: bytes, kind: str, name: str, wraps: tuple[bool, bool]) -> int:
        """Append a picture, and return its number.

        Args:
            encoded: its bytes.
            kind: ``png``, or ``webp`` by the format's extension EXT_texture_webp.
            name: what programs show.
            wraps: whether it repeats to the right, and upwards, as all pictures of the file then do.
        """
        content, names, source = self.content, self.names, len(self.content.images)
        across, upwards = (names.REPEAT if on else names.CLAMP_TO_EDGE for on in wraps)
        filters = {"magFilter": names.LINEAR, "minFilter": names.LINEAR_MIPMAP_LINEAR}
        content.samplers[:] = [names.Sampler(wrapS=across, wrapT=upwards, **filters)]
        content.images.append(names.Image(bufferView=self._view(encoded), mimeType=f"image/{kind}", name=name))
        texture = names.Texture(sampler=0, source=source)
        if kind == "webp":
            texture = names.Texture(sampler=0, extensions={"EXT_texture_webp": {"source": source}})
            self.use("EXT_texture_webp", required=True)
        content.textures.append(texture)
        return source

    def use(self, extension: str, *, required: bool = False) -> None:
        """Announce an extension of the format, without which the file can be read unless it is ``required``."""
        for extensions in (self.content.extensionsUsed, self.content.extensionsRequired)[: 1 + required]:
            if extension not in extensions:
                extensions.append(extension)

    def encoded(self) -> bytes:
        """Return the whole file."""
        self.content.buffers = [self.names.Buffer(byteLength=len(self._buffer))]
        self.content.set_binary_blob(self._buffer)
        return b"".join(self.content.save_to_bytes())

    def _view(self, content: bytes, target: int | None = None) -> int:
        """Append bytes and return the number of their view."""
        view = self.names.BufferView(buffer=0, byteOffset=len(self._buffer), byteLength=len(content), target=target)
        self.content.bufferViews.append(view)
        self._buffer += content
        return len(self.content.bufferViews) - 1

    def _accessor(self, values: NDArray[np.generic], bounds: bool = False) -> int:
        """Append rows of numbers, float32 or uint32 indices, and return the number of their accessor."""
        indices, names = values.dtype == np.uint32, self.names
        accessor = names.Accessor(
            bufferView=self._view(values.tobytes(), names.ELEMENT_ARRAY_BUFFER if indices else names.ARRAY_BUFFER),
            componentType=names.UNSIGNED_INT if indices else names.FLOAT,
            count=len(values),
            type="SCALAR" if indices else f"VEC{values.shape[1]}",
            min=values.min(axis=0).tolist() if bounds else None,
            max=values.max(axis=0).tolist() if bounds else None,
        )
        self.content.accessors.append(accessor)
        return len(self.content.accessors) - 1


def ply_bytes(points: Floats, faces: Ints, properties: Iterable[tuple[str, NDArray[np.generic]]] = ()) -> bytes:
    """Encode a mesh as binary PLY with further properties of its vertices: bytes, else all in double precision."""
    given = list(properties)
    names = ["x", "y", "z", *distinct_words((name for name, _ in given), "x", "y", "z")]
    head = f"ply\nformat binary_little_endian 1.0\ncomment omtwarp\nelement vertex {len(points)}\n"
    columns = [*points.T, *(np.asarray(column) for _, column in given)]
    kinds = ["u1" if column.dtype == np.uint8 else "<f8" for column in columns]
    words = {"u1": "uchar", "<f8": "double"}
    head += "".join(f"property {words[kind]} {name}\n" for kind, name in zip(kinds, names, strict=True))
    head += f"element face {len(faces)}\nproperty list uchar int vertex_indices\nend_header\n"
    table = np.empty(len(points), dtype=[(str(k), kind) for k, kind in enumerate(kinds)])
    for k, column in enumerate(columns):
        table[str(k)] = column
    rows = np.empty(len(faces), dtype=[("count", "u1"), ("corners", "<i4", 3)])
    rows["count"], rows["corners"] = 3, faces
    return head.encode() + table.tobytes() + rows.tobytes()
