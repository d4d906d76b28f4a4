"""The textured surface in pictures, and its files as other programs read them."""

import io
import json
import os
import struct

import numpy as np
import pytest
import trimesh
from pattern_areas import cells
from PIL import Image
from texturing_shapes import ellipsoid, unit

from omtwarp.errors import OmtwarpError
from omtwarp.texturing import Material, PaintedMesh, pattern, texture
from omtwarp.texturing.atlas import LARGEST_UNASKED, sharp_size
from omtwarp.texturing.image import read_image, webp_bytes
from omtwarp.texturing.patterns.checker import Checker


@pytest.fixture(scope="module")
def surface():
    return ellipsoid(3, seed=3)


@pytest.fixture(scope="module")
def textured(surface):
    return texture(surface, pattern="circles", size=240)


# ------------------------------------------------------------------------------------------------ as it looks


def look(textured, axis, sign, pixels=220):
    """A parallel view along an axis in plain NumPy: image coordinates and true directions of the visible pixels.

    The shape is convex, so what faces the viewer is what is seen.
    """
    a, b = (axis + 1) % 3, (axis + 2) % 3
    corners = textured.vertices[textured.faces]
    p = corners[..., [a, b]] * [sign, 1.0]  # mirrored for the view from behind, so that it is not
    d, e = p[:, 1] - p[:, 0], p[:, 2] - p[:, 0]
    area = d[:, 0] * e[:, 1] - d[:, 1] * e[:, 0]
    facing = np.flatnonzero(area > 1e-12)
    half = np.abs(textured.vertices).max() * 1.02
    rows = []
    for f in facing:
        tri = (p[f] / half + 1.0) * 0.5 * pixels
        low, high = np.floor(tri.min(axis=0)).astype(int), np.ceil(tri.max(axis=0)).astype(int)
        x, y = (g.ravel() + 0.5 for g in np.meshgrid(np.arange(low[0], high[0]), np.arange(low[1], high[1])))
        (ax, ay), (bx, by), (cx, cy) = tri
        whole = (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)
        u = ((bx - x) * (cy - y) - (by - y) * (cx - x)) / whole
        v = ((cx - x) * (ay - y) - (cy - y) * (ax - x)) / whole
        inside = (u >= 0) & (v >= 0) & (u + v <= 1)
        if inside.any():
            w = np.column_stack([u, v, 1 - u - v])[inside]
            chord = textured.layout.cut.sphere[textured.faces[f]]
            rows.append((w @ textured.uv[f], unit(w @ chord)))
    return np.concatenate([r[0] for r in rows]), np.concatenate([r[1] for r in rows])


def bilinear(image, uv, wraps):
    """What a sampler without mip maps shows, in plain NumPy: v up, clamped or repeated in u, clamped in v."""
    height, width = image.shape[:2]
    x, y = uv[:, 0] * width - 0.5, (1 - uv[:, 1]) * height - 0.5
    column, row = np.floor(x).astype(int), np.floor(y).astype(int)
    s, t = (x - column)[:, None], (y - row)[:, None]

    def at(r, c):
        c = c % width if wraps else np.clip(c, 0, width - 1)
        return image[np.clip(r, 0, height - 1), c].astype(float)

    top = (1 - s) * at(row, column) + s * at(row, column + 1)
    return (1 - t) * top + t * ((1 - s) * at(row + 1, column) + s * at(row + 1, column + 1))


@pytest.mark.parametrize("atlas", ["equirectangular", "cube", "octahedral"])
@pytest.mark.parametrize("subdivisions", [1, 3])
def test_checker_from_six_sides(atlas, subdivisions):
    """No pixel differs from the analytic colour by more than filtering explains, seam and poles included.

    Filtering mixes what lies within about two texels; so each pixel's colour must lie between the extremes of the
    analytic colours around its direction. One triangle smeared across a seam would fail by thousands of pixels.
    """
    checker = Checker(12, 6)
    t = texture(ellipsoid(subdivisions, seed=subdivisions), pattern=checker, atlas=atlas, size=720, smooth=False)
    widest = {"equirectangular": 1.0, "cube": 1.0, "octahedral": 2.45}[atlas]  # largest texel to smallest
    checked = 0
    for axis in range(3):
        for sign in (1, -1):
            uv, direction = look(t, axis, sign, pixels=100)
            seen = bilinear(t.image, uv, t.wraps)
            side = unit(np.cross(direction, [0.31, 0.52, 0.8]))
            up = np.cross(direction, side)
            colours = [255 * checker(direction)]
            for reach in (0.8, 1.6, 2.6):
                for angle in np.arange(8) * np.pi / 4:
                    step = reach * widest * t.layout.atlas.texel_angle * (np.cos(angle) * side + np.sin(angle) * up)
                    colours.append(255 * checker(direction + step))
            low, high = np.min(colours, axis=0) - 2, np.max(colours, axis=0) + 2
            wrong = np.any((seen < low) | (seen > high), axis=1)
            assert not wrong.any(), f"{wrong.sum()} of {len(wrong)} pixels, first towards {direction[wrong][0]}"
            checked += len(wrong)
    assert checked > 15_000


