"""GLB with own coordinates, several materials and extra maps, as Khronos' validator and three.js read it."""

import base64
import sys
from pathlib import Path

import numpy as np
import pytest
import trimesh
from node import package, validated
from two_materials import BLUE, RED, two_halves

from omtwarp import map_surface, shapes
from omtwarp.mesh.write import write_mesh
from omtwarp.texturing import paint, read_painted_mesh, texture, unwrap_uv
from omtwarp.texturing.atlas import ATLASES
from omtwarp.transfer import transfer_texture

sys.path.insert(0, str(Path(__file__).parents[1] / "reporting"))
from browser import PROGRAM, Browser

VALIDATOR, THREE = package("gltf-validator"), package("three")
WITHOUT_VALIDATOR = "node or its package gltf-validator is not there"
WITHOUT_THREE = "node, its package three or a Chromium is not there"

PAGE = """<!doctype html><style>body {{ margin: 0; background: white }}</style>
<canvas id="view" width="400" height="400"></canvas>
<script type="importmap">{{"imports": {{"three": "{three}/build/three.module.js"}}}}</script>
<script type="module">
import * as THREE from 'three';
import {{ GLTFLoader }} from '{three}/examples/jsm/loaders/GLTFLoader.js';
const bytes = Uint8Array.from(atob('{glb}'), c => c.charCodeAt(0)).buffer;
const canvas = document.getElementById('view');
const renderer = new THREE.WebGLRenderer({{canvas, antialias: true, preserveDrawingBuffer: true}});
const scene = new THREE.Scene();
scene.background = new THREE.Color(0xffffff);
{light}
const camera = new THREE.OrthographicCamera(-1.1, 1.1, 1.1, -1.1, 0.1, 10);
camera.up.set(0, 0, 1); camera.position.set(0, -4, 0); camera.lookAt(0, 0, 0);
new GLTFLoader().parseAsync(bytes, '').then(gltf => {{
  const kinds = [];
  gltf.scene.traverse(node => {{
    if (!node.isMesh) return;
    const m = node.material;
    kinds.push([m.name, !!m.map, !!m.normalMap, !!m.aoMap]);
    {replace}
  }});
  scene.add(gltf.scene);
  renderer.render(scene, camera);
  document.documentElement.dataset.materials = JSON.stringify(kinds);
  document.documentElement.dataset.viewer = 'ready';
}}).catch(error => {{ document.documentElement.dataset.viewer = 'failed: ' + error; }});
</script>"""
# The colours themselves, and light from the viewer, so that normals show.
UNLIT = "node.material = new THREE.MeshBasicMaterial({map: m.map, color: m.color});"
LAMP = "const lamp = new THREE.DirectionalLight(0xffffff, 3); lamp.position.set(0, -4, 0); scene.add(lamp);"


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """GLB files of every kind that the package writes for meshes with materials."""
    folder = tmp_path_factory.mktemp("files")
    path, *_ = two_halves(folder, picture=True)
    mesh = read_painted_mesh(path)
    sphere = mesh.vertices / np.linalg.norm(mesh.vertices, axis=1, keepdims=True)
    result = (mesh.vertices, mesh.faces, sphere)
    ball = trimesh.creation.icosphere(subdivisions=4)
    fine = (np.asarray(ball.vertices), np.asarray(ball.faces))
    bakes = {"bake": ["ao", "normal"], "detail": fine, "size": 128}
    made = {
        "own": mesh,
        "maps": paint(result, mesh, **bakes),
        "both": paint(result, mesh, pattern="checker", keep="over", **bakes),
        "atlas": paint(result, mesh, pattern="checker", keep="over", uv="atlas", **bakes),
        "curvature": paint(result, None, uv="atlas", bake=["area"], size=128),
        "coordinates": unwrap_uv(result),
        "transferred": transfer_texture(mesh, result, result, size=128),
    }
    found = {name: one.export(folder / f"{name}.glb")[-1] for name, one in made.items()}
    for name, one in {"painted": made["both"], "textured": texture(result, pattern="checker", size=128)}.items():
        found[f"{name} webp"] = one.export(folder / f"{name}_webp.glb", texture_format="webp")[-1]
    return found


@pytest.fixture(scope="module")
def defaults(tmp_path_factory):
    """GLB files of sizes that nobody asked for, of a coarse ball for speed; a picture's sides are no powers of two."""
    folder = tmp_path_factory.mktemp("defaults")
    ball = shapes.icosphere(4)
    result = (ball.vertices, ball.faces, ball.vertices)
    picture = np.random.default_rng(0).integers(0, 255, (150, 300, 3), dtype=np.uint8)
    for name in ATLASES:
        texture(result, pattern="checker", atlas=name).export(folder / f"pattern {name}.glb")
    for name in ("cube", "octahedral"):
        texture(result, picture, atlas=name).export(folder / f"picture {name}.glb")
    paint(result, None, uv="atlas", bake=["ao"]).export(folder / "occlusion.glb")
    write_mesh(folder / "sphere.glb", ball.vertices, ball.faces)
    ring = trimesh.creation.torus(1.0, 0.4, major_sections=24, minor_sections=12)
    on_torus = map_surface((ring.vertices, ring.faces), domain="torus", device="cpu")
    texture(on_torus).export(folder / "torus.glb")
    return {path.stem: path for path in sorted(folder.glob("*.glb"))}


