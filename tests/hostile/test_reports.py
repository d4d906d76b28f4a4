"""Hostile reports: whatever a map's file contains, its page holds no element and no script of the file's."""

from __future__ import annotations

import json
import re
from base64 import b64encode
from collections import Counter, defaultdict
from dataclasses import replace
from hashlib import sha256
from html.parser import HTMLParser
from types import SimpleNamespace

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings, strategies as st
from PIL import Image

from omtwarp.cohort.page import write_page
from omtwarp.maps.result import MapResult
from omtwarp.mesh import shapes
from omtwarp.reporting import report_page, scene, write_report
from omtwarp.reporting.stages import REPORT
from omtwarp.shape_analysis import study_group
from omtwarp.shape_analysis.reports import write_group_report

INJECTION = """</script></style></title><script>alert(1)</script><img src=x onerror="alert(1)">' onload='x' "><!--"""
BALL = shapes.icosphere(2)
PLAIN = MapResult(BALL.vertices, BALL.faces, BALL.vertices, BALL.vertices, np.ones(len(BALL.vertices)))


@pytest.fixture(autouse=True)
def words_only(monkeypatch):
    """Leave out pictures and, of the view, all but its description, which holds texts."""

    def described(result, stages, *args, **options):
        labels = [{"key": stage.key, "label": stage.label} for stage in stages]
        return scene.Scene(json.dumps({"stages": labels}), "", len(result.faces))

    monkeypatch.setattr("omtwarp.reporting.page.make_scene", described)
    monkeypatch.setattr("omtwarp.reporting.page._stills", lambda *a: defaultdict(lambda: "data:,"))


class Elements(HTMLParser):
    """The elements of a page, the names of their attributes, and the text of its scripts."""

    def __init__(self, text: str):
        super().__init__()
        self.tags, self.attributes, self.scripts = Counter(), set(), []
        self.policy = ""
        self.feed(text)

    def handle_starttag(self, tag, attributes):
        self.tags[tag] += 1
        self.attributes |= {(tag, name) for name, _ in attributes}
        self.policy += (
            dict(attributes).get("content", "") if ("http-equiv", "Content-Security-Policy") in attributes else ""
        )
        if tag == "script":
            self.scripts.append([dict(attributes).get("type", "text/javascript"), ""])

    def handle_data(self, data):
        if self.scripts and self.cdata_elem == "script":
            self.scripts[-1][1] += data


def filled(shape, words):
    """Fill a report's texts, and its names where any is allowed, with given words."""
    if isinstance(shape, dict):
        return {words if name == "*" else name: filled(inner, words) for name, inner in shape.items()}
    return [filled(shape[0], words)] if isinstance(shape, list) else words


def test_no_field_of_a_report_becomes_an_element():
    harmless, hostile = (
        Elements(report_page(replace(PLAIN, report=filled(REPORT, words)), title=words)) for words in ("x", INJECTION)
    )
    assert hostile.tags == harmless.tags and hostile.attributes == harmless.attributes
    assert [text for kind, text in hostile.scripts if kind == "text/javascript"] == [
        text for kind, text in harmless.scripts if kind == "text/javascript"
    ]
    described = next(text for kind, text in hostile.scripts if kind == "application/json")
    assert json.loads(described)["stages"][0]["label"] == INJECTION.capitalize()


def test_only_the_packages_own_scripts_may_run():
    page = Elements(report_page(replace(PLAIN, report=filled(REPORT, INJECTION)), title=INJECTION))
    allowed = re.search(r"script-src ([^;]*)", page.policy)[1].split()
    run = [text for kind, text in page.scripts if kind == "text/javascript"]
    assert len(run) == 2 and "unsafe" not in " ".join(allowed)
    assert allowed == [f"'sha256-{b64encode(sha256(text.encode()).digest()).decode()}'" for text in run]


json_values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=8),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=4), inner, max_size=3),
    max_leaves=6,
)


def like(shape):
    """Generate reports of about the expected structure with arbitrary values."""
    if isinstance(shape, dict):
        fields = {name if name != "*" else "omtwarp": like(inner) for name, inner in shape.items()}
        return st.fixed_dictionaries({}, optional=fields) | json_values
    return (st.lists(like(shape[0]), max_size=3) if isinstance(shape, list) else json_values) | json_values


@settings(max_examples=60)
@given(like(REPORT), st.lists(like({"iteration": "number", "cost": "number"}), max_size=4) | json_values)
def test_any_report_makes_a_page(report, history):
    page = report_page(replace(PLAIN, report=report, history=history))
    assert "Certified one to one" in page


