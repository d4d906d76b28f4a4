"""Materials of meshes, in the terms of glTF 2.0, and their files: GLB, and OBJ with its MTL and PNG files.

The files appear once all of them are complete, so that a failure, a full disk or Ctrl-C leaves the old ones or none.
"""

import os
import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from omtwarp.colors import to_linear
from omtwarp.errors import OmtwarpError, choose
from omtwarp.files.output import as_path, companion, staged
from omtwarp.mesh.arrays import ROUND_OFF, TINY, Bytes, Floats, Ints, marked, normalised, real_numbers, summed
from omtwarp.mesh.scenes import BRIGHTER
from omtwarp.mesh.write import GltfFile, in_single_precision
from omtwarp.options import TextureFormat
from omtwarp.texturing.image import png_bytes, webp_bytes

WHITE = (1.0, 1.0, 1.0, 1.0)  # sRGB and opacity: the factor that does not change a picture


def linear(color: Floats) -> Floats:
    """Convert colours from sRGB to linear light (IEC 61966-2-1), shape [..., 4]; their opacity does not change."""
    return np.concatenate([to_linear(color[..., :3]), color[..., 3:]], axis=-1)


@dataclass(frozen=True, eq=False)
class Material:
    """How the triangles of one material look, in the terms of glTF 2.0.

    Attributes:
        name: as the file calls it.
        color: red, green, blue (sRGB) and opacity, from 0 to 1; a factor on the picture where there is one.
        picture: colours, uint8 sRGB, shape [H, W, 3] or [H, W, 4], row 0 on top; None for one colour.
        metallic: 0 for a dielectric, 1 for a metal.
        roughness: 0 for a mirror, 1 for a matt surface.
        emission: factor on the light that the material sends out, linear red, green and blue.
        two_sided: whether the triangles are seen from behind.
        normal_picture: tangent-space normals as glTF's ``normalTexture`` holds them.
        occlusion_picture: ambient occlusion in red, as glTF's ``occlusionTexture`` holds it; 255 is open.
        roughness_picture: roughness in green and metalness in blue, glTF's ``metallicRoughnessTexture``.
        emission_picture: the light that is sent out, glTF's ``emissiveTexture``.
        own_tangents: whether ``normal_picture`` belongs to the tangents that a file is written with, rather than to
            those that a reader computes.
        phong: statements of an OBJ library that glTF has no terms for, by their names, such as ``("Ns", (250.0,))``;
            an OBJ is written with them again.

    Raises:
        OmtwarpError: colour, emission, metalness or roughness are not that many finite numbers, the name is no text, or
            a picture has another form.

    Example:
        >>> import omtwarp
        >>> omtwarp.Material("glass", color=(0.9, 1.0, 1.0, 0.3)).opaque
        False
    """

    name: str = "material"
    color: tuple[float, float, float, float] = WHITE
    picture: Bytes | None = None
    metallic: float = 0.0
    roughness: float = 0.65
    emission: tuple[float, float, float] = (0.0, 0.0, 0.0)
    two_sided: bool = False
    normal_picture: Bytes | None = None
    occlusion_picture: Bytes | None = None
    roughness_picture: Bytes | None = None
    emission_picture: Bytes | None = None
    own_tangents: bool = False
    phong: tuple[tuple[str, tuple[float, ...]], ...] = ()

    def __post_init__(self) -> None:
        for name, shape in {"color": (4,), "emission": (3,), "metallic": (), "roughness": ()}.items():
            real_numbers(getattr(self, name), name, shape)
        if not isinstance(self.name, str):
            raise OmtwarpError(f"name: must be text, not a {type(self.name).__name__}")
        for name in (own for _, own, *_ in SLOTS if getattr(self, own) is not None):
            picture = getattr(self, name)
            form = picture.shape[2:] if isinstance(picture, np.ndarray) and picture.dtype == np.uint8 else None
            if form not in ((3,), (4,)) or not picture.size:
                raise OmtwarpError(f"{name}: must be a picture, uint8, of shape [H, W, 3] or [H, W, 4]")

    @property
    def plain(self) -> bool:
        """Whether the material has no picture of any kind."""
        return all(getattr(self, own) is None for _, own, *_ in SLOTS)

    def on_other_coordinates(self) -> "Material":
        """Return the material without pictures but that of its colours, which are laid out for coordinates left.

        It is as rough and metallic as in the mean, and sends out no light where a picture says where it did.
        """
        picture = self.roughness_picture
        rough, metal = np.ones(2) if picture is None else picture[..., 1:3].mean(axis=(0, 1)) / 255.0
        metallic, roughness = float(metal * self.metallic), float(rough * self.roughness)
        emission = self.emission if self.emission_picture is None else (0.0, 0.0, 0.0)
        return Material(
            self.name, self.color, self.picture, metallic, roughness, emission, self.two_sided, phong=self.phong
        )

    @property
    def opaque(self) -> bool:
        """Whether the material is opaque."""
        transparent = self.picture is not None and self.picture.shape[2] == 4 and self.picture[..., 3].min() < 255
        return self.color[3] >= 1.0 and not transparent