def test_all_fields_of_the_checker_are_seen():
    """Every field of the checker appears on the surface, and the sphere's directions say which."""
    checker = pattern("checker", columns=8, rows=4)
    t = texture(ellipsoid(4, strength=0.3), pattern=checker, atlas="equirectangular", size=512)
    assert set(cells(checker, t.layout.cut.sphere)) == set(range(32))


def test_normals_do_not_show_the_seam(surface, textured):
    """Copies of a vertex have its one normal, that of the uncut mesh."""
    _, vertex, _ = textured.split()
    assert len(vertex) > len(textured.vertices)
    assert np.array_equal(textured.trimesh().vertex_normals, textured.normals[vertex])
    np.testing.assert_allclose(np.linalg.norm(textured.normals, axis=1), 1.0, atol=1e-12)
    whole = trimesh.Trimesh(surface[0], surface[1], process=False)
    first = textured.normals[: len(surface[0])]
    assert (first * whole.vertex_normals).sum(axis=1).min() > 0.999


@pytest.mark.parametrize("scale", [1e-30, 1e-3, 1e30])
def test_any_scale(surface, scale, tmp_path):
    vertices, faces, sphere = surface
    t = texture((vertices * scale, faces, sphere), pattern="checker", size=96)
    np.testing.assert_allclose(np.linalg.norm(t.normals, axis=1), 1.0)
    t.export(tmp_path / "a.glb")
    loaded = trimesh.load(tmp_path / "a.glb", force="mesh", process=False)
    np.testing.assert_allclose(loaded.extents, np.ptp(vertices, axis=0) * scale, rtol=1e-6)


# ------------------------------------------------------------------------------------------------ files


def test_glb_is_valid_and_carries_everything(textured, tmp_path):
    """Read by an independent library and by trimesh: structure, sampler, material, picture, geometry."""
    gltf = pytest.importorskip("pygltflib")
    (path,) = textured.export(tmp_path / "surface.glb")
    document = gltf.GLTF2().load(str(path))
    validator = pytest.importorskip("pygltflib.validator")
    validator.validate(document)  # raises on an invalid document
    blob = document.binary_blob()
    assert document.asset.version == "2.0" and len(blob) == document.buffers[0].byteLength
    for view in document.bufferViews:
        assert view.byteOffset % 4 == 0 and view.byteOffset + view.byteLength <= len(blob)

    def read(index):
        accessor = document.accessors[index]
        view = document.bufferViews[accessor.bufferView]
        kind = {5126: "<f4", 5125: "<u4"}[accessor.componentType]
        width = {"SCALAR": 1, "VEC2": 2, "VEC3": 3}[accessor.type]
        raw = np.frombuffer(blob, kind, accessor.count * width, view.byteOffset)
        return raw.reshape(-1, width) if width > 1 else raw

    primitive = document.meshes[0].primitives[0]
    position = read(primitive.attributes.POSITION)
    faces, vertex, own_uv = textured.split()
    np.testing.assert_array_equal(position, textured.vertices[vertex].astype(np.float32))
    np.testing.assert_array_equal(textured.vertices[vertex[faces]], textured.vertices[textured.faces])
    np.testing.assert_array_equal(own_uv[faces], textured.uv)
    accessor = document.accessors[primitive.attributes.POSITION]
    np.testing.assert_array_equal(np.float32(accessor.min), position.min(axis=0))
    np.testing.assert_array_equal(np.float32(accessor.max), position.max(axis=0))
    np.testing.assert_allclose(np.linalg.norm(read(primitive.attributes.NORMAL), axis=1), 1, atol=1e-6)
    uv = read(primitive.attributes.TEXCOORD_0)
    np.testing.assert_allclose(uv, np.column_stack([own_uv[:, 0], 1 - own_uv[:, 1]]), atol=1e-7)
    np.testing.assert_array_equal(read(primitive.indices).reshape(-1, 3), faces)
    assert read(primitive.indices).max() < len(position)

    material = document.materials[primitive.material]
    pbr = material.pbrMetallicRoughness
    assert (pbr.metallicFactor, pbr.roughnessFactor, pbr.baseColorFactor) == (0.0, 0.65, [1.0, 1.0, 1.0, 1.0])
    assert material.alphaMode == "OPAQUE"
    sampler = document.samplers[document.textures[pbr.baseColorTexture.index].sampler]
    assert (sampler.wrapS, sampler.wrapT) == (33071, 33071)
    view = document.bufferViews[document.images[0].bufferView]
    (tmp_path / "embedded.png").write_bytes(blob[view.byteOffset : view.byteOffset + view.byteLength])
    np.testing.assert_array_equal(read_image(tmp_path / "embedded.png"), textured.image)


