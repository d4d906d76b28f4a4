"""The report page in a browser: the view shows the surface as the package's own pictures do, and can fail well.

Pictures are compared for what they show, not for their pixels.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

import omtwarp
from omtwarp.mesh import shapes
from omtwarp.reporting import write_report

sys.path.insert(0, str(Path(__file__).parent))
from browser import PROGRAM, Browser

pytestmark = pytest.mark.skipif(PROGRAM is None, reason="no Chromium on this machine")
STAGE = ".stage"


@pytest.fixture(scope="module")
def result():
    return omtwarp.map_to_sphere(shapes.demo_shape(3000), until="omt", device="cpu")


@pytest.fixture(scope="module")
def page(result, tmp_path_factory) -> Path:
    return write_report(result, tmp_path_factory.mktemp("page") / "page.html", up="z", picture_size=400, device="cpu")


@pytest.fixture(scope="module")
def browser(tmp_path_factory):
    started = Browser(tmp_path_factory.mktemp("profile"))
    yield started
    started.close()


def choose(browser: Browser, **state: str) -> np.ndarray:
    """Set the view's controls as a reader would, and look at it without legends and hints."""
    for name, value in state.items():
        browser.run(
            f"""{{
            const inputs = [...document.querySelectorAll('#viewer-controls [name="{name}"]')];
            const input = inputs.find(i => i.type !== 'radio' || i.value === '{value}');
            if (input.type === 'range') input.value = '{value}'; else input.checked = '{value}' !== '';
            input.dispatchEvent(new Event('input', {{bubbles: true}}));
            document.querySelectorAll('.legend, .hint').forEach(e => e.style.visibility = 'hidden');
            }}"""
        )
    return browser.picture(STAGE)


def box(mask: np.ndarray) -> tuple[slice, slice]:
    """The rectangle that a mask fills, stray pixels aside."""
    rows = np.flatnonzero(mask.sum(axis=1) > 2)
    columns = np.flatnonzero(mask.sum(axis=0) > 2)
    return slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1)


def colourfulness(pixels: np.ndarray) -> np.ndarray:
    return pixels.max(axis=-1) - pixels.min(axis=-1)


def hue(pixels: np.ndarray) -> np.ndarray:
    """Angle of the colour in radians."""
    red, green, blue = np.moveaxis(pixels, -1, 0)
    return np.arctan2(np.sqrt(3.0) * (green - blue), 2 * red - green - blue)


def test_view_shows_the_surface_as_our_own_pictures_do(browser, page, result):
    from omtwarp.render import Camera, SurfaceView, preview
    from omtwarp.texturing import rasterize

    assert browser.open(page.as_uri()) == "live"
    plain, coloured, textured = (choose(browser, colouring=name) for name in ("plain", "angle", "picture"))
    changed = np.abs(coloured - plain).max(axis=2) > 0.06  # the surface, and nothing else
    rows, columns = box(changed)
    height, width = rows.stop - rows.start, columns.stop - columns.start
    assert height > 0.6 * plain.shape[0]
    assert 0.2 < changed[rows, columns].mean() < 0.95  # a creature with legs, no rectangle

    view = SurfaceView(
        result.vertices, result.faces, image=rasterize("circles", 1024, device="cpu"), sphere=result.sphere
    )
    ours = preview(view, size=(900, 600), camera=Camera(margin=0.02), transparent=True, light="flat", device="cpu")
    ours = ours.crop(ours.getchannel("A").point(lambda a: 255 * (a > 127)).getbbox())
    assert ours.width / ours.height == pytest.approx(width / height, rel=0.04)
    picture = np.asarray(ours.resize((width, height))) / 255.0
    inside = picture[..., 3] > 0.5
    shown = changed[rows, columns]
    assert (inside & shown).sum() > 0.9 * (inside | shown).sum()  # the same silhouette

    # The same spots in the same places: pixels strongly coloured in both have the same hue, and most are so in both.
    theirs, ours_rgb = textured[rows, columns], picture[..., :3]
    strong = inside & shown & (colourfulness(ours_rgb) > 0.3)
    both = strong & (colourfulness(theirs) > 0.15)
    assert both.sum() > 0.65 * strong.sum() > 2000
    turned = np.angle(np.exp(1j * (hue(theirs) - hue(ours_rgb))))[both]
    assert (np.abs(turned) < 0.35).mean() > 0.85
    counts, _ = np.histogram(hue(theirs)[both], 12, (-np.pi, np.pi))
    assert (counts > 0.03 * counts.sum()).sum() >= 3  # several colours
    assert np.median(colourfulness(plain[rows, columns][shown])) < 0.1