def corner_tangents(vertices: Floats, faces: Ints, uv: Floats, normals: Floats) -> Floats:
    """Return the unit tangents of corners in the direction of growing u, with glTF's sign of the bitangent.

    The tangents of triangles (Lengyel, "Foundations of Game Engine Development 2", 2019, section 7.5) are summed over
    the triangles around a vertex that meet there with the same coordinates and orientation, and made orthogonal to the
    normal. The bitangent is ``sign * cross(normal, tangent)``, along growing v (upwards in the picture).

    Args:
        vertices: shape [V, 3].
        faces: shape [F, 3].
        uv: of the corners, v up, shape [F, 3, 2].
        normals: unit, of the vertices, shape [V, 3].

    Returns:
        Shape [F, 3, 4]: the tangent and the sign, 1 or -1 (mirrored coordinates).
    """
    edge_1, edge_2 = vertices[faces[:, 1]] - vertices[faces[:, 0]], vertices[faces[:, 2]] - vertices[faces[:, 0]]
    du_1, dv_1 = (uv[:, 1] - uv[:, 0]).T
    du_2, dv_2 = (uv[:, 2] - uv[:, 0]).T
    sign = np.where(du_1 * dv_2 - du_2 * dv_1 < 0, -1.0, 1.0)  # of the triangle's area in the picture
    # Weighted by that area.
    tangent = (edge_1 * dv_2[:, None] - edge_2 * dv_1[:, None]) * sign[:, None]
    rows = np.concatenate([faces.reshape(-1, 1), uv.reshape(-1, 2), np.repeat(sign, 3)[:, None]], axis=1)
    group = np.unique(rows, axis=0, return_inverse=True)[1].reshape(-1)
    total = summed(np.repeat(tangent, 3, axis=0), group)[group]
    normal = normals[faces.ravel()]
    flat = total - normal * (total * normal).sum(axis=1, keepdims=True)
    length = np.linalg.norm(flat, axis=1, keepdims=True)
    # Where triangles have no area in the picture any tangent will do.
    # Of a normal's x: another axis helps where it is larger. Below 1/sqrt(2) an axis is 45 degrees or more from the
    # normal.
    helper = np.where(np.abs(normal[:, :1]) < 0.7, (1.0, 0.0, 0.0), (0.0, 1.0, 0.0))
    other = normalised(np.cross(normal, helper))
    degenerate = length <= ROUND_OFF * max(float(length.max(initial=0.0)), TINY)
    unit = np.where(degenerate, other, flat / np.maximum(length, TINY))
    return np.concatenate([unit, np.repeat(sign, 3)[:, None]], axis=1).reshape(-1, 3, 4)


SUFFIXES = (".glb", ".obj", ".ply")  # the last of which holds colours at the vertices alone
# For coordinates of materials that have no picture: a file's checkers and some programs take coordinates that nothing
# refers to for a mistake, or drop them. White leaves the material's colour as it is.
BLANK = np.full((1, 1, 3), 255, dtype=np.uint8)
# A material's pictures: glTF's name, our own, what the file calls them, and the statement of an OBJ's material library;
# `norm` and `map_ao` are read by Blender's and other importers.
SLOTS = (
    ("baseColorTexture", "picture", "color", "map_Kd"),
    ("metallicRoughnessTexture", "roughness_picture", "roughness", None),
    ("normalTexture", "normal_picture", "normal", "norm"),
    ("occlusionTexture", "occlusion_picture", "occlusion", "map_ao"),
    ("emissiveTexture", "emission_picture", "emission", "map_Ke"),
)


