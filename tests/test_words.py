"""Nothing that is published names a place of the workplace where it was made."""

from __future__ import annotations

import re
from pathlib import Path

ROOT = Path(__file__).parent.parent
SOURCES = [file for folder in ("omtwarp", "examples", "docs") for file in sorted((ROOT / folder).rglob("*.py"))]
PAGES = [file for folder in (".", "docs") for file in sorted((ROOT / folder).glob("*.md"))]
PLACES = re.compile(r"(?<![\w.])/work/|\.library\b|/shared/(?:data|notes|cases)|\bissue \d+\b", re.I)


def test_no_place_of_the_workplace_is_named():
    assert len(SOURCES) > 100
    found = [
        f"{file.relative_to(ROOT)}:{number}: {match[0]}"
        for file in SOURCES + PAGES
        for number, line in enumerate(file.read_text("utf-8").splitlines(), 1)
        for match in PLACES.finditer(line)
    ]
    assert found == []
