"""Functions that are long or branch often say why they are one, in a sentence that begins with "One function, as"."""

import ast
from pathlib import Path

import pytest

PACKAGE = Path(__file__).resolve().parents[1] / "omtwarp"
SENTENCE = "One function, as "
MOST_LINES = 70  # from def on, without the docstring
MOST_BRANCHES = 19  # cyclomatic complexity (McCabe 1976), as radon counts it
BRANCHES = (ast.If, ast.IfExp, ast.For, ast.While, ast.ExceptHandler, ast.Assert, ast.match_case)
FUNCTIONS = (ast.FunctionDef, ast.AsyncFunctionDef)


def is_kernel(function: ast.FunctionDef | ast.AsyncFunctionDef) -> bool:
    """Whether Warp compiles a function; kernels are as long as what a thread does."""
    names = [ast.unparse(d.func if isinstance(d, ast.Call) else d) for d in function.decorator_list]
    return bool({"wp.kernel", "wp.func"} & set(names))


def line_count(function: ast.FunctionDef | ast.AsyncFunctionDef) -> int:
    assert function.end_lineno is not None
    lines = function.end_lineno - function.lineno + 1
    if ast.get_docstring(function) is not None:
        docstring = function.body[0]
        assert docstring.end_lineno is not None
        lines -= docstring.end_lineno - docstring.lineno + 1
    return lines


def branch_count(function: ast.AST) -> int:
    """One, and one for every way that goes off, those of functions inside included."""
    count = 1
    for node in ast.walk(function):
        count += isinstance(node, BRANCHES)
        count += len(node.values) - 1 if isinstance(node, ast.BoolOp) else 0
        count += 1 + len(node.ifs) if isinstance(node, ast.comprehension) else 0
    return count


def unexplained(source: str) -> list[str]:
    """Names of functions that are long or branch often, and do not say why."""
    found = []
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, FUNCTIONS) and not is_kernel(node):
            large = line_count(node) > MOST_LINES or branch_count(node) > MOST_BRANCHES
            if large and SENTENCE not in " ".join((ast.get_docstring(node) or "").split()):
                found.append(f"{node.name}: {line_count(node)} lines, {branch_count(node)} branches")
    return found


def test_long_functions_and_those_that_branch_often_say_why_they_are_one():
    found = {str(file.relative_to(PACKAGE)): unexplained(file.read_text("utf-8")) for file in PACKAGE.rglob("*.py")}
    assert len(found) > 100
    assert {file: names for file, names in found.items() if names} == {}


def test_a_long_function_is_found():
    lines = "    x = 1\n" * MOST_LINES
    documented = '    """{}"""\n'
    assert unexplained("def f():\n" + lines) == [f"f: {MOST_LINES + 1} lines, 1 branches"]
    assert unexplained("def f():\n" + lines[10:]) == []
    assert unexplained("def f():\n" + documented.format("Count.") + lines[10:]) == []
    assert unexplained("def f():\n" + documented.format("Count. One function,\n    as it says.") + lines) == []
    assert unexplained("@wp.kernel(enable_backward=False)\ndef f():\n" + lines) == []
    assert unexplained("class A:\n    def f(self):\n" + lines.replace("    ", "        ")) != []


@pytest.mark.parametrize(
    ("body", "branches"),
    [
        ("return 1", 1),
        ("return 1 if a else 2", 2),
        ("return a and b and c", 3),
        ("return [x for x in a if x if not b]", 4),
        ("assert a", 2),
        ("while a:\n        for b in a:\n            pass", 3),
        ("if a:\n        pass\n    elif b:\n        pass\n    else:\n        pass", 3),
        ("try:\n        pass\n    except A:\n        pass\n    except B:\n        pass", 3),
        ("match a:\n        case 1:\n            pass\n        case _:\n            pass", 3),
        ("def g():\n        if a:\n            pass", 2),
    ],
)
def test_branches_are_counted(body, branches):
    assert branch_count(ast.parse(f"def f():\n    {body}\n").body[0]) == branches