@dataclass(frozen=True)
class Part:
    """The triangles of one material; their corners are rows, of which a vertex has several along seams.

    Attributes:
        material: how they look.
        faces: rows of the corners, shape [F, 3].
        vertex: of the mesh, of every row, shape [N].
        uv: coordinates of the rows, v up, shape [N, 2]; None where some corner has none.
        tangents: of the rows, with the sign of the bitangent, shape [N, 4].
        belongs: number of each triangle's object, shape [F]; None for one object.
    """

    material: Material
    faces: NDArray[np.integer]
    vertex: NDArray[np.integer]
    uv: Floats | None = None
    tangents: Floats | None = None
    belongs: Ints | None = None


@dataclass(frozen=True)
class Model:
    """A mesh in parts of one material each, as files hold it.

    Attributes:
        vertices: shape [V, 3].
        normals: unit vectors at them, shape [V, 3].
        parts: its triangles.
        colors: sRGB and opacity at the vertices, shape [V, 4].
        wraps: whether pictures repeat to the right, and upwards.
        objects: names of object and group that parts' triangles belong to, for ``.obj``.
    """

    vertices: Floats
    normals: Floats
    parts: Sequence[Part]
    colors: Bytes | None = None
    wraps: tuple[bool, bool] = (True, True)
    objects: Sequence[tuple[str, str]] = ()


def uv_of_corners(uv: ArrayLike, faces: NDArray) -> Floats:
    """Return texture coordinates of vertices, shape [V, 2], or of corners at the corners of faces, shape [F, 3, 2].

    Raises:
        OmtwarpError: neither shape, or fewer coordinates than vertices.
    """
    given = real_numbers(uv, "texture coordinates", None, finite=False)
    if given.ndim == 2 and given.shape[1] == 2 and faces.max(initial=-1) < len(given):
        return given[faces]
    if given.shape != (len(faces), 3, 2):
        raise OmtwarpError(f"texture coordinates of shape {list(given.shape)}: give [V, 2] or [F, 3, 2]")
    return given


def split_corners(faces: Ints, values: Floats, count: int) -> tuple[Ints, Ints, Floats]:
    """Make one row of every vertex and the values at its corners.

    The first row of every vertex has the vertex's number; the others follow.

    Args:
        faces: shape [F, 3].
        values: at the corners, finite, shape [F, 3, K].
        count: of vertices, V.

    Returns:
        The rows of the corners, shape [F, 3], the vertices of the rows, shape [N], and their values, shape [N, K].
    """
    vertex, flat = faces.ravel(), values.reshape(faces.size, -1)
    width = flat.shape[1]
    at = np.zeros((count, width))
    at[vertex] = flat
    # Only vertices on borders have several: their corners are sorted, all others' are as they should be.
    several = marked(count, vertex[(flat != at[vertex]) @ np.ones(width, dtype=np.int8) > 0])
    some = np.flatnonzero(several[vertex])
    order = some[np.lexsort((*flat[some].T[::-1], vertex[some]))]
    v, each = vertex[order], flat[order]
    new = np.append(True, (v[1:] != v[:-1]) | np.any(each[1:] != each[:-1], axis=1))[: len(v)]
    owner = v[new]
    more = np.append(False, owner[1:] == owner[:-1])[: len(owner)]
    number = owner.astype(np.int64)
    number[more] = count + np.arange(np.count_nonzero(more))
    rows = vertex.astype(np.int32)
    rows[order] = number[np.cumsum(new) - 1]
    at = np.concatenate([at, each[new][more]])
    at[number] = each[new]
    return rows.reshape(-1, 3), np.concatenate([np.arange(count), owner[more]]).astype(np.int32), at


def export(
    path: str | os.PathLike[str], model: Model, keep: Iterable[Path | None], texture_format: str = TextureFormat.PNG
) -> list[Path]:
    """Write a mesh with materials in the format of the path's suffix.

    Args:
        path: ``.glb``, or ``.obj``, whose material library and pictures get free names in the same folder, or those of
            files that the package wrote there before.
        model: the mesh.
        keep: files that must not be replaced, such as inputs.
        texture_format: ``png`` or, in a .glb, ``webp``.

    Returns:
        The files written, the named one last.

    Raises:
        OmtwarpError: another suffix or format, a place that cannot be written to, a full disk.
    """
    suffix = as_path(path).suffix.lower()
    if suffix not in SUFFIXES[:2]:
        raise OmtwarpError(
            f"cannot write '{path}': use .glb, .obj (with .mtl and .png) or, for the colours of a texture at the "
            "vertices, .ply"
        )
    encoding, kept = format_for(suffix, texture_format), tuple(keep)
    with staged(path, keep=kept) as file:
        files = [(file, glb_bytes(model, encoding))] if suffix == ".glb" else obj_files(model, file, kept)
        for name, content in files:
            name.write_bytes(content)
    return [as_path(path).with_name(name.name) for name, _ in files[:-1]] + [as_path(path)]


