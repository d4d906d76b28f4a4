"""Hostile things to read: pipes, devices, bombs, cut and compressed files, each one line and none a hang."""

from __future__ import annotations

import io
import json
import os
import struct
import subprocess
import sys
import threading
import time
import warnings
import zipfile

import numpy as np
import pytest
from generator import ascii_ply, ascii_stl
from PIL import Image

from omtwarp.errors import OmtwarpError
from omtwarp.files import limits
from omtwarp.files.inputs import read_bytes
from omtwarp.maps.result import MapResult
from omtwarp.mesh import shapes
from omtwarp.mesh.read import read_mesh
from omtwarp.mesh.validate import check
from omtwarp.mesh.write import write_mesh
from omtwarp.render import film, preview
from omtwarp.texturing import make_atlas, read_image
from omtwarp.texturing.read import read_painted_mesh

BALL = shapes.icosphere(3)
posix = pytest.mark.skipif(os.name != "posix", reason="of POSIX")
READERS = {
    "mesh.ply": read_mesh,
    "mesh.obj": read_mesh,
    "mesh.glb": read_mesh,
    "mesh.gii": read_mesh,
    "mesh.npz": read_mesh,
    "map.npz": MapResult.load,
    "drawn.obj": preview,
    "drawn.npz": preview,
    "picture.png": read_image,
}


def error_of(action) -> str:
    with pytest.raises(OmtwarpError) as caught:
        action()
    assert "\n" not in str(caught.value)
    return str(caught.value)


@posix
@pytest.mark.parametrize("name", READERS)
def test_what_has_no_end_is_not_read(tmp_path, name):
    os.mkfifo(tmp_path / name)
    (tmp_path / f"zero-{name}").symlink_to("/dev/zero")
    for bad in (tmp_path / name, tmp_path / f"zero-{name}"):
        assert f"{bad}: a pipe or device" in error_of(lambda bad=bad: READERS[name](bad))


@pytest.mark.parametrize("name", READERS)
def test_what_is_no_file_is_one_line(tmp_path, name, monkeypatch):
    read = READERS[name]
    (tmp_path / f"folder-{name}").mkdir()
    (tmp_path / f"empty-{name}").write_bytes(b"")
    (tmp_path / name).write_bytes(b"x" * 5000)
    assert "a directory" in error_of(lambda: read(tmp_path / f"folder-{name}"))
    assert "an empty file" in error_of(lambda: read(tmp_path / f"empty-{name}"))
    assert "no such file" in error_of(lambda: read(tmp_path / f"none-{name}"))
    assert "no such file" in error_of(lambda: read(tmp_path / name / name))
    assert "cannot be read: File name too long" in error_of(lambda: read(tmp_path / ("a" * 300 + name)))
    readers = ("texturing.read", "mesh.read", "mesh.scenes", "maps.result")
    for module in (f"omtwarp.{reader}" for reader in readers):
        monkeypatch.setattr(f"{module}.LARGEST_MESH_FILE", 4000)
    monkeypatch.setattr("omtwarp.texturing.image.LARGEST_PICTURE_FILE", 4000)
    assert "5.0 kB, and a " in error_of(lambda: read(tmp_path / name))


def test_limits_fit_real_work():
    """The limits allow a map of two million triangles, the largest Blue Marble and a minute of film in HD."""
    triangles, vertices = 2_000_000, 1_000_000
    arrays = vertices * 8 * (3 * 5 + 1) + triangles * (3 * 8 + 8)
    assert 10 * arrays < limits.LARGEST_ARRAYS and triangles * 10 < limits.MOST_FACES
    assert 21600 * 10800 < limits.MOST_TEXELS and max(21600, 10800) < limits.LONGEST_SIDE
    assert 60 * 16 * 1920 * 1080 < limits.MOST_FILM_PIXELS


