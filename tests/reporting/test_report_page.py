"""The report page: its text, its data, and that it needs no other file."""

from __future__ import annotations

import base64
import io
import json
import re
import zlib
from collections import defaultdict
from dataclasses import replace
from html.parser import HTMLParser

import numpy as np
import pytest
from PIL import Image

import omtwarp
from omtwarp.commands._cli import main
from omtwarp.errors import OmtwarpError
from omtwarp.mesh import shapes
from omtwarp.reporting import report_page, scene, write_report
from omtwarp.reporting.sections import _number
from omtwarp.reporting.stages import stages_of
from omtwarp.texturing.patterns import pattern


@pytest.fixture(scope="module")
def result():
    return omtwarp.map_to_sphere(shapes.demo_shape(2000), until="omt", device="cpu")


@pytest.fixture(scope="module")
def page(result):
    return report_page(result, title="A <b>creature</b> & more", up="z", picture_size=200, device="cpu")


@pytest.fixture
def text_only(monkeypatch):
    """No view and no pictures: for tests of the words."""
    monkeypatch.setattr("omtwarp.reporting.page.make_scene", lambda *a, **k: scene.Scene("{}", "", 1))
    monkeypatch.setattr("omtwarp.reporting.page._stills", lambda *a: defaultdict(lambda: "data:,"))


class Reader(HTMLParser):
    """Everything that a browser would load, the text of elements by id, and whether all elements are closed."""

    EMPTY = ("meta", "link", "img", "input", "br")

    def __init__(self, text: str):
        super().__init__()
        self.references, self.policy, self.texts, self.open = [], "", {}, []
        self.visible: list[str] = []
        self.feed(text)
        self.close()

    def handle_starttag(self, tag, attributes):
        given = dict(attributes)
        self.references += [given[name] for name in ("src", "href", "srcset", "action", "data") if name in given]
        if given.get("http-equiv") == "Content-Security-Policy":
            self.policy = given["content"]
        if tag not in self.EMPTY:
            self.open.append((tag, given.get("id")))

    def handle_startendtag(self, tag, attributes):
        pass

    def handle_endtag(self, tag):
        assert self.open.pop()[0] == tag

    def handle_data(self, data):
        tag, name = self.open[-1] if self.open else ("", None)
        if name:
            self.texts[name] = self.texts.get(name, "") + data
        if tag not in ("script", "style"):
            self.visible.append(data)


def test_page_needs_nothing_else(page):
    reader = Reader(page)
    assert not reader.open
    assert all(reference.startswith("data:") for reference in reader.references)
    assert "default-src 'none'" in reader.policy and "http" not in reader.policy
    style = page[page.index("<style>") : page.index("</style>")]
    assert "url(" not in style and "@import" not in style
    viewer = (scene.__file__).replace("scene.py", "assets/viewer.js")
    with open(viewer) as stream:
        code = stream.read()
    assert not re.search(r"\bfetch\(|XMLHttpRequest|import\(|https?:", code)
    assert len(page) < 3e6


def test_page_says_what_the_report_says(page, result):
    text = " ".join("".join(Reader(page).visible).split())
    assert "A <b>creature</b> & more" in text and "<b>creature</b>" not in page
    assert f"{len(result.vertices):,} vertices" in text
    for stage in stages_of(result):
        assert stage.label in text
        assert _number(stage.distortion.angle["surface"]).split(" ")[0] in text
    assert "Certified one to one" in text and "32 from the centre" in text
    assert "Cost of the transport" in text and "Histogram of area ratios" in text
    assert result.report["versions"]["scipy"] in text
    assert page.count("<polyline") == 1 and page.count('class="hill"') == 2 * len(stages_of(result))


def test_stages_are_the_maps_there_are(result, text_only):
    assert [stage.label for stage in stages_of(result)] == ["Conformal", "Optimal transport"]
    alone = replace(result, sphere=result.conformal, moser=None, transported=None, history=[])
    assert [stage.key for stage in stages_of(alone)] == ["conformal"]
    text = report_page(alone)
    assert "Cost of the transport" not in text and "carried to the surface by the map" in text
    other = replace(result, report={**result.report, "start": {"route": "hierarchical", "reason": "too thin"}})
    assert stages_of(other)[0].label == "Coarse-to-fine"


