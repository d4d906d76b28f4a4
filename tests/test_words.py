"""Prose in documentation, docstrings and comments uses the terms of CONTRIBUTING's glossary and no retired ones."""

from __future__ import annotations

import ast
import io
import re
import tokenize
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
PAGES = [ROOT / name for name in ("README.md", "CONTRIBUTING.md", "SECURITY.md", "CHANGELOG.md")]
PAGES += sorted((ROOT / "docs").glob("*.md"))
SOURCES = [file for folder in ("omtwarp", "examples", "tests") for file in sorted((ROOT / folder).rglob("*.py"))]
# Words and phrases that were replaced, and what to write in their place.
RETIRED = {
    r"mend(s|ed|ing)?": "repair, untangle",
    r"nought": "zero",
    r"hand(s|ed)? (on|over)": "return, pass",
    r"made ready": "prepared",
    r"without a word": "without an error",
    r"hopeless": "the property meant, such as degenerate",
    r"said of": "reported about",
}
PATTERN = re.compile(rf"\b(?:{'|'.join(RETIRED)})\b", re.I)


def prose(file: Path) -> Iterator[tuple[int, str]]:
    """Yield the numbered lines of a page, or of a source's docstrings and comments, without names in code."""
    text = file.read_text("utf-8")
    if file.suffix == ".md":
        lines = dict(enumerate(text.splitlines(), 1))
    else:
        lines = {}
        for node in ast.walk(ast.parse(text)):
            if isinstance(node, (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)) and (
                ast.get_docstring(node) is not None
            ):
                expression = node.body[0]
                first, last = expression.lineno, expression.end_lineno or expression.lineno
                lines |= dict(enumerate(text.splitlines()[first - 1 : last], first))
        for token in tokenize.generate_tokens(io.StringIO(text).readline):
            if token.type == tokenize.COMMENT:
                lines[token.start[0]] = token.string
    for number, line in lines.items():
        yield number, re.sub(r"``[^`]*``|`[^`]*`", "", line)


@pytest.mark.parametrize("files", [PAGES, SOURCES], ids=["pages", "sources"])
def test_no_retired_word_is_used(files):
    found = [
        f"{file.relative_to(ROOT)}:{number}: {match[0]}"
        for file in files
        for number, line in prose(file)
        for match in PATTERN.finditer(line)
    ]
    assert not found, "plain terms are in CONTRIBUTING's glossary and in RETIRED; retired ones in\n" + "\n".join(found)


NOUN_PHRASE = re.compile(r"(The|A|An|One|Every|Each|Whether|How|Which|Where|What|Why|Some|Those)\b")
DESCRIPTIVE = ("property", "fixture", "overload")  # decorators of functions whose docstrings are nouns


def test_docstrings_of_functions_begin_with_a_verb():
    found = []
    for file in SOURCES:
        if file.is_relative_to(ROOT / "omtwarp"):
            for node in ast.walk(ast.parse(file.read_text("utf-8"))):
                if isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef)):
                    described = any(word in ast.unparse(d) for d in node.decorator_list for word in DESCRIPTIVE)
                    if not described and NOUN_PHRASE.match(ast.get_docstring(node) or ""):
                        found.append(f"{file.relative_to(ROOT)}:{node.lineno}: {node.name}")
    assert not found, "begin these docstrings with a verb in the imperative:\n" + "\n".join(found)