def test_glb_in_trimesh(textured, tmp_path):
    """What a reader makes of it: the same coordinates, v up, and the same picture."""
    textured.export(tmp_path / "surface.glb")
    (loaded,) = trimesh.load(tmp_path / "surface.glb", process=False).geometry.values()
    assert loaded.faces.shape == textured.faces.shape
    faces, vertex, uv = textured.split()
    np.testing.assert_allclose(loaded.visual.uv, uv, atol=1e-6)
    np.testing.assert_array_equal(np.asarray(loaded.visual.material.baseColorTexture.convert("RGB")), textured.image)
    np.testing.assert_allclose(loaded.vertex_normals, textured.normals[vertex], atol=1e-3)
    own = textured.trimesh()
    assert np.array_equal(own.faces, faces) and np.array_equal(own.visual.uv, uv)


def test_pictures_of_sixteen_bits_are_turned_as_they_say(tmp_path):
    upright = np.random.default_rng(0).integers(0, 256, (8, 12)).astype(np.uint16) * 257
    tags = Image.Exif()
    tags[0x112] = 6  # turn clockwise to show
    Image.fromarray(np.rot90(upright).copy()).save(tmp_path / "deep.png", exif=tags)
    np.testing.assert_allclose(read_image(tmp_path / "deep.png")[..., 0], upright / 65535.0, atol=1e-7)


def test_webp_holds_the_same_texels(textured, tmp_path):
    """As another library reads them, which needs the extension: the file says so."""
    (path,) = textured.export(tmp_path / "surface.glb", texture_format="webp")
    loaded = trimesh.load(path, force="mesh", process=False)
    seen = np.asarray(loaded.visual.material.baseColorTexture.convert("RGB"))
    np.testing.assert_array_equal(seen, textured.image[..., :3])
    content = path.read_bytes()
    document = json.loads(content[20 : 20 + struct.unpack("<I", content[12:16])[0]])
    assert document["extensionsRequired"] == document["extensionsUsed"] == ["EXT_texture_webp"]
    assert document["textures"] == [{"sampler": 0, "extensions": {"EXT_texture_webp": {"source": 0}}}]
    view = document["bufferViews"][document["images"][0]["bufferView"]]
    start = 20 + struct.unpack("<I", content[12:16])[0] + 8 + view["byteOffset"]
    assert content[start : start + 4] == b"RIFF" and document["images"][0]["mimeType"] == "image/webp"
    with pytest.raises(OmtwarpError, match=r"WebP textures are for .glb"):
        textured.export(tmp_path / "surface.obj", texture_format="webp")
    clear = np.random.default_rng(0).integers(0, 256, (32, 48, 4)).astype(np.uint8)
    clear[:, :24, 3] = 0  # colours below transparent texels are kept too, as filters mix them with others
    np.testing.assert_array_equal(read_image(Image.open(io.BytesIO(webp_bytes(clear)))), clear)
    with pytest.raises(OmtwarpError, match="WebP holds 16383 texels a side"):
        webp_bytes(np.zeros((1, 16384, 3), dtype=np.uint8))