def test_a_flipped_map_is_not_called_one_to_one(result, text_only):
    sphere = result.sphere.copy()
    sphere[result.faces[7, 0]] *= -1
    certificate = {**result.report["certificate"], "bijective": False, "flips": 5, "first_flip": 7}
    flipped = replace(result, sphere=sphere, transported=None, report={**result.report, "certificate": certificate})
    text = report_page(flipped)
    assert "5 flipped triangles" in text and "the first is face 7" in text and "Certified" not in text


def test_a_map_from_elsewhere_is_certified_here(result, text_only):
    text = report_page(replace(result, report={}, history=[]))
    assert "Certified one to one" in text and "by exact orientation tests" in text


def test_optimality_and_start_are_told_where_they_are_known(result, text_only):
    optimality = {"relative_curl": 0.0123, "lower_bound": 1.234, "gap": 0.00045, "cost": 1.2345}
    start = {"route": "hierarchical", "reason": "the conformal map shrinks 3 triangles"}
    known = replace(result, report={**result.report, "optimality": optimality, "start": start})
    text = report_page(known)
    for words in ("1.23% of the displacement", "0.045% lower", "shrinks 3 triangles", "lower bound for any map"):
        assert words in text


def test_scene_data_are_the_mesh_and_its_maps(page, result):
    reader = Reader(page)
    header = json.loads(reader.texts["scene"])
    blob = zlib.decompress(base64.b64decode(reader.texts["scene-data"]))

    def array(name, kind):
        offset, count = header["arrays"][name]
        assert offset % 4 == 0
        return np.frombuffer(blob, kind, count, offset)

    np.testing.assert_array_equal(array("index", "<u4").reshape(-1, 3), result.faces)
    for key, sphere in (("conformal", result.conformal), ("omt", result.sphere)):
        directions = array(f"direction-{key}", "<i2").reshape(-1, 3) / 32767
        np.testing.assert_allclose(directions, sphere, atol=2e-5)
    placed = array("position", "<i2").reshape(-1, 3) / 32767
    assert np.linalg.norm(placed, axis=1).max() == pytest.approx(1.0, abs=1e-4)
    # z is up and the creature looks along x, so (x, y, z) became (y, z, x), moved and scaled.
    given = result.vertices[:, [1, 2, 0]]
    moved = given - 0.5 * (given.min(axis=0) + given.max(axis=0))
    np.testing.assert_allclose(placed, moved / np.linalg.norm(moved, axis=1).max(), atol=1e-4)
    turn = np.reshape(header["turn"], (3, 3))
    np.testing.assert_allclose(turn @ turn.T, np.eye(3), atol=1e-5)
    assert np.linalg.det(turn) == pytest.approx(1.0, abs=1e-5)
    area = array("area-omt", "u1") / 255 * 2 * header["area"]["range"] - header["area"]["range"]
    assert abs(np.median(area)) < 0.5


def test_cube_faces_show_the_pattern_where_opengl_looks_for_it():
    size = 64
    faces = [np.asarray(decode(uri)) for uri in scene.cube_faces(pattern("globe"), size, device="cpu")]
    rng = np.random.default_rng(3)
    directions = rng.normal(size=(4000, 3))
    directions /= np.linalg.norm(directions, axis=1)[:, None]
    # The viewer's shader makes the faces equiangular; then OpenGL's own rule (4.6, table 8.19) applies.
    largest = np.abs(directions).max(axis=1, keepdims=True)
    warped = np.arctan2(directions, largest) * 4 / np.pi
    x, y, z = warped.T
    axis = np.abs(directions).argmax(axis=1)
    positive = np.take_along_axis(directions, axis[:, None], 1)[:, 0] > 0
    sc = np.select([axis == 0, axis == 1], [np.where(positive, -z, z), x], np.where(positive, x, -x))
    tc = np.select([axis == 0, axis == 1], [-y, np.where(positive, z, -z)], -y)
    column = np.clip(((sc + 1) / 2 * size).astype(int), 0, size - 1)
    row = np.clip(((tc + 1) / 2 * size).astype(int), 0, size - 1)
    face = 2 * axis + ~positive
    shown = np.stack([faces[f][r, c] for f, r, c in zip(face, row, column, strict=True)]) / 255.0
    wanted = pattern("globe")(directions)
    agree = np.abs(shown - wanted).max(axis=1) < 0.08
    assert agree.mean() > 0.75  # the others lie at a line or a coast, within a texel


