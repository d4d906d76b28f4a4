"""The page about a map to a torus, and the data of its interactive view."""

from __future__ import annotations

import base64
import io
import json
import zlib
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

import omtwarp
from omtwarp.mesh import shapes
from omtwarp.mesh.surface import triangle_areas
from omtwarp.render.scene import SurfaceView
from omtwarp.render.subject import posed
from omtwarp.reporting import write_report
from omtwarp.reporting.page import torus_scene, torus_stages

TYPES = {"position": "<i2", "normal": "<i2", "index": "<u4", "direction": "<i2", "lattice": "<f4"}


@pytest.fixture(scope="module")
def result():
    ring = shapes.rings(1, cell=0.35)
    return omtwarp.map_surface((ring.vertices, ring.faces), domain="torus")


def scene_of(result, image=None, pattern="circles"):
    """The header of a view, and its arrays by name."""
    pose = posed(SurfaceView(result.vertices, result.faces))
    scene = torus_scene(result, torus_stages(result), image, pattern, pose)
    header, blob = json.loads(scene.header), zlib.decompress(base64.b64decode(scene.data))
    arrays = {
        name: np.frombuffer(blob, TYPES.get(name.split("-")[0], "u1"), count, offset)
        for name, (offset, count) in header["arrays"].items()
    }
    assert scene.faces == len(result.faces) == len(arrays["index"]) // 3
    return header, arrays


def picture_of(header):
    (uri,) = header["picture"]
    return uri.split(";")[0], np.asarray(Image.open(io.BytesIO(base64.b64decode(uri.split(",")[1]))))


@pytest.mark.parametrize("key", ["conformal", "omt"])
def test_the_view_has_the_map_at_every_corner(result, key):
    header, arrays = scene_of(result)
    triangles = arrays["index"].reshape(-1, 3)
    shown = result if key == "omt" else replace(result, coordinates=result.conformal)
    places = arrays[f"lattice-{key}"].reshape(-1, 2)[triangles].astype(np.float64)
    whole = places - shown.corners
    np.testing.assert_allclose(whole, np.round(whole[:, :1]) * np.ones((1, 3, 1)), atol=1e-5)
    ring = arrays[f"direction-{key}"].reshape(-1, 3) / 32767.0
    wanted = shown.ring()[result.faces]
    np.testing.assert_allclose(ring[triangles], wanted * header["ring"]["radius"], atol=1e-4)
    assert [stage["key"] for stage in header["stages"]] == ["conformal", "omt"]


def test_the_surface_keeps_its_shape_in_the_view(result):
    header, arrays = scene_of(result)
    placed = arrays["position"].reshape(-1, 3) / 32767.0
    areas = triangle_areas(placed, arrays["index"].reshape(-1, 3).astype(np.int64))
    given = triangle_areas(result.vertices, result.faces)
    np.testing.assert_allclose(areas / areas.sum(), given / given.sum(), rtol=0.01)
    assert np.linalg.norm(placed, axis=1).max() == pytest.approx(1.0, abs=1e-4)
    # The ring torus has the surface's area, unless it would be larger than the surface.
    radius, ring = header["radius"], header["ring"]["radius"]
    own = 4.0 * np.pi**2 * ring * (1.0 - ring) * radius**2
    assert own == pytest.approx(areas.sum(), rel=0.01) or (radius == 1.0 and own < areas.sum())


def test_the_picture_repeats_and_is_no_larger_than_needed(result):
    kind, picture = picture_of(scene_of(result)[0])
    assert kind == "data:image/png" and picture.shape[1] <= 1024
    photograph = np.random.default_rng(0).integers(0, 255, (700, 1500, 3), dtype=np.uint8)
    kind, picture = picture_of(scene_of(result, image=photograph)[0])
    assert kind == "data:image/jpeg" and picture.shape == (478, 1024, 3)
    assert not np.array_equal(*(picture_of(scene_of(result, pattern=name)[0])[1] for name in ("circles", "checker")))


@pytest.mark.parametrize(("options", "label"), [({"exact": True}, "Exact areas"), ({"refine": "balanced"}, "Refined")])
def test_the_last_stage_has_its_name(options, label):
    ring = shapes.rings(1, cell=0.35)
    made = omtwarp.map_surface((ring.vertices, ring.faces), domain="torus", **options)
    first, last = torus_stages(made)
    assert (first.label, last.label) == ("Conformal", label)
    assert last.record["name"] == last.key and last.weights.sum() == pytest.approx(1.0)
    assert len(scene_of(made)[0]["stages"]) == 2


def test_the_page_has_the_view_and_what_the_report_says(result, tmp_path):
    page = write_report(result, tmp_path / "page.html", title="A <ring>", picture_size=64, device="cpu")
    text = page.read_text("utf-8")
    assert "A &lt;ring&gt;" in text and 'id="viewer-canvas"' in text and "Certified one to one" in text
    assert "decided exactly in the universal cover" in text and "Area: torus / surface" in text and "Lattice" in text
    assert "Histogram of area ratios" in text and "Optimal transport" in text
    bare = replace(result, report={}, history=[])
    assert "Certified one to one" in write_report(bare, page, picture_size=64, device="cpu").read_text("utf-8")