def format_for(suffix: str, texture_format: str) -> TextureFormat:
    """Check the encoding of pictures in files of a suffix, and return it.

    Raises:
        OmtwarpError: an unknown encoding, or WebP in another file than .glb.
    """
    chosen = choose(TextureFormat, texture_format)
    if chosen is TextureFormat.WEBP and suffix != ".glb":
        raise OmtwarpError(f"WebP textures are for .glb: '{suffix}' has PNG, or colours at vertices")
    return chosen


def glb_bytes(model: Model, texture_format: TextureFormat) -> bytes:
    """Encode a mesh with materials as a binary glTF 2.0 file; arguments as of :func:`export`.

    Raises:
        OmtwarpError: positions are out of the range of single precision, the only one that the format has.
    """
    file = GltfFile()
    faces = np.concatenate([part.vertex[part.faces] for part in model.parts])
    positions = in_single_precision(model.vertices, faces, "cannot write positions as GLB")
    known: dict[int, int] = {}
    for number, part in enumerate(model.parts):
        rows = {"POSITION": positions[part.vertex], "NORMAL": model.normals[part.vertex]}
        if part.uv is not None:  # whose origin the format has at the top left
            rows["TEXCOORD_0"] = part.uv * (1.0, -1.0) + (0.0, 1.0)
        if part.tangents is not None:
            rows["TANGENT"] = part.tangents
        if model.colors is not None:
            rows["COLOR_0"] = linear(model.colors[part.vertex] / 255.0)
        file.add_triangles(part.faces, rows, number)
        look = part.material
        surface: dict[str, object] = {"baseColorFactor": linear(np.array(look.color)).tolist()}
        surface |= {"metallicFactor": float(look.metallic), "roughnessFactor": float(look.roughness)}
        beside: dict[str, object] = {"name": look.name, "alphaMode": "OPAQUE" if look.opaque else "BLEND"}
        brightest = max(1.0, *map(float, look.emission))
        beside |= {"emissiveFactor": [light / brightest for light in look.emission], "doubleSided": look.two_sided}
        if brightest > 1.0:
            beside["extensions"] = {BRIGHTER: {"emissiveStrength": brightest}}
            file.use(BRIGHTER)
        for slot, own, ending, _ in SLOTS:
            picture, name = getattr(look, own), f"{look.name}-{ending}"
            if own == "picture" and look.plain:  # so that the coordinates belong to something
                picture, name = BLANK, "blank"
            if picture is None or part.uv is None:
                continue
            if id(picture) not in known:
                encoded = png_bytes(picture) if texture_format is TextureFormat.PNG else webp_bytes(picture)
                known[id(picture)] = file.add_picture(encoded, texture_format, name, model.wraps)
            place = surface if slot in ("baseColorTexture", "metallicRoughnessTexture") else beside
            place[slot] = file.names.TextureInfo(index=known[id(picture)])
        surfaces = file.names.PbrMetallicRoughness(**surface)
        file.content.materials.append(file.names.Material(pbrMetallicRoughness=surfaces, **beside))
    return file.encoded()


