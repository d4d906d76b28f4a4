"""Maps in notebooks: nothing is computed for a line of text, the view works offline, other programs get the map."""

from __future__ import annotations

import base64
import html
import re
import subprocess
import sys
import time

import browser
import numpy as np
import pytest
from PIL import Image

from omtwarp.errors import OmtwarpError
from omtwarp.mapping.any_surface import map_surface
from omtwarp.maps import Displayable
from omtwarp.maps.result import MapResult
from omtwarp.mesh import shapes


@pytest.fixture(scope="module")
def result() -> MapResult:
    """A body with limbs, and its radial map to the sphere."""
    surface = shapes.limbs(length=0.5, sharpness=4.0, sphere=1280)
    last = surface.vertices / np.linalg.norm(surface.vertices, axis=1)[:, None]
    first = last * (1.0, 1.0, 1.3)
    first /= np.linalg.norm(first, axis=1)[:, None]
    return MapResult(surface.vertices, surface.faces, last, first, np.ones(len(last)))


@pytest.fixture(scope="module")
def view(result) -> str:
    return result._repr_html_()


def page_of(view: str) -> str:
    """The page in the view's frame."""
    return html.unescape(re.search(r'srcdoc="([^"]*)"', view)[1])


def test_repr_computes_nothing(result, monkeypatch):
    """``repr`` and the completion of names draw, measure and import nothing."""

    def fails(*args, **kwargs):
        raise AssertionError("something was computed")

    for name in ("distortion", "certificate", "_repr_html_", "plot"):
        monkeypatch.setattr(MapResult, name, property(fails) if name == "certificate" else fails)
    assert repr(result) == "MapResult(642 vertices, 1280 faces)" == str(result)
    code = (
        "import sys, numpy as np; from omtwarp.maps.result import MapResult\n"
        "from omtwarp.mesh.shapes import icosphere; ball = icosphere(2)\n"
        "made = MapResult(ball.vertices, ball.faces, ball.vertices, ball.vertices, np.ones(42))\n"
        "made; repr(made); dir(made)\n"
        "print([name for name in ('IPython', 'PIL.Image', 'pyvista', 'omtwarp.render', 'omtwarp.reporting')"
        " if name in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]" and done.stderr == ""  # and a script prints nothing of its own


def test_every_map_shows_itself():
    assert issubclass(MapResult, Displayable)


def test_view_is_a_picture_with_a_frame_over_it(view):
    assert view.count("<iframe") == 1 and 'sandbox="allow-scripts"' in view
    picture, frame = view.split("<iframe")
    assert 'src="data:image/webp;base64,' in picture
    assert frame.split(">")[0].count('"') % 2 == 0  # what is in the frame ends nowhere but at its end
    assert not re.search(r'(?:src|href)="https?:', html.unescape(view))
    assert len(view) < 2_000_000
    policy = re.search(r'Content-Security-Policy" content="([^"]*)"', page_of(view))[1]
    assert policy.startswith("default-src 'none'") and policy.count("'sha256-") == 2 and "unsafe-eval" not in policy


# What VS Code allows in outputs of notebooks with notebook.experimental.enableCsp, its own addresses left out.
EDITOR_POLICY = (
    "default-src 'none'; script-src 'unsafe-inline' 'unsafe-eval'; style-src 'unsafe-inline'; "
    "img-src https: http: data:; font-src https:; connect-src https:; child-src https: data:;"
)


# The frame that VS Code's editor puts a notebook's outputs in, and how its renderer puts HTML there: as `innerHTML`.
WEBVIEW = """<!doctype html><meta charset="utf-8"><body style="margin:0">
<iframe id="webview" sandbox="allow-scripts allow-same-origin allow-forms allow-pointer-lock allow-downloads"
 style="border:0;width:100%;height:600px" srcdoc="{}"></iframe></body>"""
OUTPUT = """<!doctype html><meta charset="utf-8"><meta http-equiv="Content-Security-Policy" content="{policy}">
<body style="margin:0"><div id="output"></div><script type="text/plain" id="html">{encoded}</script>
<script>document.getElementById("output").innerHTML =
 new TextDecoder().decode(Uint8Array.from(atob(document.getElementById("html").textContent), c => c.charCodeAt(0)));
</script></body>"""


def drawn_over(framed: np.ndarray, still: np.ndarray) -> bool:
    """Whether the frame shows its controls, which stand at its bottom when the view draws, over the picture."""
    bottom = slice(-50, None)
    return bool((np.abs(framed[bottom] - still[bottom]).max(axis=2) > 0.2).mean() > 0.02)


@pytest.mark.skipif(browser.PROGRAM is None, reason="no Chromium on this machine")
def test_view_draws_in_the_frame_of_an_editor(view, tmp_path):
    """In a sandboxed frame with VS Code's policy, into which its renderer writes the HTML: drawn without a network."""
    encoded = base64.b64encode(view.encode()).decode()
    output = OUTPUT.format(policy=EDITOR_POLICY, encoded=encoded)
    (tmp_path / "editor.html").write_text(WEBVIEW.format(html.escape(output)), "utf-8")
    inner = "document.getElementById('webview').contentDocument.querySelector('iframe')"
    page = browser.Browser(tmp_path / "profile")
    try:
        page.ask("Page.navigate", url=(tmp_path / "editor.html").as_uri())
        page.wait_for(f"document.readyState === 'complete' && {inner} !== null")
        page.run(f"{inner}.style.visibility = 'hidden'")
        still = page.picture("#webview")[:460]
        page.run(f"{inner}.style.visibility = ''")
        end = time.monotonic() + browser.PATIENCE
        while not drawn_over(framed := page.picture("#webview")[:460], still) and time.monotonic() < end:
            time.sleep(0.2)
        assert drawn_over(framed, still), page.complaints
        assert page.complaints == []
        assert all(address.startswith(("file:", "data:", "blob:", "about:")) for address in page.requests)
    finally:
        page.close()
    assert np.ptp(framed, axis=2).max() > 0.4 and framed.std() > 0.05


@pytest.mark.skipif(browser.PROGRAM is None, reason="no Chromium on this machine")
def test_view_draws_in_a_browser_without_a_network(view, tmp_path):
    """As in a notebook of VS Code: the surface appears in a frame of a page with its policy, and turns into a ball."""
    file = tmp_path / "notebook.html"
    policy = f'<meta http-equiv="Content-Security-Policy" content="{EDITOR_POLICY}">'
    file.write_text(f"<!doctype html><meta charset='utf-8'>{policy}<body style='margin:0'>{view}</body>", "utf-8")
    alone = tmp_path / "view.html"
    alone.write_text(page_of(view), "utf-8")
    page = browser.Browser(tmp_path / "profile")
    try:
        page.ask("Page.navigate", url=file.as_uri())
        page.wait_for("document.readyState === 'complete' && document.querySelector('iframe') !== null")
        page.run("document.querySelector('iframe').style.visibility = 'hidden'")
        still = page.picture("iframe")
        page.run("document.querySelector('iframe').style.visibility = ''")
        end = time.monotonic() + browser.PATIENCE
        while not drawn_over(framed := page.picture("iframe"), still) and time.monotonic() < end:
            time.sleep(0.2)
        assert drawn_over(framed, still), page.complaints
        assert page.open(alone.as_uri()) == "live"
        shown = page.picture("canvas")
        page.run(
            "(i => { i.value = 100; i.dispatchEvent(new Event('input', {bubbles: true})); })"
            "(document.querySelector('input[name=morph]'))"
        )
        ball = page.picture("canvas")
        assert page.complaints == []
        assert all(address.startswith(("file:", "data:", "blob:", "about:")) for address in page.requests)
    finally:
        page.close()
    for picture in (framed, shown, ball):  # circles of several colours
        assert np.ptp(picture, axis=2).max() > 0.4 and picture.std() > 0.05
    assert np.abs(ball - shown).max(axis=2).mean() > 0.02


def test_plot_is_a_picture(result):
    picture = result.plot(size=(96, 72), backend="warp", device="cpu")
    assert isinstance(picture, Image.Image) and picture.size == (96, 72)
    colours = np.asarray(picture).reshape(-1, 3)
    assert np.ptp(colours.astype(int), axis=1).max() > 80  # the pattern, on the surface
    field = result.plot(size=(96, 72), scalar=result.vertices[:, 2], backend="warp", device="cpu")
    assert not np.array_equal(np.asarray(field), np.asarray(picture))


def test_a_map_to_a_torus_shows_a_picture():
    ring = shapes.rings(1, cell=0.35)
    made = map_surface(ring, domain="torus", device="cpu")
    assert isinstance(made, MapResult) and made.domain == "torus"
    view = made._repr_html_()
    assert "<iframe" not in view and 'src="data:image/webp' in view and "MapResult(torus, " in view
    drawn = {"size": (96, 72), "backend": "warp", "device": "cpu"}
    circles, field = made.plot(**drawn), made.plot(scalar=ring.vertices[:, 2], **drawn)
    saturation = np.ptp(np.asarray(circles.convert("RGB"), dtype=int), axis=2)
    assert (saturation > 60).mean() > 0.05  # the pattern's colours, where a surface without one is grey
    assert not np.array_equal(np.asarray(field), np.asarray(circles))


def test_pyvista_gets_the_map(result):
    pyvista = pytest.importorskip("pyvista")
    mesh = result.to_pyvista()
    assert isinstance(mesh, pyvista.PolyData) and (mesh.n_points, mesh.n_cells) == (642, 1280)
    np.testing.assert_array_equal(mesh.points, result.vertices)
    np.testing.assert_array_equal(mesh.regular_faces, result.faces)
    np.testing.assert_array_equal(mesh.point_data["sphere"], result.sphere)
    np.testing.assert_array_equal(mesh.point_data["conformal"], result.conformal)
    np.testing.assert_allclose(mesh.cell_data["area_ratio"], result.distortion().area_ratio)
    np.testing.assert_allclose(mesh.cell_data["angle"], result.distortion().face_angle)


def test_polyscope_gets_the_map(result, tmp_path, monkeypatch):
    polyscope = pytest.importorskip("polyscope")
    monkeypatch.chdir(tmp_path)  # where it keeps its preferences
    polyscope.init("openGL_mock")
    shown = result.to_polyscope("body")
    assert (shown.n_vertices(), shown.n_faces()) == (642, 1280)
    assert polyscope.has_surface_mesh("body") and polyscope.has_surface_mesh("body's sphere")
    polyscope.remove_all_structures()


@pytest.mark.parametrize(("module", "call"), [("pyvista", "to_pyvista"), ("polyscope", "to_polyscope")])
def test_a_missing_viewer_is_one_line(result, monkeypatch, module, call):
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(OmtwarpError, match=r"is not installed: pip install 'omtwarp\[viewers\]'"):
        getattr(result, call)()