# normal, and the ways along columns and rows of the six faces (OpenGL 4.6, table 8.19)
GL_FACES = np.array([
    [[1, 0, 0], [0, 0, -1], [0, -1, 0]], [[-1, 0, 0], [0, 0, 1], [0, -1, 0]], [[0, 1, 0], [1, 0, 0], [0, 0, 1]],
    [[0, -1, 0], [1, 0, 0], [0, 0, -1]], [[0, 0, 1], [1, 0, 0], [0, -1, 0]], [[0, 0, -1], [-1, 0, 0], [0, -1, 0]],
])  # fmt: skip


def gl_cube_directions(size):
    """Directions, of any length, of the texels of an OpenGL cube map with equiangular faces, [6, size, size, 3]."""
    steps = np.tan(((np.arange(size) + 0.5) / size * 2.0 - 1.0) * (np.pi / 4.0))
    normal, right, down = (GL_FACES[:, k, None, None, :] for k in range(3))
    return normal + steps[None, None, :, None] * right + steps[None, :, None, None] * down


def test_cube_directions_cover_the_sphere_once():
    directions = gl_cube_directions(16).reshape(-1, 3)
    unit = directions / np.linalg.norm(directions, axis=1)[:, None]
    np.testing.assert_allclose(unit.mean(axis=0), 0, atol=1e-12)
    assert len(np.unique(unit.round(9), axis=0)) == len(unit)
    faces = [np.asarray(decode(uri)) for uri in scene.cube_faces(pattern("checker"), 16, device="cpu")]
    agree = np.abs(np.stack(faces).reshape(-1, 3) / 255.0 - pattern("checker")(directions)).max(axis=1) < 0.08
    assert agree.mean() > 0.4  # the others lie at a line


def test_large_meshes_are_shown_simplified_on_their_own_vertices():
    surface = shapes.blob(sphere=1280)
    vertices, faces = scene.shown_mesh(surface.vertices, surface.faces, 500)
    assert vertices is surface.vertices
    assert 100 < len(faces) <= 500
    used = np.unique(faces)
    edges = np.unique(np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1), axis=0)
    assert len(used) - len(edges) + len(faces) == 2
    normal = np.cross(vertices[faces[:, 1]] - vertices[faces[:, 0]], vertices[faces[:, 2]] - vertices[faces[:, 0]])
    volume = np.einsum("ij,ij->i", normal, vertices[faces[:, 0]]).sum() / 6
    assert volume > 0
    assert scene.shown_mesh(surface.vertices, surface.faces, 1280)[1] is surface.faces


def test_alignment_recovers_a_rotation():
    rng = np.random.default_rng(0)
    points = rng.normal(size=(50, 3))
    turn, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    turn *= np.sign(np.linalg.det(turn))
    unit = points / np.linalg.norm(points, axis=1)[:, None]
    np.testing.assert_allclose(scene.alignment(unit, points @ turn.T), turn, atol=1e-12)


def test_same_page_twice(result, page):
    again = report_page(result, title="A <b>creature</b> & more", up="z", picture_size=200, device="cpu")
    assert again == page


def test_an_image_is_shown_instead_of_a_pattern(result, tmp_path):
    x = np.linspace(0, 255, 128)
    picture = np.stack(np.broadcast_arrays(x[None, :], x[:64, None] * 2, 90.0), axis=-1).astype(np.uint8)
    path = write_report(result, tmp_path / "r.html", image=picture, picture_size=64, device="cpu")
    text = path.read_text("utf-8")
    assert "The picture on the sphere" in text and "<span>Picture</span>" in text
    assert sorted(p.name for p in tmp_path.iterdir()) == ["r.html"]


def test_what_cannot_be_done_is_one_clear_error(result, tmp_path):
    with pytest.raises(OmtwarpError, match="give a result of map_to_sphere"):
        report_page((1, 2))
    with pytest.raises(OmtwarpError, match="unknown pattern 'dots'"):
        report_page(result, pattern="dots")
    with pytest.raises(OmtwarpError, match="is a directory"):
        write_report(result, tmp_path)