def test_the_surface_becomes_the_sphere(browser, page):
    assert browser.open(f"{page.as_uri()}#morph=100&stage=conformal&colouring=plain") == "live"
    plain, coloured = choose(browser, wireframe=""), choose(browser, colouring="area")
    rows, columns = box(np.abs(coloured - plain).max(axis=2) > 0.06)
    round_box = (columns.stop - columns.start) / (rows.stop - rows.start)
    assert round_box == pytest.approx(1.0, abs=0.05)
    red, _, blue = coloured[rows, columns].reshape(-1, 3).mean(axis=0)
    assert red > blue  # most of the sphere is taken by what gained area
    wired = choose(browser, wireframe="1")
    darker = coloured[rows, columns].mean() - wired[rows, columns].mean()
    assert darker > 0.01


@pytest.fixture(scope="module")
def torus_page(tmp_path_factory) -> Path:
    ring = shapes.rings(1, cell=0.25)
    made = omtwarp.map_surface((ring.vertices, ring.faces), domain="torus")
    return write_report(made, tmp_path_factory.mktemp("torus") / "page.html", picture_size=200, device="cpu")


def test_a_torus_has_a_view_with_a_pattern_that_repeats(browser, torus_page):
    """The ring lies flat and shows spots of all hues, as a ring torus too, as large inside as outside by the map."""
    browser.complaints.clear()
    assert browser.open(f"{torus_page.as_uri()}#colouring=plain") == "live"
    plain, spotted = (choose(browser, colouring=name) for name in ("plain", "picture"))
    changed = np.abs(spotted - plain).max(axis=2) > 0.06
    rows, columns = box(changed)
    assert 0.2 < changed[rows, columns].mean() < 0.9  # round in a box
    assert columns.stop - columns.start > 1.5 * (rows.stop - rows.start)  # it lies flat, as it does in its file
    counts, _ = np.histogram(hue(spotted)[changed & (colourfulness(spotted) > 0.2)], 12, (-np.pi, np.pi))
    assert (counts > 0.02 * counts.sum()).sum() >= 6
    browser.open(f"{torus_page.as_uri()}#morph=100")
    ring = choose(browser, colouring="picture")
    assert (np.abs(ring - spotted).max(axis=2) > 0.1).mean() > 0.01
    ruled = choose(browser, colouring="graticule")
    assert (np.abs(ruled - ring).max(axis=2) > 0.1).mean() > 0.1
    grown = choose(browser, stage="conformal", colouring="area")
    red, _, blue = np.moveaxis(grown[np.abs(grown - plain).max(axis=2) > 0.1], -1, 0)
    assert (red > blue + 0.1).any() and (blue > red + 0.1).any()  # the inside gained area, the outside lost it
    assert browser.complaints == []


def test_other_stages_carry_the_texture_elsewhere(browser, page):
    browser.open(page.as_uri())
    optimal = choose(browser, stage="omt")
    conformal = choose(browser, stage="conformal")
    assert (np.abs(optimal - conformal).max(axis=2) > 0.2).mean() > 0.03
    np.testing.assert_allclose(choose(browser, stage="omt"), optimal, atol=0.02)


def test_keys_turn_the_view(browser, page):
    browser.open(page.as_uri())
    before = choose(browser, colouring="picture")
    browser.run(
        "for (let k = 0; k < 6; k++) document.getElementById('viewer-canvas')"
        ".dispatchEvent(new KeyboardEvent('keydown', {key: 'ArrowLeft', bubbles: true}))"
    )
    turned = browser.picture(STAGE)
    assert np.abs(turned - before).max(axis=2).mean() > 0.02
    browser.run("document.getElementById('viewer-home').click()")
    np.testing.assert_allclose(browser.picture(STAGE), before, atol=0.02)


def test_nothing_is_fetched_and_nothing_complained(browser, page):
    browser.requests.clear()
    browser.complaints.clear()
    assert browser.open(page.as_uri(), calm=False) == "live"
    assert {request.split(":")[0] for request in browser.requests} <= {"file", "data", "blob", "about"}
    assert [request for request in browser.requests if request.startswith("file")] == [page.as_uri()]
    assert browser.complaints == []
    assert browser.run("document.querySelectorAll('main svg.chart').length") == 3
    assert browser.run("document.documentElement.scrollWidth <= innerWidth")


def test_dark_where_dark_is_preferred(browser, page):
    light, dark = [], []
    for found, wanted in ((light, False), (dark, True)):
        browser.open(page.as_uri(), dark=wanted)
        found += [browser.picture(".page-head").mean(), browser.picture(".figures").mean()]
    assert min(light) > 0.8 and max(dark) < 0.3


def test_without_webgl_there_is_a_picture(page, tmp_path):
    browser = Browser(tmp_path, "--disable-3d-apis")
    try:
        assert browser.open(page.as_uri()) == "still"
        assert "cannot draw in 3D" in browser.run("document.getElementById('viewer-note').innerText")
        assert (colourfulness(browser.picture(STAGE)) > 0.25).mean() > 0.03
        assert not browser.run("document.getElementById('viewer-controls').offsetParent")
    finally:
        browser.close()
