"""Words of what is published: no places of the machine where it was made, no options in messages of Python."""

from __future__ import annotations

import ast
import re
from pathlib import Path

ROOT = Path(__file__).parent.parent
SOURCES = [file for folder in ("omtwarp", "examples", "docs") for file in sorted((ROOT / folder).rglob("*.py"))]
PAGES = [file for folder in (".", "docs") for file in sorted((ROOT / folder).glob("*.md"))]
# Put together from pieces: this file does not name them either.
OUTER, INNER, LENT = "wo" + "rk", "lib" + "rary", "sha" + "red"
PLACES = re.compile(rf"(?<![\w.])/{OUTER}/|\.{INNER}\b|/{LENT}/(?:data|notes|cases)|\bissue \d+\b", re.I)


def test_no_place_of_the_machine_is_named():
    assert len(SOURCES) > 100
    found = [
        f"{file.relative_to(ROOT)}:{number}: {match[0]}"
        for file in SOURCES + PAGES
        for number, line in enumerate(file.read_text("utf-8").splitlines(), 1)
        for match in PLACES.finditer(line)
    ]
    assert found == []


def test_places_are_found_where_they_are():
    for text in (f"in /{OUTER}/out", f"~/.{INNER}", f"/{LENT}/data", "see issue 7"):
        assert PLACES.search(text)
    for text in (f"a/{OUTER}/b", f"the {INNER}", f"./{LENT}/more", "an issue"):
        assert not PLACES.search(text)


def texts_in(source: str) -> list[str]:
    """Return the texts of a module, those that stand alone left out: docstrings."""
    tree = ast.parse(source)
    alone = {node.value for node in ast.walk(tree) if isinstance(node, ast.Expr)}
    texts = [node for node in ast.walk(tree) if isinstance(node, ast.Constant) and node not in alone]
    return [text.value for text in texts if isinstance(text.value, str)]


def test_messages_of_python_name_no_option_of_commands():
    """``omtwarp.errors.OPTIONS`` has what the command line says in their place."""
    style = (ROOT / "omtwarp/reporting/assets/page.css").read_text("utf-8")
    ours = {*re.findall(r"--[a-z-]+", style), "--ink", "--no-install-recommends"}  # variables of pages, and apt-get's
    files = [file for file in SOURCES if file.is_relative_to(ROOT / "omtwarp") and "commands" not in file.parts]
    assert len(files) > 100
    named = [
        (str(file.relative_to(ROOT)), text)
        for file in files
        if file != ROOT / "omtwarp/errors.py"
        for text in texts_in(file.read_text("utf-8"))
        if {*re.findall(r"(?<![\w-])--[a-z][a-z-]+", text)} - ours
    ]
    assert named == []
    assert texts_in('"""In --docs."""\nx = f"use --cut {2}"\n') == ["use --cut "]
