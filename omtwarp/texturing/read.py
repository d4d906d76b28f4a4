"""Reading a mesh with its texture coordinates and materials, vertices and faces as ``read_mesh`` has them."""

from __future__ import annotations

import io
import math
import os
import re
from collections.abc import Callable
from dataclasses import replace
from itertools import takewhile
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from omtwarp.colors import to_linear, to_srgb
from omtwarp.errors import OmtwarpError
from omtwarp.files.inputs import file_beside, read_bytes, reading
from omtwarp.files.limits import LARGEST_MESH_FILE, MOST_FACES
from omtwarp.mesh.arrays import TINY, Bytes, Floats, Ints, marked, whole_numbers
from omtwarp.mesh.ply import Column, ply_columns, polygons_of
from omtwarp.mesh.polygons import fans, taken_together
from omtwarp.mesh.read import coordinates, mesh_content, obj_corners, obj_text, read_mesh, utf8
from omtwarp.mesh.scenes import BRIGHTER, Document, gltf_pictures, load_scene, placed_meshes, scene_formats
from omtwarp.texturing.export import SLOTS, Material
from omtwarp.texturing.image import as_bytes, decoded, read_image, with_opacity, without_full_opacity
from omtwarp.texturing.painted import PaintedMesh, corners_of, joined_seams

if TYPE_CHECKING:
    import trimesh


# Names may hold the # that begins a comment elsewhere.
_STATEMENT = re.compile(
    rb"^[ \t]*(vt|v|f)[ \t]+([^\n#]*)|^[ \t]*(usemtl|mtllib|o|g)(?:[ \t]+([^\n]*))?$", flags=re.MULTILINE
)

# How many values the options of a picture in a material library take.
_OPTIONS = {
    "-blendu": 1, "-blendv": 1, "-boost": 1, "-mm": 2, "-o": 3, "-s": 3, "-t": 3, "-texres": 1, "-clamp": 1, "-bm": 1,
    "-imfchan": 1, "-type": 1,
}  # fmt: skip

_VALUE = r"[-+.0-9eE]+|on|off|[a-z]"


def _statements(data: bytes) -> tuple[NDArray[np.bytes_], list[bytes]]:
    """Return the kinds of an OBJ file's statements, shape [N], and what stands behind each."""
    statements = [(match[1] or match[3], match[2] or match[4] or b"") for match in _STATEMENT.finditer(obj_text(data))]
    return np.array([kind for kind, _ in statements], dtype="S6"), [rest for _, rest in statements]


def _named(kinds: NDArray[np.bytes_], rests: list[bytes], *names: bytes) -> tuple[list[tuple[str, ...]], Ints]:
    """Return what the last statements of some kinds say before each face: each once, and the number of every face's."""
    rows = np.arange(len(kinds))
    last = np.stack([np.maximum.accumulate(np.where(kinds == name, rows, -1)) for name in names], axis=1)
    places, which = np.unique(last[kinds == b"f"], axis=0, return_inverse=True)
    known: dict[tuple[str, ...], int] = {}
    numbers = []
    for place in places.tolist():  # in the order of the file
        said = tuple("" if row < 0 else rests[row].decode("utf-8", "replace").strip() for row in place)
        numbers.append(known.setdefault(said, len(known)))
    return [*known], np.array(numbers, dtype=np.int32)[which.reshape(-1)]


_PHONG = {name.lower(): name for name in ("Ns", "Ka", "Ks", "Ke", "Ni", "Tf", "illum")}


def read_mtl(text: str, picture: Callable[..., Bytes | None]) -> dict[str, Material]:
    """Read the materials of a library by name.

    Args:
        text: the library; bytes that are no UTF-8 as :func:`os.fsdecode` has them, so that names of files hold.
        picture: reads a picture by its name, None where there is none.
    """
    materials: dict[str, Material] = {}
    name = ""
    for line in text.splitlines():
        words = line.split()
        if not words or words[0].startswith("#"):
            continue
        key, values = words[0].lower(), words[1:]
        if key == "newmtl":
            name = " ".join(values).encode(errors="surrogateescape").decode(errors="replace")
            materials[name] = Material(name=name)
        elif name in materials:
            materials[name] = _with(materials[name], key, values, picture)
    for name, material in materials.items():
        if material.emission_picture is not None and "Ke" not in dict(material.phong):
            materials[name] = replace(material, emission=(1.0, 1.0, 1.0))  # the picture alone says what is sent out
    return materials


