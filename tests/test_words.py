"""Nothing that is published names a place of the machine where it was made."""

from __future__ import annotations

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