def test_a_report_longer_than_its_limit_is_not_read(tmp_path, monkeypatch):
    """LARGEST_REPORT: a map's text is refused by the length that its header names, and arrays of numbers are not."""
    path = tmp_path / "map.npz"
    result = MapResult(BALL.vertices, BALL.faces, BALL.vertices, BALL.vertices, np.ones(BALL.vertex_count))
    result.report["warnings"] = [{"kind": "area-distortion", "where": -1, "text": "x" * 20_000}]
    result.save(path)
    assert MapResult.load(path).report["warnings"][0]["text"] == "x" * 20_000
    monkeypatch.setattr("omtwarp.files.inputs.LARGEST_REPORT", 10_000)
    read = []
    monkeypatch.setattr("omtwarp.maps.result.json.loads", read.append)
    words = error_of(lambda: MapResult.load(path))
    assert "map.npz" in words and "kB of text, and 10.0 kB is the most" in words and not read


@pytest.mark.parametrize("suffix", ["ply", "obj", "off", "stl", "glb", "npz"])
def test_a_mesh_of_more_triangles_than_its_limit_is_refused(tmp_path, monkeypatch, suffix):
    """MOST_FACES: said with the number, before the mesh is checked, mapped or drawn; as many as the limit are taken."""
    path = tmp_path / f"mesh.{suffix}"
    if suffix == "npz":
        np.savez(path, vertices=BALL.vertices, faces=BALL.faces)
    else:
        write_mesh(path, BALL.vertices, BALL.faces)
    modules = ("omtwarp.mesh.read", "omtwarp.texturing.read")
    for most in (BALL.face_count, BALL.face_count - 1):
        for module in modules:
            monkeypatch.setattr(f"{module}.MOST_FACES", most)
        for read in (read_mesh, read_painted_mesh):
            if most == BALL.face_count:
                assert len(read(path).faces) == most
            else:
                assert error_of(lambda read=read: read(path)) == f"{path}: 180 triangles, and 179 is the most"


def test_pictures_of_more_texels_than_their_limit_are_refused(monkeypatch):
    """MOST_TEXELS: of textures before they are made, of pictures before they are decoded."""
    for name, size in (("equirectangular", (64, 64)), ("cube", 96), ("octahedral", 64)):
        with monkeypatch.context() as limited:
            limited.setattr("omtwarp.texturing.atlas.MOST_TEXELS", 64 * 96)
            atlas = make_atlas(name, size)
            limited.setattr("omtwarp.texturing.atlas.MOST_TEXELS", atlas.width * atlas.height - 1)
            assert "is the most" in error_of(lambda name=name, size=size: make_atlas(name, size))
    picture = Image.new("RGB", (40, 20))
    monkeypatch.setattr("omtwarp.texturing.image.MOST_TEXELS", 800)
    assert read_image(picture).shape[:2] == (20, 40)
    monkeypatch.setattr("omtwarp.texturing.image.MOST_TEXELS", 799)
    monkeypatch.setattr(Image.Image, "convert", None)  # would decode it
    assert "may have 0 million at most" in error_of(lambda: read_image(picture))


@pytest.mark.parametrize("suffix", ["gif", "webp"])
def test_films_of_more_pixels_than_their_limit_are_refused_before_a_frame_is_drawn(tmp_path, monkeypatch, suffix):
    """MOST_FILM_PIXELS: of films of maps and of turning views, with how many frames were asked for."""
    result = MapResult(BALL.vertices, BALL.faces, BALL.vertices, BALL.vertices, np.ones(BALL.vertex_count))
    monkeypatch.setattr("omtwarp.render.films.MOST_FILM_PIXELS", 16 * 16 * 20 - 1)
    monkeypatch.setattr("omtwarp.render.films._Studio", None)  # would draw
    target, size = tmp_path / f"film.{suffix}", (16, 16)
    words = error_of(lambda: film(result, target, size=size, seconds=2.0, fps=10, backend="warp"))
    assert words.startswith("a film of 20 frames of 16 x 16 pixels is more than the ")
    monkeypatch.setattr("omtwarp.render.pictures.MOST_FILM_PIXELS", 16 * 16 * 20 - 1)
    monkeypatch.setattr("omtwarp.render.pictures.render", None)
    assert "in all is the most" in error_of(lambda: preview(result, target, size=size, frames=20, backend="warp"))
    assert not list(tmp_path.iterdir())