def _with(material: Material, key: str, values: list[str], picture: Callable[..., Bytes | None]) -> Material:
    """Apply one statement of a library to a material."""
    slot = {"map_kd": "picture", "norm": "normal_picture", "map_ke": "emission_picture"}.get(key)
    if slot is not None:
        return replace(material, **{slot: picture(*_picture_name(values))})  # type: ignore[arg-type]
    try:
        numbers = [float(word) for word in takewhile(lambda word: not word.startswith("#"), values)]
    except ValueError:
        return material
    if not numbers or not np.isfinite(numbers).all():
        return material
    red, green, blue = (min(max(number, 0.0), 1.0) for number in (numbers * 3)[:3])
    changes: dict[str, dict] = {
        "kd": {"color": (red, green, blue, material.color[3])},
        "d": {"color": (*material.color[:3], red)},
        "tr": {"color": (*material.color[:3], 1.0 - red)},
        "pr": {"roughness": red},
        "pm": {"metallic": red},
        "ke": {"emission": tuple(max(number, 0.0) for number in (numbers * 3)[:3])},
    }
    if key in _PHONG:
        changes.setdefault(key, {})["phong"] = tuple((dict(material.phong) | {_PHONG[key]: tuple(numbers)}).items())
    return replace(material, **changes.get(key, {}))


def _picture_name(words: list[str]) -> list[str]:
    """Return the file's name from the words after ``map_Kd``, and the options before it that move the picture."""
    rest, moved = list(words), []
    while rest and rest[0].lower() in _OPTIONS:
        option, values = rest.pop(0).lower(), list[str]()
        while len(values) < _OPTIONS[option] and len(rest) > 1 and re.fullmatch(_VALUE, rest[0]):
            values.append(rest.pop(0))
        usual = {"-s": {1.0}, "-o": {0.0}, "-t": {0.0}}.get(option)
        if usual is not None and not {float(value) for value in values if value[-1].isdigit()} <= usual:
            moved.append(option)
    return [" ".join(rest), *moved]


# Names under which programs write texture coordinates at the vertices of a PLY file.
_PLY_COORDINATES = (("s", "t"), ("u", "v"), ("texture_u", "texture_v"), ("texture_s", "texture_t"))


def read_painted_mesh(path: str | os.PathLike[str]) -> PaintedMesh:
    """Read a mesh with its texture coordinates, materials and colours.

    OBJ with its material library, PLY with coordinates at vertices or faces, and every format of scenes (GLB, glTF,
    COLLADA, ...) keep a pair of coordinates per corner and a material per triangle. Colours of a PLY's faces become the
    texels of a picture; those at vertices of an OBJ or PLY are white under a picture. Formats of scenes, and PLY with
    coordinates at its vertices, double vertices along seams: where boundaries have equal places, they are joined again.
    Several geometries of a scene are taken together. Formats without materials give a mesh with one, plain material.

    Args:
        path: a mesh file of any format that :func:`omtwarp.read_mesh` takes.

    Returns:
        The mesh; ``.export("name.glb")`` writes it again.

    Raises:
        OmtwarpError: what :func:`omtwarp.read_mesh` raises, or a picture that cannot be read.

    Example:
        >>> import omtwarp
        >>> surface = omtwarp.shapes.blob(seed=3, sphere=320)
        >>> result = omtwarp.map_to_sphere(surface, until="conformal", device="cpu")
        >>> _ = omtwarp.texture(result, pattern="checker", size=96).export("checker.glb")
        >>> mesh = omtwarp.read_painted_mesh("checker.glb")
        >>> mesh.uv.shape == (len(mesh.faces), 3, 2), mesh.materials[0].picture.shape
        (True, (64, 96, 3))
    """
    file = Path(path)
    data, suffix = mesh_content(file)
    plain = None if suffix in ("obj", "ply", *scene_formats()) else read_mesh(file)
    with reading(file, suffix, None):
        if plain is not None:
            painted = PaintedMesh(plain.vertices, corners_of(plain.faces, len(plain.vertices)), notes=plain.notes)
        elif suffix in ("obj", "ply"):
            painted = _pictures_alone((_from_obj if suffix == "obj" else _from_ply)(data, file))
        else:
            scene = load_scene(data, file, suffix)
            looks, notes = gltf_materials(data, file, suffix) if suffix in ("glb", "gltf") else (None, [])
            painted = _from_scene(scene, looks, notes)
    if len(painted.faces) > MOST_FACES:
        raise OmtwarpError(f"{file}: {len(painted.faces):,} triangles, and {MOST_FACES:,} is the most")
    return replace(painted, source_files=(file, *painted.source_files))