def test_command(result, tmp_path, capsys):
    result.save(tmp_path / "map.npz")
    with pytest.raises(SystemExit) as ended:
        main(["report", "--map", str(tmp_path / "map.npz"), "-o", str(tmp_path / "out.html"), "--pattern", "checker"])
    assert not ended.value.code
    assert "to be opened in a browser" in capsys.readouterr().out
    assert "<h1>map</h1>" in (tmp_path / "out.html").read_text("utf-8")
    for arguments, words in (
        (["--map", str(tmp_path / "map.npz"), "-o", str(tmp_path / "out.pdf")], "unknown suffix '.pdf'"),
        (["--map", str(tmp_path / "no.npz"), "-o", str(tmp_path / "no.html")], "no.npz"),
        (["--map", str(tmp_path / "map.npz"), "-o", str(tmp_path / "no.html"), "--up", "q"], "'q'"),
    ):
        with pytest.raises(SystemExit) as ended:
            main(["report", *arguments])
        assert ended.value.code == 1
        assert words in capsys.readouterr().err
    assert sorted(p.name for p in tmp_path.iterdir()) == ["map.npz", "out.html"]


def decode(uri: str) -> Image.Image:
    return Image.open(io.BytesIO(base64.b64decode(uri.split(",", 1)[1]))).convert("RGB")


@pytest.fixture(scope="module")
def open_blob():
    blob = shapes.blob(seed=3, sphere=720)
    used, faces = np.unique(blob.faces[(blob.vertices[blob.faces, 2] > -0.3).all(axis=1)], return_inverse=True)
    return blob.vertices[used], faces.reshape(-1, 3)


def test_page_names_what_the_surface_is_mapped_to(open_blob, text_only):
    ball = shapes.blob(seed=1, sphere=320)
    two = np.concatenate([ball.vertices, ball.vertices + 4.0]), np.concatenate([ball.faces, ball.faces + 162])
    for mesh, options, label, words in (
        (open_blob, {"domain": "hemisphere"}, "Optimal transport", ("mapped to the hemisphere", "50.0% of the sphere")),
        (open_blob, {"domain": "disk"}, "Disk", ("mapped to the unit disk", "seen from above", ">Disk, on the disk.<")),
        (open_blob, {"domain": "cap"}, "Cap", ("mapped to a spherical cap", ">Conformal, on the hemisphere.<")),
        (open_blob, {"domain": "sphere"}, "Optimal transport", ("the unit sphere", "1 hole filled", "is part of it")),
        (two, {}, "Optimal transport", ("mapped to 2 spheres, one for each part", "is certified by itself")),
        (two, {"together": True}, "Caps", ("the unit sphere, all parts side by side", "97.", "on the hemispheres.<")),
        (shapes.rings(2, cell=0.35), {}, "Optimal transport", ("the unit sphere", "2 handles cut open")),
    ):
        result = omtwarp.map_surface(mesh, optimality=False, device="cpu", **options)
        text = report_page(result)
        assert stages_of(result)[-1].label == label
        assert all(word in text for word in words), (options, [word for word in words if word not in text])
        assert all(stage.distortion.area["surface"] < 2.05 for stage in stages_of(result)[1:]), options


def test_stages_of_a_disk_are_those_of_the_hemisphere_and_the_disk_itself(open_blob):
    result = omtwarp.map_surface(open_blob, domain="disk", optimality=False, device="cpu")
    *before, last = stages_of(result)
    assert [stage.domain for stage in before] == ["hemisphere"] * len(before) and last.domain == "disk"
    assert last.distortion.angle == result.distortion("disk").angle
    np.testing.assert_allclose(np.linalg.norm(last.sphere, axis=1), 1.0, atol=1e-12)
    # The page's view lays it flat by the projection that it was lifted by.
    np.testing.assert_allclose(last.sphere[:, :2] / np.sqrt(1.0 + last.sphere[:, 2:]), result.disk, atol=1e-12)


def test_parts_have_places_of_their_own_in_the_view():
    ball = shapes.blob(seed=1, sphere=320)
    vertices = np.concatenate([ball.vertices, 2.0 * ball.vertices + 0.1])
    faces = np.concatenate([ball.faces, ball.faces + 162])
    result = omtwarp.map_surface((vertices, faces), optimality=False, device="cpu")
    shown = scene.make_scene(result, stages_of(result), "checker", texels=16, device="cpu")
    offset, count = json.loads(shown.header)["arrays"]["place-omt"]
    blob = zlib.decompress(base64.b64decode(shown.data))
    places = np.frombuffer(blob, "<f4", count, offset).reshape(-1, 4)
    assert len(places) == 324 and len(np.unique(places, axis=0)) == 2
    (one, other) = places[0], places[-1]
    assert other[3] == pytest.approx(2.0 * one[3]) and np.linalg.norm(one[:3] - other[:3]) > one[3] + other[3]
