"""The script that counts the package counts what it says."""

import ast
import importlib.util
from pathlib import Path

import pytest

SCRIPT = Path(__file__).parents[1] / ".ci" / "count.py"
if not SCRIPT.is_file():
    pytest.skip("the script is not beside the tests", allow_module_level=True)
SPEC = importlib.util.spec_from_file_location("count", SCRIPT)
assert SPEC is not None and SPEC.loader is not None
COUNT = importlib.util.module_from_spec(SPEC)
SPEC.loader.exec_module(COUNT)

BASE = '''"""Say nothing."""

# A comment.
ONE, TWO = 1.0, 2
LIMIT = 3 * 4
"""Of something."""
NAME = "a"
EPSILON: float = -1e-9


def f(
    x,
):
    """Return
    what is given."""

    return """two
lines"""
'''


def test_a_package_is_counted(tmp_path):
    for name, text in {
        "__init__": "",
        "base": BASE,
        "middle/__init__": "from omtwarp.base import f\n",
        "middle/part": "from omtwarp.middle import f\n",
        "top": "def g():\n    from omtwarp import middle\n    import omtwarp.base\n",
    }.items():
        file = tmp_path / f"{name}.py"
        file.parent.mkdir(exist_ok=True)
        file.write_text(text, "utf-8")
    assert COUNT.count(tmp_path) == {
        "lines of code": 9 + 1 + 1 + 3,
        "files": 5,
        "numeric constants": 4,
        "functions over 80 lines or 20 branches": 0,
        "repeats of 6 lines": 0,
        "floors": 3,
        "loose modules": 2,
    }


@pytest.mark.parametrize(
    ("body", "large"),
    [
        ("    x = 1\n" * 79, 0),
        ("    x = 1\n" * 80, 1),
        ('    """Say\n' + "much.\n" * 80 + '    """\n    x = 1\n', 0),
        ("    x = 1 if x else 2\n" * 19, 0),
        ("    x = [y for y in z if y and x]\n" * 7, 1),
    ],
)
def test_large_functions_are_counted(body, large):
    source = "def f(x, z):\n" + body
    assert COUNT.too_large(ast.parse(source)) == large
    assert COUNT.too_large(ast.parse("@wp.kernel\n" + source)) == 0


def repeats(*texts):
    """How many repeats files of these texts have."""
    return COUNT.repeats([COUNT.statements(text, ast.parse(text)) for text in texts])


@pytest.mark.parametrize(
    ("other", "repeated"),
    [
        ("def g(a):\n    b = a + 1\n" + "    b = a * b\n" * 5, 1),  # other names
        ("def g(a):\n    y = 'text'\n    b = a + 2\n" + "    b = a * b\n" * 5, 1),  # another number, one line more
        ("def g(a):\n    b = a + 1\n" + "    b = b * a\n" * 5, 0),  # names in other places
        ("def g(a):\n    b = a + 1\n" + "    b = a * b\n" * 4, 0),  # five lines
        ("def g(a):\n    b = a + 1\n" + "    b = a * b\n" * 2 + "def h():\n" + "    b = a * b\n" * 3, 0),
    ],
)
def test_repeats_are_counted(other, repeated):
    one = "def f(x):\n    y = x + 1\n" + "    y = x * y\n" * 5
    assert repeats(one, other) == repeats(one + other) == repeated


def test_parameters_are_no_repeat():
    declared = "def f(\n" + "    x: int,\n" * 7 + "):\n    return x\n"
    assert repeats(declared, declared) == 0


def test_packages_that_import_each_other_have_no_floors():
    with pytest.raises(ValueError, match="a, b"):
        COUNT.floors({"a": {"b"}, "b": {"a"}, "c": set()})


LIMITS = {
    "lines of code": 30_300, "files": 230, "numeric constants": 300, "functions over 80 lines or 20 branches": 0,
    "repeats of 6 lines": 20, "floors": 12, "loose modules": 10,
}  # fmt: skip


def test_the_package_is_no_larger_than_a_reader_can_hold():
    figures = COUNT.count()
    assert figures.keys() == LIMITS.keys()
    assert [f"{name}: {figures[name]:,}" for name, most in LIMITS.items() if figures[name] > most] == []