def read_objects(path: str | os.PathLike[str]) -> tuple[tuple[tuple[str, str], ...], Ints | None]:
    """Read the names of object and group of an OBJ file, and the number of these of every triangle, shape [F].

    Other formats have no names, and no numbers: None.

    Raises:
        OmtwarpError: the file cannot be read.
    """
    data, suffix = mesh_content(Path(path))
    if suffix != "obj":
        return (), None
    kinds, rests = _statements(data)
    objects, number = _named(kinds, rests, b"o", b"g")
    corners = np.array([len(rests[row].split()) for row in np.flatnonzero(kinds == b"f")], dtype=np.int64)
    return tuple((name, group) for name, group in objects), np.repeat(number, np.maximum(corners - 2, 0))


def _from_obj(data: bytes, file: Path) -> PaintedMesh:
    """Read an OBJ file and its material libraries."""
    kinds, rests = _statements(data)
    words = {kind: [rests[row].split() for row in np.flatnonzero(kinds == kind)] for kind in (b"v", b"vt", b"f")}
    points = coordinates(words[b"v"])
    split = [word.split(b"/") for face in words[b"f"] for word in face]
    counts = np.array([len(face) for face in words[b"f"]], dtype=np.int64)
    # How many points and coordinates stand before each corner, from which negative numbers count.
    ahead = [np.repeat(np.cumsum(kinds == kind)[kinds == b"f"], counts) for kind in (b"v", b"vt")]
    vertex = obj_corners([[word.partition(b"/")[0] for word in face] for face in words[b"f"]], ahead[0])
    rows, notes = fans(np.arange(len(vertex)), counts)
    face = np.repeat(np.arange(len(counts)), counts)[rows[:, 0]]
    which = np.array([int(parts[1]) if len(parts) > 1 and parts[1] else 0 for parts in split], dtype=np.int64)
    given = which != 0
    which = np.where(which < 0, which + ahead[1], which - 1)
    uv = _coordinates_at(which, given, words[b"vt"])[rows] if given.any() and words[b"vt"] else None
    named: list[Path] = []
    libraries = [rests[row].decode("utf-8", "surrogateescape").strip() for row in np.flatnonzero(kinds == b"mtllib")]
    known = _materials_beside(file, libraries, named, notes)
    names, used = _named(kinds, rests, b"usemtl")
    materials = tuple(known.get(name, Material(name or "material")) for (name,) in names)
    objects, number = _named(kinds, rests, b"o", b"g")
    return PaintedMesh(
        points, corners_of(vertex[rows], len(points)), uv, materials, used[face], _colors_behind(words[b"v"]),
        tuple(notes), source_files=tuple(named), objects=tuple((name, group) for name, group in objects),
        face_object=number[face],
    )  # fmt: skip