def bomb(path, content: dict[str, bytes]) -> None:
    """An archive whose entries inflate to much more than they take."""
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in content.items():
            archive.writestr(name, data)


def npy(shape, dtype="<f8", data: bytes = b"") -> bytes:
    """An array's file with a header that promises what it may not keep."""
    stream = io.BytesIO()
    np.lib.format.write_array_header_1_0(stream, {"shape": shape, "fortran_order": False, "descr": dtype})
    return stream.getvalue() + data


@pytest.mark.parametrize("load", [MapResult.load, read_mesh, preview])
def test_archives_that_inflate_or_lie(tmp_path, monkeypatch, load):
    path = tmp_path / "map.npz"
    names = ("vertices", "faces", "sphere", "conformal", "density", "report")
    monkeypatch.setattr("omtwarp.files.inputs.LARGEST_ARRAYS", 2**22)
    bomb(path, {f"{name}.npy": npy((2**19,), data=bytes(2**22)) for name in names})
    assert os.path.getsize(path) < 50_000
    assert "inflate to" in error_of(lambda: load(path))
    bomb(path, {f"{name}.npy": npy((2**60, 3)) for name in names})
    assert "not as long as its header says" in error_of(lambda: load(path))
    bomb(path, {f"{name}.npy": npy((4, 3), "|O", b"cos\nsystem\n(S'exit 3'\ntR.") for name in names})
    assert "not an array of numbers" in error_of(lambda: load(path))


@pytest.mark.parametrize("load", [MapResult.load, read_mesh])
def test_archives_with_endless_lists_of_arrays(tmp_path, load):
    path = tmp_path / "map.npz"
    bomb(path, {f"{k}{'a' * 60_000}": b"" for k in range(20)})
    assert "list of arrays has 1.2 MB" in error_of(lambda: load(path))
    # The records of an archive with more than 65,535 entries: the list's length stands in the wide one.
    wide = b"PK\6\6" + (44).to_bytes(8, "little") + bytes(12) + (2**33).to_bytes(8, "little") * 3 + bytes(8)
    locator = b"PK\6\7" + bytes(16)
    end = b"PK\5\6" + bytes(18)
    path.write_bytes(b"PK\3\4" + bytes(60) + wide + locator + end)
    assert "list of arrays has 8.6 GB" in error_of(lambda: load(path))
    path.write_bytes(b"PK\3\4" + bytes(90) + locator + end)
    assert "not where it should be" in error_of(lambda: load(path))


def test_an_array_that_is_not_asked_for_is_not_inflated(tmp_path, monkeypatch):
    """An array that no reader asks for is not inflated, whatever it holds."""
    monkeypatch.setattr("omtwarp.files.inputs.LARGEST_ARRAYS", 2**20)
    path = tmp_path / "mesh.npz"
    np.savez(path, vertices=BALL.vertices, faces=BALL.faces, other=np.zeros(2**19))
    assert len(read_mesh(path).faces) == len(BALL.faces)


def png_of(width: int, height: int) -> bytes:
    """Make a PNG file whose header gives a size and which holds no pixels."""
    import zlib

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    head = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IDAT", zlib.compress(b"")) + chunk(b"IEND", b"")


def test_pictures_that_are_too_large_are_refused_before_they_are_decoded(tmp_path):
    for width, height, words in ((40000, 10, "longer than 32768"), (20000, 20000, "268 million at most")):
        (tmp_path / "large.png").write_bytes(png_of(width, height))
        start = time.perf_counter()
        assert words in error_of(lambda: read_image(tmp_path / "large.png"))
        assert time.perf_counter() - start < 1.0