@pytest.mark.skipif(VALIDATOR is None, reason=WITHOUT_VALIDATOR)
def test_khronos_validator_has_nothing_to_say(files, defaults):
    """No error, warning, information or hint, about files of every kind and about those of every default."""
    assert len(defaults) == 8
    for name, path in (files | defaults).items():
        assert validated(path)["messages"] == [], name


@pytest.mark.skipif(VALIDATOR is None, reason=WITHOUT_VALIDATOR)
def test_the_validator_hints_at_what_was_asked_for(tmp_path):
    """A width that is no power of two is kept, and the validator says so: it would have said so above."""
    ball = shapes.icosphere(4)
    texture((ball.vertices, ball.faces, ball.vertices), pattern="checker", size=96).export(tmp_path / "a.glb")
    assert [message["code"] for message in validated(tmp_path / "a.glb")["messages"]] == ["IMAGE_NPOT_DIMENSIONS"]


@pytest.mark.skipif(VALIDATOR is None, reason=WITHOUT_VALIDATOR)
def test_the_validator_sees_a_file_that_is_wrong(files, tmp_path):
    """The validator reports an index out of range, which shows that it examines the files."""
    data = bytearray(files["own"].read_bytes())
    data[-4:] = b"\xff\xff\xff\x7f" if b"\x89PNG" not in data[-200:] else data[-4:]
    broken = bytes(data).replace(b'"mode":4', b'"mode":9')
    (tmp_path / "broken.glb").write_bytes(broken)
    assert validated(tmp_path / "broken.glb")["numErrors"] > 0


@pytest.fixture(scope="module")
def browser(tmp_path_factory):
    if PROGRAM is None or THREE is None:
        pytest.skip(WITHOUT_THREE)
    one = Browser(tmp_path_factory.mktemp("profile"), "--allow-file-access-from-files")
    yield one
    one.close()


def opened(browser, path, folder, *, unlit):
    """The materials that three.js finds in a file, and the picture that it draws from the front, colours in 0..255."""
    page = PAGE.format(
        three=THREE.as_uri(),
        glb=base64.b64encode(path.read_bytes()).decode(),
        light="" if unlit else LAMP,
        replace=UNLIT if unlit else "",
    )
    (folder / "page.html").write_text(page)
    assert browser.open((folder / "page.html").as_uri()) == "ready"
    materials = browser.run("JSON.parse(document.documentElement.dataset.materials)")
    return materials, 255.0 * browser.picture("#view")


def near(pixels, color):
    return np.abs(pixels - color).max(axis=-1) < 14


def test_three_js_draws_both_materials_where_they_are(browser, files, tmp_path):
    """Above the equator red, below it stripes of blue and white: every pixel of the ball away from borders.

    Red has no picture but a white texel, to which its coordinates belong.
    """
    materials, picture = opened(browser, files["own"], tmp_path, unlit=True)
    assert sorted(materials) == [["blue", True, False, False], ["red", True, False, False]]
    y, x = (1.0 - 2.0 * (np.mgrid[0:400, 0:400] + 0.5) / 400) * 1.1
    x = -x
    inside = x**2 + y**2 < 0.97
    above, below = inside & (y > 0.2), inside & (y < -0.2)
    assert near(picture[above], RED).mean() > 0.999
    longitude = np.arctan2(-np.sqrt(np.maximum(1 - x**2 - y**2, 0)), x) / (2 * np.pi) + 0.5
    column = longitude * 64
    middle = below & (np.abs(column % 1 - 0.5) < 0.25) & (x**2 + y**2 < 0.8)
    blue = middle & (np.floor(column) % 2 == 0)
    # Longitude is linear in triangles, not on the sphere: some stripes bend a little.
    assert near(picture[blue], BLUE).mean() > 0.9
    assert near(picture[middle & ~blue], (240, 240, 240)).mean() > 0.9
    assert near(picture[~(x**2 + y**2 < 1.05)], 255).all()


def test_three_js_takes_every_extra_map(browser, files, tmp_path):
    """Occlusion and normals arrive in their slots; with the normals of a ball, a coarse ball is lit like a ball."""
    materials, picture = opened(browser, files["maps"], tmp_path, unlit=False)
    assert sorted(materials) == [["blue", True, True, True], ["red", False, True, True]]
    y, x = (1.0 - 2.0 * (np.mgrid[0:400, 0:400] + 0.5) / 400) * 1.1
    x = -x
    height = np.sqrt(np.maximum(1 - x**2 - y**2, 0))
    red = (x**2 + y**2 < 0.9) & (y > 0.25)
    encoded = picture[..., 0] / 255
    light = np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4)[red]
    # Light from the viewer falls off with the cosine of the angle, but for a small highlight.
    assert np.corrcoef(light, height[red])[0, 1] > 0.97
    for name in ("both", "atlas"):
        materials, picture = opened(browser, files[name], tmp_path, unlit=True)
        assert all(kind[1:] == [True, True, True] for kind in materials) and len(materials) == 2
        body = x**2 + y**2 < 0.97
        assert picture[body].std(axis=0).min() > 20 and not near(picture[body], 255).any()


def test_own_coordinates_and_atlas_look_the_same_in_three_js(browser, files, tmp_path):
    """The same pattern over the same materials, once in the mesh's coordinates and once on the cube atlas."""
    _, own = opened(browser, files["both"], tmp_path, unlit=True)
    _, atlas = opened(browser, files["atlas"], tmp_path, unlit=True)
    assert np.median(np.abs(own - atlas)) < 3 and (np.abs(own - atlas).max(axis=2) > 60).mean() < 0.06
