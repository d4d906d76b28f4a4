"""The troubleshooting page has an entry for every error line, every defect and every warning."""

from __future__ import annotations

import ast
import re
from functools import cache
from pathlib import Path

import pytest

from omtwarp.mapping.verdict import Finding
from omtwarp.mesh.validate import Defect

ROOT = Path(__file__).parent.parent
PAGE = (ROOT / "docs" / "troubleshooting.md").read_text("utf-8")
ANY = "…"


def wording(node: ast.expr) -> str:
    """The text of a message, with ``…`` for what is put into it."""
    if isinstance(node, ast.Constant):
        return str(node.value)
    if isinstance(node, ast.JoinedStr):
        return "".join(str(part.value) if isinstance(part, ast.Constant) else ANY for part in node.values)
    if isinstance(node, ast.BinOp):
        return wording(node.left) + wording(node.right)
    return ANY


@cache
def messages() -> dict[str, str]:
    """Every message of an OmtwarpError that is written where it is raised, and the file that it is in."""
    found = {}
    for file in sorted((ROOT / "omtwarp").rglob("*.py")):
        for node in ast.walk(ast.parse(file.read_text("utf-8"))):
            if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id == "OmtwarpError":
                # Of two texts between which a condition chooses, both are messages.
                given = node.args[0]
                texts = [given.body, given.orelse] if isinstance(given, ast.IfExp) else [given]
                for words in map(wording, texts):
                    if re.search(r"\w", words.replace(ANY, "")):  # others pass on what was raised elsewhere
                        found[words] = file.relative_to(ROOT).as_posix()
    return found


@cache
def entries() -> dict[str, re.Pattern[str]]:
    """The lines that the page's tables name, as patterns."""
    found = {}
    for row in re.findall(r"^\| (`.*?) \|", PAGE, re.M):
        for words in re.findall(r"`([^`]+)`", row):
            parts = [re.escape(part) for part in words.split(ANY)]
            found[words] = re.compile(".*".join(parts) + ("" if words.endswith(ANY) else "$"), re.S)
    return found


def test_every_error_line_has_an_entry():
    patterns = [pattern for words, pattern in entries().items() if ANY in words or " " in words]
    missing = [f"{file}: {words}" for words, file in messages().items() if not any(p.match(words) for p in patterns)]
    assert not missing, "docs/troubleshooting.md has no entry for:\n" + "\n".join(missing)


def test_hardly_an_entry_is_about_nothing():
    """At most one entry in twenty of the page matches no message of the code."""
    stale = [
        words
        for words, pattern in entries().items()
        if (ANY in words or " " in words) and not any(pattern.match(message) for message in messages())
    ]
    assert len(stale) <= len(entries()) / 20, (
        "nothing reads like these entries of docs/troubleshooting.md:\n" + "\n".join(stale)
    )


@pytest.mark.parametrize("kind", [Defect, Finding], ids=["defect", "warning"])
def test_every_kind_has_an_entry(kind):
    described = re.search(r"kind: (.*?)\n {4,8}\w+:", kind.__doc__ or "", re.S)
    assert described is not None
    names = re.findall(r"``([a-z-]+)``", described[1])
    assert len(names) >= 6
    assert [name for name in names if name not in entries()] == []