def test_what_a_file_says_of_itself_is_measured_again(tmp_path):
    """The page of an inverted map shows measured flips, whatever the certificate in its file claims."""
    claims = {"certificate": {"bijective": True, "flips": 0, "degree": 1.0}}
    page = report_page(replace(PLAIN, sphere=-PLAIN.sphere, conformal=-PLAIN.sphere, report=claims))
    assert f"{len(BALL.faces)} flipped triangles: not one to one" in page and "Certified" not in page


def test_a_report_of_deep_brackets_is_none(tmp_path):
    arrays = {"vertices": BALL.vertices, "faces": BALL.faces, "sphere": BALL.vertices, "conformal": BALL.vertices}
    for text in ("[" * 100_000, "{", "3", '{"history": 3, "stages": 3}', '{"history": [3, {"cost": "x"}]}'):
        np.savez(tmp_path / "map.npz", **arrays, density=np.ones(len(BALL.vertices)), report=np.array(text))
        assert "Certified one to one" in report_page(MapResult.load(tmp_path / "map.npz"))


@pytest.fixture
def no_drawing(monkeypatch):
    """Replace every picture that a page draws by a small one."""
    for module in ("cohort.page", "shape_analysis.reports", "reporting.page"):
        monkeypatch.setattr(f"omtwarp.{module}.preview", lambda *a, **k: Image.new("RGB", (2, 2)))
    monkeypatch.setattr("omtwarp.reporting.page.torus_view", lambda *a, **k: SimpleNamespace(up=None))


def torus_page(folder, words):
    """The page of a map to a torus whose report, read from its file, has the words in every field."""
    ring = trimesh.creation.torus(1.0, 0.4, major_sections=8, minor_sections=5)
    count = len(ring.vertices)
    report = filled(REPORT, words) | {words: words, "certificate": {words: words}}
    made = MapResult(
        ring.vertices, ring.faces, coordinates=np.zeros((count, 2)), wraps=np.zeros((len(ring.faces), 3, 2), int),
        lattice=np.eye(2), conformal=np.zeros((count, 2)), domain="torus", report=report,
    )  # fmt: skip
    made.save(folder / "torus.npz")
    return write_report(MapResult.load(folder / "torus.npz"), folder / "page.html", title=words)


def open_surface_page(folder, words):
    """The page of a map of a surface with a hole, whose report has the words in every field."""
    report = filled(REPORT, words) | {"surface": {"domain": words, words: words}, "warnings": [{"text": words}]}
    made = MapResult(PLAIN.vertices, PLAIN.faces[1:], PLAIN.sphere, PLAIN.sphere, PLAIN.density, report=report)
    made.save(folder / "open.npz")
    (folder / "page.html").write_text(report_page(MapResult.load(folder / "open.npz"), title=words), "utf-8")
    return folder / "page.html"


def cohort_page(folder, words):
    """The page of a cohort with the words as names, statuses and messages of items."""
    failed = {"id": words, "path": words, "status": "error", "message": words, words: words}
    done = [{"id": f"{words}{k}", "path": words, "status": "ok", "area": 2.0 + k, "seconds": 1.0} for k in range(3)]
    return write_page([failed, failed | {"status": words}, *done], folder)


def group_page(folder, words):
    """The page of a group with the words as names of shapes and of groups."""
    maps = [replace(PLAIN, vertices=PLAIN.vertices * [1.0, 1.2 + 0.1 * k, 1.5 + 0.05 * k**2]) for k in range(6)]
    labels = ["a", words] * 3
    study = study_group(maps, grid="ico1", degree=2, components=1, labels=labels, permutations=9, device="cpu")
    return write_group_report(study, folder / "study", [f"{words}{k}" for k in range(6)], labels)[-1]


@pytest.mark.parametrize("page", [torus_page, open_surface_page, cohort_page, group_page])
def test_every_other_page_is_escaped_too(tmp_path, no_drawing, page):
    harmless, hostile = (Elements(page(tmp_path, words).read_text("utf-8")) for words in ("x", INJECTION))
    assert hostile.tags == harmless.tags and hostile.attributes == harmless.attributes
    assert hostile.scripts == harmless.scripts or page is open_surface_page
    assert "unsafe" not in "".join(re.findall(r"script-src ([^;]*)", hostile.policy))
    assert "default-src 'none'" in hostile.policy