def obj_files(model: Model, place: Path, kept: tuple[Path | None, ...]) -> list[tuple[Path, bytes]]:
    """Return the files of an OBJ: pictures and material library first, the OBJ last.

    Vertices are written once and in their order, faces object by object and material by material; only texture
    coordinates are doubled along seams, as the format allows. A picture that is the only one has the OBJ's own name.
    """
    parts = model.parts
    drawn = [
        (number, statement, getattr(part.material, own), ending)
        for number, part in enumerate(parts)
        for _, own, ending, statement in SLOTS
        if statement and part.uv is not None and getattr(part.material, own) is not None
    ]
    alone = len({id(picture) for _, _, picture, _ in drawn}) == 1
    # Without spaces and comments, at which readers of these files end a name
    names = _distinct([re.sub(r"[\s#\x00-\x1f]+", "_", part.material.name).strip("_") for part in parts])
    safe = [re.sub(r"[^A-Za-z0-9._-]+", "_", part.material.name).strip("._") for part in parts]
    of_files = _distinct(safe, str.lower)
    written: dict[int, tuple[Path, bytes]] = {}
    for number, _, picture, ending in drawn:
        if id(picture) not in written:
            there = companion(place, ".png" if alone else f"-{of_files[number]}-{ending}.png", kept)
            written[id(picture)] = (there, png_bytes(picture))
    library = ["# omtwarp"]
    for k, (name, part) in enumerate(zip(names, parts, strict=True)):
        library += _library_entry(name, part.material)
        # No options: several readers take them as a part of the name.
        library += [f"{word} {written[id(picture)][0].name}" for number, word, picture, _ in drawn if number == k]
        library.append("")
    beside = companion(place, ".mtl", kept)
    text = ["# omtwarp\n", f"mtllib {beside.name}\n", _lines("v", model.vertices, "%.17g")]
    text.append(_lines("vn", model.normals, "%.5f"))
    text += (_lines("vt", part.uv, "%.9g") for part in parts if part.uv is not None)
    text += _obj_faces(parts, names, model.objects or [("surface", "")])
    contents = ("\n".join(library), beside), ("".join(text), place)
    return [*written.values(), *((file, words.encode(errors="surrogateescape")) for words, file in contents)]


def _obj_faces(parts: Sequence[Part], names: Sequence[str], objects: Sequence[tuple[str, str]]) -> Iterator[str]:
    """Yield the lines of an OBJ's faces: object by object, and of each material by material."""
    starts = np.cumsum([1, *(0 if part.uv is None else len(part.uv) for part in parts)])
    before = ("", "")
    for number, pair in enumerate(objects):
        for word, name, last in zip("og", pair, before, strict=True):
            if name != last:
                yield f"{word} {name}".rstrip() + "\n"
        before = pair
        for part, name, start in zip(parts, names, starts[:-1], strict=True):
            faces = part.faces if part.belongs is None else part.faces[part.belongs == number]
            if len(faces) == 0 or (part.belongs is None and number):
                continue
            v = part.vertex[faces] + 1
            yield f"usemtl {name}\ns 1\n"
            columns = [v, v] if part.uv is None else [v, faces + start, v]
            form = " ".join(["%d//%d" if part.uv is None else "%d/%d/%d"] * 3)
            yield _lines("f", np.stack(columns, axis=2).reshape(len(v), -1), form)


def _library_entry(name: str, material: Material) -> list[str]:
    """Return the lines of a material's numbers."""
    red, green, blue, opacity = material.color
    phong = {"Ks": (0.0, 0.0, 0.0), "illum": (1.0,)} | dict(material.phong)
    phong |= {"Ke": material.emission} if any(material.emission) or material.emission_picture is not None else {}
    # Readers take a roughness in place of the shininess that a library had, which had none then
    plain = "Ns" in phong and (material.roughness, material.metallic) == (Material.roughness, Material.metallic)
    return [
        f"newmtl {name}",
        f"Kd {red:.6f} {green:.6f} {blue:.6f}",
        *(" ".join((word, *(f"{number:.9g}" for number in numbers))) for word, numbers in phong.items()),
        f"d {opacity:.6f}",
        *([] if plain else [f"Pr {material.roughness:.4f}", f"Pm {material.metallic:.4f}"]),
    ]


def _distinct(words: list[str], compared: Callable[[str], str] = str) -> list[str]:
    """Return names that are not empty, and all different in what is compared of them."""
    names: list[str] = []
    for word in words:
        name = word = word or "material"
        number = 2
        while compared(name) in map(compared, names):
            name, number = f"{word}-{number}", number + 1
        names.append(name)
    return names


def _lines(prefix: str, rows: NDArray, form: str) -> str:
    """Write an array's rows as lines of text, with one format for all, which is much faster than a call per line."""
    line = f"{prefix} {form if prefix == 'f' else ' '.join([form] * rows.shape[1])}\n"
    return (line * len(rows)) % tuple(rows.ravel().tolist())