def test_a_large_picture_of_the_earth_is_read_without_a_word(tmp_path):
    """A picture with more pixels than Pillow's limits is read without a warning or an error."""
    Image.new("1", (21600, 10800)).save(tmp_path / "marble.png")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        stream = open(tmp_path / "marble.png", "rb")
        from omtwarp.files.inputs import open_picture

        with stream, open_picture(stream) as opened:
            assert opened.size == (21600, 10800)
    limit = Image.MAX_IMAGE_PIXELS
    assert limit is not None and 21600 * 10800 > 2 * limit


@pytest.mark.parametrize("name", ["postscript.eps", "postscript.png"])
def test_no_program_of_the_system_is_started_for_a_picture(tmp_path, name):
    (tmp_path / name).write_bytes(b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 10 10\n%%EndComments\n%%EOF\n")
    assert "not a picture in a format that can be read" in error_of(lambda: read_image(tmp_path / name))


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"frames": 10**9}, "3600 frames"),
        ({"frames": 3600, "size": (8192, 8192)}, "million pixels in all"),
        ({"frames": 3, "fps": float("inf")}, "frames per second"),
        ({"frames": 3, "fps": 1e-300}, "frames per second"),
        ({"frames": 3, "fps": float("nan")}, "frames per second"),
    ],
)
def test_films_have_a_ceiling(tmp_path, options, words):
    given = {"size": (16, 16), "backend": "warp"} | options
    assert words in error_of(lambda: preview((BALL.vertices, BALL.faces), tmp_path / "film.gif", **given))


def cut_short(path, share: float) -> None:
    data = path.read_bytes()
    path.write_bytes(data[: int(share * len(data))])


@pytest.mark.parametrize("share", [0.02, 0.3, 0.7, 0.97])
@pytest.mark.parametrize("name", ["a.ply", "text.ply", "a.off", "a.stl", "text.stl", "a.glb"])
def test_files_that_are_cut_short_say_so(tmp_path, name, share):
    path = tmp_path / name
    if name.startswith("text"):
        path.write_bytes((ascii_ply if name.endswith("ply") else ascii_stl)(BALL.vertices, BALL.faces))
    else:
        write_mesh(path, BALL.vertices, BALL.faces)
    cut_short(path, share)
    words = error_of(lambda: read_mesh(path))
    assert "cut short" in words or (share == 0.02 and "cannot be read as" in words), words


def test_numbers_with_letters_in_them_are_not_taken_for_others(tmp_path):
    text = ascii_ply(BALL.vertices, BALL.faces)
    place = text.index(b"end_header") + 20
    (tmp_path / "a.ply").write_bytes(text[:place] + b"x" + text[place:])
    assert "letters or signs among its numbers" in error_of(lambda: read_mesh(tmp_path / "a.ply"))


def glb(header: dict) -> bytes:
    text = json.dumps(header).encode()
    text += b" " * (-len(text) % 4)
    return struct.pack("<4sIIII", b"glTF", 2, 20 + len(text), len(text), 0x4E4F534A) + text


@pytest.mark.parametrize("name", ["KHR_draco_mesh_compression", "EXT_meshopt_compression"])
def test_compressed_geometry_is_named(tmp_path, name):
    header = {"asset": {"version": "2.0"}, "extensionsRequired": [name], "extensionsUsed": [name]}
    for path, content in ((tmp_path / "a.glb", glb(header)), (tmp_path / "a.gltf", json.dumps(header).encode())):
        path.write_bytes(content)
        assert f"needs {name}" in error_of(lambda path=path: read_mesh(path))