def test_without_a_size_no_texel_of_a_pattern_shows(surface):
    """Up to a limit; a picture has no fewer texels than it had."""
    vertices, faces, sphere = surface
    wanted = sharp_size(vertices, faces, sphere, "cube", LARGEST_UNASKED)[0]
    assert texture(surface, pattern="checker", smooth=False).image.shape[1::-1] == wanted
    found = texture(surface, np.zeros((200, 400, 3), dtype=np.uint8))
    assert found.image.shape[1::-1] == (512, 256)
    assert np.pi / 2 / found.layout.atlas.texel_angle >= 100  # as the picture has along a right angle of its equator


def test_glb_header_by_hand(textured, tmp_path):
    """Lengths in the header add up, chunks are padded as the format asks: spaces and zeros to a multiple of four."""
    textured.export(tmp_path / "surface.glb")
    raw = (tmp_path / "surface.glb").read_bytes()
    magic, version, length = struct.unpack_from("<4sII", raw)
    size, kind = struct.unpack_from("<I4s", raw, 12)
    size_2, kind_2 = struct.unpack_from("<I4s", raw, 20 + size)
    assert (magic, version, length) == (b"glTF", 2, len(raw))
    assert (kind, kind_2) == (b"JSON", b"BIN\0") and 28 + size + size_2 == len(raw)
    assert size % 4 == size_2 % 4 == 0


def test_equirectangular_repeats_around_and_clamps_at_the_poles(surface, tmp_path):
    gltf = pytest.importorskip("pygltflib")
    t = texture(surface, pattern="globe", atlas="equirectangular", size=128)
    t.export(tmp_path / "globe.glb")
    sampler = gltf.GLTF2().load(str(tmp_path / "globe.glb")).samplers[0]
    assert (sampler.wrapS, sampler.wrapT) == (10497, 33071)


def test_obj_mtl_and_png_agree(surface, textured, tmp_path):
    """The OBJ names the MTL, the MTL the PNG; vertices are the input's first; corners have the right coordinates."""
    files = textured.export(tmp_path / "a surface.obj")
    assert sorted(p.name for p in files) == ["a surface.obj", "a_surface.mtl", "a_surface.png"]
    text = (tmp_path / "a surface.obj").read_text()
    assert "mtllib a_surface.mtl\n" in text
    assert "map_Kd a_surface.png\n" in (tmp_path / "a_surface.mtl").read_text()
    np.testing.assert_array_equal(read_image(tmp_path / "a_surface.png"), textured.image)
    rows = {key: [] for key in ("v", "vt", "vn", "f")}
    for line in text.splitlines():
        key, *rest = line.split()
        if key in rows:
            rows[key].append(rest)
    v, vt = np.array(rows["v"], dtype=float), np.array(rows["vt"], dtype=float)
    corners = np.array([[c.split("/") for c in f] for f in rows["f"]], dtype=int) - 1
    np.testing.assert_allclose(v[: len(surface[0])], surface[0], rtol=1e-8, atol=1e-9)
    assert len(v) == len(rows["vn"]) and len(v) < len(vt) == len(textured.split()[1])
    np.testing.assert_allclose(v[corners[..., 0]], textured.vertices[textured.faces], rtol=1e-8, atol=1e-9)
    np.testing.assert_allclose(vt[corners[..., 1]], textured.uv, atol=1e-8)
    assert np.array_equal(corners[..., 0], corners[..., 2])
    welded = trimesh.Trimesh(v, corners[..., 0], process=False)
    assert welded.is_watertight, "an OBJ keeps the surface closed"
    loaded = trimesh.load(tmp_path / "a surface.obj", process=False)
    assert loaded.faces.shape == textured.faces.shape and loaded.visual.uv is not None
    assert loaded.visual.material.image.size == textured.pil().size


def test_ply_is_the_input_with_colours(surface, tmp_path):
    vertices, faces, sphere = surface
    picture = np.zeros((64, 128, 3), dtype=np.uint8)
    picture[:32] = [250, 120, 30]
    picture[32:] = [10, 60, 200]
    texture(surface, picture).export(tmp_path / "c.ply")
    loaded = trimesh.load(tmp_path / "c.ply", process=False)
    np.testing.assert_array_equal(loaded.vertices, vertices)
    np.testing.assert_array_equal(loaded.faces, faces)
    colours = loaded.visual.vertex_colors
    np.testing.assert_array_equal(colours[sphere[:, 2] > 0.1], [[250, 120, 30, 255]] * np.sum(sphere[:, 2] > 0.1))
    np.testing.assert_array_equal(colours[sphere[:, 2] < -0.1], [[10, 60, 200, 255]] * np.sum(sphere[:, 2] < -0.1))