def _pictures_alone(mesh: PaintedMesh) -> PaintedMesh:
    """Make colours at vertices white under pictures, which glTF multiplies by them.

    Programs that show an OBJ or PLY file show either of the two, and scanners write the same colours as both.
    """
    if mesh.vertex_colors is None or mesh.uv is None:
        return mesh
    has_picture = np.array([material.picture is not None for material in mesh.materials])
    drawn = has_picture[mesh.material_of] & np.isfinite(mesh.uv).all(axis=(1, 2))
    if drawn.all():
        return replace(mesh, vertex_colors=None)
    under = marked(len(mesh.vertices), mesh.faces[drawn]) & ~marked(len(mesh.vertices), mesh.faces[~drawn])
    return replace(mesh, vertex_colors=np.where(under[:, None], np.uint8(255), mesh.vertex_colors))


def _materials_beside(file: Path, libraries: list[str], named: list[Path], notes: list[str]) -> dict[str, Material]:
    """Return the materials of libraries that a file names; both lists are added to."""
    picture = _pictures_beside(file, named, notes)
    known: dict[str, Material] = {}
    lines = [[name] if file_beside(file, name) else name.split() for name in libraries]  # one name, or several
    for library in (name for line in lines for name in line):
        there = file_beside(file, library)
        if there is None:
            notes.append(f"the material library '{library}' is not there")
        elif not there.stat().st_size:
            notes.append(f"the material library '{library}' is empty")
        else:
            named.append(there)
            known |= read_mtl(read_bytes(there, LARGEST_MESH_FILE).decode("utf-8", "surrogateescape"), picture)
    return known


def _coordinates_at(which: NDArray[np.int64], given: NDArray[np.bool_], rows: list[list[bytes]]) -> Floats:
    """Return the texture coordinates of all corners, NaN where none are given, shape [C, 2].

    Raises:
        OmtwarpError: a corner names coordinates that are not there.
    """
    table = np.array([[*row, b"0"][:2] for row in rows], dtype=np.float64)
    if which[given].max() >= len(table) or which[given].min() < 0:
        raise OmtwarpError(f"a face refers to texture coordinates {which[given].max() + 1} of {len(table)}")
    at_corner = np.full((len(which), 2), np.nan)
    at_corner[given] = table[which[given]]
    return at_corner


def _colors_behind(points: list[list[bytes]]) -> Bytes | None:
    """Return the colours that stand behind the coordinates of all vertices; None where some have none."""
    if not points or any(len(row) < 6 for row in points):
        return None
    given = np.array([row[3:6] for row in points], dtype=np.float64)
    return with_opacity(np.rint(np.clip(given * (255.0 if given.max() <= 1.0 else 1.0), 0, 255)).astype(np.uint8))


def _pictures_beside(file: Path, named: list[Path], notes: list[str]) -> Callable[..., Bytes | None]:
    """Return a function that reads a picture named in a file, None where there is none; both lists are added to."""

    def picture(name: str, *moved: str) -> Bytes | None:
        there = file_beside(file, name)
        notes.extend(f"left out {option} of the picture '{name}', which is not read" for option in moved)
        if there is None:
            notes.append(f"the picture '{name}' is not there")
            return None
        named.append(there)
        return as_bytes(read_image(there))

    return picture