@posix
@pytest.mark.parametrize(
    "uri", ["/dev/zero", "../secret.bin", "pipe", "file:///etc/passwd", "https://example.org/a.bin"]
)
def test_a_scene_reads_only_files_beside_it(tmp_path, uri):
    (tmp_path / "secret.bin").write_bytes(bytes(36))
    (tmp_path / "inner").mkdir()
    os.mkfifo(tmp_path / "inner" / "pipe")
    position = {"bufferView": 0, "componentType": 5126, "count": 3, "type": "VEC3", "min": [0] * 3, "max": [0] * 3}
    header = {
        "asset": {"version": "2.0"},
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}}]}],
        "accessors": [position],
        "bufferViews": [{"buffer": 0, "byteLength": 36}],
        "buffers": [{"byteLength": 36, "uri": uri}],
    }
    (tmp_path / "inner" / "a.gltf").write_text(json.dumps(header))
    for read in (read_mesh, preview):
        assert "inner/a.gltf: " in error_of(lambda read=read: read(tmp_path / "inner" / "a.gltf"))
    (tmp_path / "inner" / "good.bin").write_bytes(np.eye(3, dtype="<f4").tobytes())
    header["buffers"][0]["uri"] = "good.bin"
    (tmp_path / "inner" / "a.gltf").write_text(json.dumps(header))
    assert len(read_mesh(tmp_path / "inner" / "a.gltf").vertices) == 3


def obj_text() -> str:
    rows = [f"v {x!r} {y!r} {z!r}" for x, y, z in BALL.vertices.tolist()]
    return "\n".join(rows + [f"f {a} {b} {c}" for a, b, c in (BALL.faces + 1).tolist()]) + "\n"


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16"])
def test_encodings_of_text_files(tmp_path, encoding):
    (tmp_path / "a.obj").write_bytes(obj_text().encode(encoding))
    mesh = read_mesh(tmp_path / "a.obj")
    np.testing.assert_array_equal(mesh.vertices, BALL.vertices)
    np.testing.assert_array_equal(mesh.faces, BALL.faces)


def test_a_file_that_grows_while_it_is_read_stays_within_its_limit(tmp_path):
    path = tmp_path / "growing"
    path.write_bytes(bytes(1000))
    stop = threading.Event()

    def grow():
        while not stop.is_set():
            with open(path, "ab") as stream:
                stream.write(bytes(10_000))

    thread = threading.Thread(target=grow)
    thread.start()
    try:
        for _ in range(20):
            try:
                assert len(read_bytes(path, 100_000)) <= 100_000
            except OmtwarpError as error:
                assert "may have" in str(error)
    finally:
        stop.set()
        thread.join()


ENDING = """
import atexit, os, signal, sys, time
signal.signal(signal.SIGINT, signal.default_int_handler)
def slow():
    print("ending", flush=True)
    time.sleep(30)
atexit.register(slow)
from omtwarp.commands._cli import main
sys.argv[1:] = ["--version"]
main()
"""


@posix
def test_an_interruption_while_the_process_ends_ends_it(tmp_path):
    """An interruption while the process exits gives no traceback and not the status of success."""
    process = subprocess.Popen([sys.executable, "-c", ENDING], stdout=-1, stderr=-1, text=True)
    try:
        assert process.stdout.readline().startswith("omtwarp")
        assert process.stdout.readline() == "ending\n"
        process.send_signal(2)
        _, err = process.communicate(timeout=20)
    finally:
        process.kill()
    assert process.returncode in (-2, 130) and err == ""


def test_a_hole_is_named_by_its_loop():
    """A defect names how many holes there are, the edges of the first one's loop, and a vertex on it."""
    ball = shapes.icosphere(6)
    beside = int(ball.face_neighbours[0].min())
    near = ball.faces[[0, beside]]
    far = next(k for k, face in enumerate(ball.faces) if face.min() > near.max())
    left = np.setdiff1d(np.arange(ball.face_count), [0, beside, far])
    (defect,) = check(ball.vertices, ball.faces[left])
    first = int(near.min())
    assert first < ball.faces[far].min()
    assert f"7 edges with one face, in 2 holes, the first a loop of 4 edges at vertex {first};" in str(defect)
    assert defect.where == first
    (defect,) = check(ball.vertices, np.delete(ball.faces, far, axis=0))
    assert f"in 1 hole, a loop of 3 edges at vertex {int(ball.faces[far].min())};" in str(defect)