def test_a_painted_mesh_has_what_a_texture_has(surface, tmp_path):
    """Colours at the vertices, from any corner there, and a mesh of trimesh's, where there is one picture."""
    vertices, faces, sphere = surface
    picture = np.full((16, 16, 3), (10, 60, 200), dtype=np.uint8)
    picture[:, 8:] = (250, 120, 30)
    uv = sphere[:, :2] * 0.5 + 0.5
    mesh = PaintedMesh(vertices, faces, uv, (Material("two", (1.0, 0.5, 1.0, 1.0), picture),))
    mesh.export(tmp_path / "c.ply")
    loaded = trimesh.load(tmp_path / "c.ply", process=False)
    np.testing.assert_array_equal(
        loaded.visual.vertex_colors[:, :3], np.where(uv[:, :1] < 0.5, picture[0, 0], picture[0, 8])
    )
    own = mesh.trimesh()
    np.testing.assert_array_equal(own.vertices, vertices)
    np.testing.assert_array_equal(own.visual.uv, uv)
    assert own.visual.material.baseColorFactor.tolist() == [255, 55, 255, 255]
    red = Material("red", (1, 0, 0, 1))
    two = PaintedMesh(vertices, faces, uv, (red, red), np.arange(len(faces)) % 2)
    with pytest.raises(OmtwarpError, match="one material, the mesh 2"):
        two.trimesh()
    for plain in (two, PaintedMesh(vertices, faces, uv, (red,))):
        with pytest.raises(OmtwarpError, match=r"use \.glb, \.obj"):
            plain.export(tmp_path / "d.ply")
    with pytest.raises(OmtwarpError, match="'red' has no picture"):
        PaintedMesh(vertices, faces, uv, (red,)).pil()


def test_export_is_the_same_twice(surface, tmp_path):
    for name in ("one.glb", "two.glb"):
        texture(surface, pattern="puzzle", size=120).export(tmp_path / name)
    assert (tmp_path / "one.glb").read_bytes() == (tmp_path / "two.glb").read_bytes()


def test_transparency_is_kept(surface, tmp_path):
    picture = np.full((32, 64, 4), 200, dtype=np.uint8)
    t = texture(surface, picture, atlas="equirectangular")
    assert t.image.shape[2] == 4
    t.export(tmp_path / "a.glb")
    assert b'"alphaMode":"BLEND"' in (tmp_path / "a.glb").read_bytes()
    picture[..., 3] = 255
    assert texture(surface, picture).image.shape[2] == 3


# ------------------------------------------------------------------------------------------------ choices and errors


def test_an_equirectangular_image_is_kept_to_the_byte(surface, tmp_path):
    """Also with the seam elsewhere: then its columns are shifted by a whole number and the coordinates with them."""
    picture = np.random.default_rng(0).integers(0, 256, (64, 128, 3), dtype=np.uint8)
    Image.fromarray(picture).save(tmp_path / "noise.png")
    plain = texture(surface, tmp_path / "noise.png", atlas="equirectangular")
    np.testing.assert_array_equal(plain.image, picture)
    moved = texture(surface, Image.fromarray(picture), atlas="equirectangular", seam_longitude=40.0)
    shift = round((40 - 180) / 360 * 128)
    np.testing.assert_array_equal(moved.image, np.roll(picture, -shift, axis=1))
    np.testing.assert_array_equal(moved.colors_at_vertices(), plain.colors_at_vertices())


def test_result_objects_tuples_and_defaults(surface):
    class Result:
        vertices, faces, sphere = surface

    one, two = texture(Result(), size=96), texture(surface, pattern="circles", size=96)
    assert np.array_equal(one.image, two.image) and one.layout.atlas.name == "cube"
    assert f"{len(one.vertices)} vertices" in repr(one) and len(one.layout.vertices) == 642


def test_the_least_visible_places_can_be_asked_for(surface):
    t = texture(surface, pattern="globe", atlas="equirectangular", seam_longitude="auto", size=64)
    assert -np.pi <= t.layout.atlas.seam <= np.pi
    turned = texture(surface, pattern="globe", atlas="equirectangular", rotate="auto", size=64)
    np.testing.assert_allclose(turned.layout.rotation @ [0, 0, 1], [0, 0, 1], atol=1e-12)
    expected = np.angle(np.exp(1j * (t.layout.atlas.seam - np.pi)))
    assert np.angle(turned.layout.rotation[0, 0] + 1j * turned.layout.rotation[1, 0]) == pytest.approx(expected)


