"""Every example in a docstring runs; what the package offers has one, and describes every parameter."""

from __future__ import annotations

import doctest
import importlib
import inspect
import re
from pathlib import Path

import pytest

import omtwarp

PACKAGE = Path(omtwarp.__file__).parent
FLAGS = doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE


def modules_with_examples() -> list[str]:
    files = [file for file in sorted(PACKAGE.rglob("*.py")) if ">>> " in file.read_text("utf-8")]
    names = [".".join(file.relative_to(PACKAGE.parent).with_suffix("").parts) for file in files]
    return [name.removesuffix(".__init__") for name in names]


def public() -> list[str]:
    """Functions and classes that the package itself offers."""
    return [name for name in sorted(omtwarp.__all__) if callable(getattr(omtwarp, name))]


@pytest.mark.parametrize("name", modules_with_examples())
def test_examples_run(name, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    module = importlib.import_module(name)
    runner = doctest.DocTestRunner(optionflags=FLAGS)
    said: list[str] = []
    examples = [test for test in doctest.DocTestFinder(exclude_empty=True).find(module) if test.examples]
    assert examples, f"{name} has no example that doctest finds"
    for test in examples:
        runner.run(test, out=said.append)
    assert runner.summarize(verbose=False).failed == 0, "".join(said)


@pytest.mark.parametrize("name", public())
def test_what_the_package_offers_has_an_example(name):
    words = inspect.getdoc(getattr(omtwarp, name)) or ""
    assert ">>> " in words, f"omtwarp.{name} has no example in its docstring"


@pytest.mark.parametrize("name", [name for name in public() if inspect.isfunction(getattr(omtwarp, name))])
def test_docstring_describes_every_parameter_and_what_comes_back(name):
    function = getattr(omtwarp, name)
    words = inspect.getdoc(function) or ""
    signature = inspect.signature(function)
    for parameter in signature.parameters.values():
        if parameter.kind is not inspect.Parameter.VAR_KEYWORD:
            assert re.search(rf"^    [\w, *]*\b{parameter.name}\b[\w, *]*:", words, re.M), f"{name}: {parameter.name}"
    if signature.return_annotation not in ("None", None):
        assert "Returns:" in words, f"{name} does not say what it returns"