def _from_ply(data: bytes, file: Path) -> PaintedMesh:
    columns, decided = ply_columns(utf8(data))
    points, corners, sizes = polygons_of(columns)
    rows, notes = fans(np.arange(len(corners)), sizes)
    face = np.repeat(np.arange(len(sizes)), sizes)[rows[:, 0]]
    faces = corners_of(corners[rows], len(points))
    vertex, sides = columns["vertex"], columns.get("face", {})
    named: list[Path] = []
    header = data[: data.find(b"end_header")].decode("utf-8", "replace")
    names = re.findall(r"^[ \t]*comment[ \t]+TextureFile[ \t]+(\S.*?)\s*$", header, re.MULTILINE)
    pictures = list(map(_pictures_beside(file, named, notes), names))  # None for those that are missing
    uv, doubled = _ply_coordinates(vertex, sides, sizes, rows, faces)
    colors, of_faces = _ply_colors(vertex), _ply_colors(sides)
    if of_faces is not None and (colors is not None or uv is not None):
        notes.append("left out the colours of faces: the file has texture coordinates, or colours at vertices")
    elif of_faces is not None and len(faces):
        palette, uv = _palette(of_faces[face])
        pictures = [palette]
    number = np.zeros(len(faces), dtype=np.int32)
    if len(pictures) > 1 and "texnumber" in sides:
        named_picture = whole_numbers(_numbers(sides["texnumber"])[face], "'texnumber'", (None,))
        number = np.clip(named_picture, 0, len(pictures) - 1).astype(np.int32)
    materials = tuple(Material(f"material-{k}", picture=one) for k, one in enumerate(pictures)) or (Material(),)
    mesh = PaintedMesh(points, faces, uv, materials, number, colors, (*decided, *notes), source_files=tuple(named))
    return joined_seams(mesh) if doubled else mesh


def _ply_coordinates(
    vertex: dict[str, Column], sides: dict[str, Column], sizes: NDArray, rows: NDArray, faces: Ints
) -> tuple[Floats | None, bool]:
    """Return the texture coordinates of a PLY file's triangles, shape [F, 3, 2], and whether they are its vertices'.

    Args:
        vertex: columns of the vertices.
        sides: columns of the polygons.
        sizes: how many corners each polygon has.
        rows: which of the polygons' corners are a triangle's, shape [F, 3].
        faces: the vertices there.
    """
    listed = sides.get("texcoord")
    pair = next((pair for pair in _PLY_COORDINATES if set(pair) <= set(vertex)), None)
    if isinstance(listed, tuple) and np.array_equal(listed[0], 2 * sizes):
        return np.asarray(listed[1], dtype=np.float64).reshape(-1, 2)[rows], False
    if pair is not None:
        return np.stack([_numbers(vertex[name]) for name in pair], axis=1)[faces], True
    return None, False


def _ply_colors(columns: dict[str, Column]) -> Bytes | None:
    """Return the colours of a PLY file's vertices or polygons with their opacity, shape [N, 4], None without any."""
    if not {"red", "green", "blue"} <= set(columns):
        return None
    channels = [name for name in ("red", "green", "blue", "alpha") if name in columns]
    values = np.stack([_numbers(columns[name]) for name in channels], axis=1)
    scale = 255.0 if np.asarray(columns["red"]).dtype.kind == "f" and values.max(initial=0.0) <= 1.0 else 1.0
    return with_opacity(np.rint(np.clip(values * scale, 0, 255)).astype(np.uint8))


def _palette(colors: Bytes) -> tuple[Bytes, Floats]:
    """Return a picture with a texel of every colour, and the texels of triangles as their corners' coordinates.

    Args:
        colors: of the triangles, with opacity, shape [F, 4].

    Returns:
        Shapes [N, N, 3 or 4], and [F, 3, 2] with the middle of a texel at all corners of a triangle.
    """
    known, texel = np.unique(colors, axis=0, return_inverse=True)
    side = math.ceil(math.sqrt(len(known)))
    row, column = np.divmod(texel.reshape(-1), side)
    middle = np.stack([column + 0.5, side - 0.5 - row], axis=1) / side
    return without_full_opacity(np.resize(known, (side, side, 4))), np.repeat(middle[:, None], 3, axis=1)


def _numbers(column: Column) -> Floats:
    """Return the values of a PLY property that holds one number per row.

    Raises:
        ValueError: it is a list.
    """
    if isinstance(column, tuple):
        raise ValueError("a list where one number belongs")
    return np.asarray(column, dtype=np.float64)