def broken_files(folder):
    """Paths of things that are not pictures, and a word of the line that each must give."""
    (folder / "empty.png").write_bytes(b"")
    (folder / "text.png").write_text("not a picture\n")
    whole = folder / "whole.png"
    Image.fromarray(np.random.default_rng(0).integers(0, 256, (64, 64, 3), dtype=np.uint8)).save(whole)
    (folder / "cut.png").write_bytes(whole.read_bytes()[:2000])
    return [
        (folder / "missing.png", "no such file"),
        (folder / "empty.png", "empty"),
        (folder / "text.png", "not a picture"),
        (folder / "cut.png", "cannot be read"),
        (folder, "a directory"),
    ]


def test_what_is_no_image_is_refused_in_one_line(surface, tmp_path):
    for path, word in broken_files(tmp_path):
        with pytest.raises(OmtwarpError, match=word) as caught:
            texture(surface, path)
        assert "\n" not in str(caught.value) and path.name in str(caught.value)
    not_finite, too_bright = np.full((4, 4, 3), np.nan), np.full((4, 4, 3), 7.0)
    for array in (np.zeros((4, 4, 2)), np.zeros((0, 4, 3)), not_finite, too_bright, object()):
        with pytest.raises(OmtwarpError, match="image"):
            texture(surface, array)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"image": np.zeros((8, 16, 3)), "pattern": "checker"}, "both"),
        ({"pattern": "stripes"}, "unknown pattern"),
        ({"projection": "mercator"}, "unknown projection"),
        ({"atlas": "mercator"}, "unknown atlas"),
        ({"rotate": "left"}, "rotate"),
        ({"rotate": [10**400, 0, 0]}, "rotate"),
        ({"seam_longitude": 20.0}, "a seam is for the equirectangular atlas"),
        ({"seam_longitude": "auto", "atlas": "octahedral"}, "a seam is for the equirectangular atlas"),
        ({"seam_longitude": "east", "atlas": "equirectangular"}, "seam longitude"),
        ({"seam_longitude": np.nan, "atlas": "equirectangular"}, "seam longitude"),
        ({"size": 3}, "texture size"),
        ({"device": "gpu"}, "unknown device"),
    ],
)
def test_bad_options_are_named(surface, options, message):
    with pytest.raises(OmtwarpError, match=message):
        texture(surface, **options)


def test_bad_maps_are_named(surface):
    vertices, faces, sphere = surface
    broken = sphere.copy()
    broken[7] = np.nan
    centre = sphere.copy()
    centre[[3, 9]] = 0
    for bad, message in (
        (3, "cannot use a int"),
        ((vertices, faces, sphere[:-1]), r"the map: shape \[641, 3\]"),
        ((vertices, faces + 1, sphere), "642 in row 497 is out of range"),
        ((vertices, faces[:, :2], sphere), r"faces: shape \[1280, 2\]"),
        ((vertices, faces, broken), "3 numbers that are not finite, first in row 7"),
        ((vertices, faces, centre), "2 points .* first vertex 3"),
    ):
        with pytest.raises(OmtwarpError, match=message):
            texture(bad)


def test_nothing_is_left_behind_where_writing_fails(textured, tmp_path):
    with pytest.raises(OmtwarpError, match="there is no directory"):
        textured.export(tmp_path / "nowhere" / "a.glb")
    with pytest.raises(OmtwarpError, match=r"\.glb, \.obj"):
        textured.export(tmp_path / "a.stl")
    (tmp_path / "b.glb").mkdir()
    with pytest.raises(OmtwarpError, match="directory"):
        textured.export(tmp_path / "b.glb")
    assert os.listdir(tmp_path) == ["b.glb"]


def test_an_interrupt_while_writing_leaves_the_old_file(textured, tmp_path, monkeypatch):
    place = tmp_path / "a.glb"
    place.write_bytes(b"old")

    def interrupt(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(os, "replace", interrupt)
    with pytest.raises(KeyboardInterrupt):
        textured.export(place)
    assert place.read_bytes() == b"old" and os.listdir(tmp_path) == ["a.glb"]
