"""Hostile reports: whatever a map's file contains, its page holds no element and no script of the file's."""

from __future__ import annotations

import json
import re
from base64 import b64encode
from collections import Counter, defaultdict
from dataclasses import replace
from hashlib import sha256
from html.parser import HTMLParser

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from omtwarp.mesh import shapes
from omtwarp.reporting import report_page, scene
from omtwarp.reporting.record import REPORT
from omtwarp.result import MapResult

INJECTION = """</script></style></title><script>alert(1)</script><img src=x onerror="alert(1)">' onload='x' "><!--"""
BALL = shapes.icosphere(2)
PLAIN = MapResult(BALL.vertices, BALL.faces, BALL.vertices, BALL.vertices, np.ones(len(BALL.vertices)))


@pytest.fixture(autouse=True)
def words_only(monkeypatch):
    """No pictures, and of the view only its description, which holds texts."""

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
    """A report of a shape with the words in all its texts, and in its names where any name will do."""
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
    """Reports of about the right shape, with anything anywhere."""
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
    """A map that was turned inside out, with a certificate that claims the contrary."""
    claims = {"certificate": {"bijective": True, "flips": 0, "degree": 1.0}}
    page = report_page(replace(PLAIN, sphere=-PLAIN.sphere, conformal=-PLAIN.sphere, report=claims))
    assert f"{len(BALL.faces)} flipped triangles: not one to one" in page and "Certified" not in page


def test_a_report_of_deep_brackets_is_none(tmp_path):
    arrays = {"vertices": BALL.vertices, "faces": BALL.faces, "sphere": BALL.vertices, "conformal": BALL.vertices}
    for text in ("[" * 100_000, "{", "3", '{"history": 3, "stages": 3}', '{"history": [3, {"cost": "x"}]}'):
        np.savez(tmp_path / "map.npz", **arrays, density=np.ones(len(BALL.vertices)), report=np.array(text))
        assert "Certified one to one" in report_page(MapResult.load(tmp_path / "map.npz"))