def _from_scene(scene: trimesh.Scene, looks: list[Material] | None, notes: list[str]) -> PaintedMesh:
    """Take all geometries of a scene together, where the scene puts them.

    Args:
        scene: of trimesh's.
        looks: the materials of a glTF file, whose colours at vertices are linear; None for other formats.
        notes: what was lost of them, in words.
    """
    placed = placed_meshes(scene)
    if not placed:
        raise OmtwarpError("not a triangle mesh: no triangles in it")
    materials: dict[int, Material] = {}
    uvs, which, colors, colored = [], [], [], False
    for _, one, points, triangles in placed:
        material, uv, color = _appearance(one, looks)
        key = id(getattr(one.visual, "material", one))
        materials.setdefault(key, material)
        uvs.append(np.full((len(triangles), 3, 2), np.nan) if uv is None else uv[triangles])
        which.append(np.full(len(triangles), list(materials).index(key), dtype=np.int32))
        colors.append(np.full((len(points), 4), 255, np.uint8) if color is None else color)
        colored = colored or color is not None
    uv_all = np.concatenate(uvs)
    points, triangles = taken_together([one[2:] for one in placed])
    uv, tints = None if np.isnan(uv_all).all() else uv_all, np.concatenate(colors) if colored else None
    notes = [*notes, *([f"took {len(placed)} geometries together"] if len(placed) > 1 else [])]
    faces, numbers = triangles.astype(np.int32), np.concatenate(which)
    return joined_seams(PaintedMesh(points, faces, uv, tuple(materials.values()), numbers, tints, tuple(notes)))


def gltf_materials(data: bytes, file: Path, suffix: str) -> tuple[list[Material], list[str]]:
    """Read the materials of a glTF file, in its order, and what is lost of them in words.

    Raises:
        OmtwarpError: a picture cannot be read, or is elsewhere than in the file's directory.
    """
    # By the identity of their content, which several materials may have, and the opacity from which texels are opaque.
    known: dict[tuple[int, float | None], Bytes] = {}

    def picture(content: bytes, least: float | None = None) -> Bytes:
        key = id(content), least
        if key not in known:
            whole = as_bytes(decoded(io.BytesIO(content), "a picture in it")) if least is None else picture(content)
            if least is not None and whole.shape[2] == 4:
                opacity = np.where(whole[..., 3:] < 255.0 * least, np.uint8(0), np.uint8(255))
                whole = without_full_opacity(np.concatenate([whole[..., :3], opacity], axis=2))
            known[key] = whole
        return known[key]

    materials = []
    described, lost = gltf_pictures(data, file, suffix)
    for material, pictures in described:
        cut = {"OPAQUE": 0.0, "MASK": float(material.get("alphaCutoff", 0.5))}.get(material.get("alphaMode", "OPAQUE"))
        least = None if cut is None else cut / max(_factor(material)[3], TINY)
        by_role = {role: picture(one, least if role == "baseColorTexture" else None) for role, one in pictures.items()}
        materials.append(_of_gltf(material, by_role, least))
    return materials, lost


def _appearance(mesh: trimesh.Trimesh, looks: list[Material] | None) -> tuple[Material, Floats | None, Bytes | None]:
    """Return the material, texture coordinates [V, 2] and colours [V, 4] of a mesh that trimesh read.

    Args:
        mesh: of trimesh's.
        looks: the materials of a glTF file, by whose numbers trimesh's are called; None for other formats.
    """
    from trimesh.visual import ColorVisuals, TextureVisuals  # heavy, and loaded by whoever has a mesh of trimesh's

    visual = mesh.visual
    kind = getattr(visual, "kind", None)
    if kind == "vertex" and isinstance(visual, ColorVisuals):
        colors = with_opacity(np.asarray(visual.vertex_colors, dtype=np.uint8))
        if looks is not None:
            colors[:, :3] = np.rint(255.0 * to_srgb(colors[:, :3] / 255.0))
        return Material(), None, colors
    if kind == "face" and isinstance(visual, ColorVisuals):
        return Material(color=_color(np.asarray(visual.main_color) / 255.0)), None, None
    if kind != "texture" or not isinstance(visual, TextureVisuals):
        return Material(), None, None
    source, uv = visual.material, visual.uv
    coordinates = np.asarray(uv, dtype=np.float64)[:, :2] if uv is not None and len(uv) == len(mesh.vertices) else None
    name = str(getattr(source, "name", None) or "material")
    if not hasattr(source, "baseColorFactor"):  # of formats older than glTF
        diffuse = np.asarray(getattr(source, "diffuse", (255, 255, 255, 255)), dtype=np.float64) / 255.0
        return Material(name, _color(diffuse)), coordinates, None
    if looks is not None and name.isdecimal() and int(name) < len(looks):
        return looks[int(name)], coordinates, _vertex_colors(mesh)
    names = ("metallicFactor", "roughnessFactor", "emissiveFactor", "doubleSided")
    known = {word: value for word in names if (value := getattr(source, word)) is not None} | {"name": name}
    if source.baseColorFactor is not None:  # which trimesh rounds to bytes
        known["baseColorFactor"] = source.baseColorFactor / 255.0
    return _of_gltf(known | {"pbrMetallicRoughness": known}, {}), coordinates, _vertex_colors(mesh)


def _factor(material: Document) -> Floats:
    """Return the colour and opacity that multiply a glTF material's picture, linear, shape [4]."""
    given = material.get("pbrMetallicRoughness", {}).get("baseColorFactor", ())
    return np.asarray(given if len(given) == 4 else (1.0, 1.0, 1.0, 1.0), dtype=np.float64)


def _of_gltf(material: Document, pictures: dict[str, Bytes], least: float | None = None) -> Material:
    """Return a material that is described in the terms of glTF.

    Args:
        material: its entry.
        pictures: by the names of their roles.
        least: the opacity from which a texel is opaque, and below which it is clear; None where it counts as it is.
    """
    surface, scaled = material.get("pbrMetallicRoughness", {}), _factor(material)
    color = _color(np.append(to_srgb(scaled[:3]), scaled[3] if least is None else float(least <= 1.0)))
    picture = pictures.get("baseColorTexture")
    if picture is not None and picture.shape[:2] == (1, 1):  # one texel is a plain colour, which needs no coordinates
        texel = with_opacity(picture[0]) / 255.0
        light = to_linear(np.array(color[:3])) * to_linear(texel[0, :3])
        color, picture = _color(np.append(to_srgb(light), color[3] * texel[0, 3])), None
    brighter = material.get("extensions", {}).get(BRIGHTER, {}).get("emissiveStrength", 1.0)
    red, green, blue = (float(light) * float(brighter) for light in material.get("emissiveFactor", (0.0, 0.0, 0.0)))
    return Material(
        name=material.get("name") or "material",
        color=color,
        metallic=float(surface.get("metallicFactor", 1.0)),
        roughness=float(surface.get("roughnessFactor", 1.0)),
        emission=(red, green, blue),
        two_sided=bool(material.get("doubleSided")),
        **{own: pictures.get(slot) for slot, own, *_ in SLOTS} | {"picture": picture},  # type: ignore[arg-type]
    )


def _vertex_colors(mesh: trimesh.Trimesh) -> Bytes | None:
    """Return the colours at the vertices of a glTF primitive with a material, shape [V, 4].

    In the file they are linear.
    """
    given = getattr(mesh.visual, "vertex_attributes", {}).get("color")
    if given is None or np.ndim(given) != 2 or len(given) != len(mesh.vertices) or given.shape[1] not in (3, 4):
        return None
    most = np.iinfo(given.dtype).max if given.dtype.kind in "iu" else 1.0
    light = np.clip(np.asarray(given, dtype=np.float64) / most, 0.0, 1.0)
    return with_opacity(np.rint(255.0 * np.column_stack([to_srgb(light[:, :3]), light[:, 3:]])).astype(np.uint8))


def _color(values: NDArray) -> tuple[float, float, float, float]:
    red, green, blue, *rest = np.clip(np.asarray(values, dtype=np.float64), 0.0, 1.0)
    return float(red), float(green), float(blue), float(rest[0]) if rest else 1.0
