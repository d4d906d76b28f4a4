"""Kernels are written in one style: types of arrays, outputs, names and indices, read from the syntax tree."""

from __future__ import annotations

import ast
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parent.parent / "omtwarp"
OUTPUTS = ("# Data out", "# Data in and out")


def decorated(tree: ast.AST, name: str) -> Iterator[ast.FunctionDef]:
    """Functions with the decorator ``wp.<name>``, with or without arguments."""
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef):
            plain = [d.func if isinstance(d, ast.Call) else d for d in node.decorator_list]
            if any(ast.unparse(d) == f"wp.{name}" for d in plain):
                yield node


SOURCES = sorted(file for file in PACKAGE.rglob("*.py") if "@wp." in file.read_text("utf-8"))
FILES = [file for file in SOURCES if "@wp.kernel" in file.read_text("utf-8")]


def written(kernel: ast.FunctionDef) -> set[str]:
    """Arguments that the kernel itself stores to: ``a[i] = ``, ``a[i] += ``, ``wp.atomic_add(a, ...)``."""
    parameters = {argument.arg for argument in kernel.args.args}
    stored: list[ast.expr] = []
    for node in ast.walk(kernel):
        if isinstance(node, ast.Assign):
            stored += [part for t in node.targets for part in (t.elts if isinstance(t, ast.Tuple) else [t])]
        elif isinstance(node, (ast.AugAssign, ast.AnnAssign)):
            stored.append(node.target)
        elif isinstance(node, ast.Call) and ast.unparse(node.func).startswith("wp.atomic_"):
            stored.append(node.args[0])
    names = set()
    for target in stored:
        while isinstance(target, (ast.Subscript, ast.Attribute)):
            target = target.value
        if isinstance(target, ast.Name):
            names.add(target.id)
    return names & parameters


def array_types(source: str) -> list[str]:
    """What is wrong with the types of arrays in signatures and structs."""
    tree = ast.parse(source)
    annotations = [(a.arg, a.annotation) for k in ("kernel", "func") for f in decorated(tree, k) for a in f.args.args]
    for node in ast.walk(tree):
        if isinstance(node, ast.ClassDef):
            fields = [part for part in node.body if isinstance(part, ast.AnnAssign)]
            annotations += [(ast.unparse(field.target), field.annotation) for field in fields]
    calls = [(name, kind) for name, kind in annotations if isinstance(kind, ast.Call)]
    return [f"{name}: {ast.unparse(kind)}" for name, kind in calls if ast.unparse(kind.func).startswith("wp.array")]


def outputs(source: str) -> list[str]:
    """What is wrong with how kernels mark their outputs."""
    lines = source.splitlines()
    wrong = []
    for kernel in decorated(ast.parse(source), "kernel"):
        marks = [
            number
            for number in range(kernel.lineno, kernel.body[0].lineno)
            if lines[number - 1].strip().startswith(OUTPUTS) and lines[number - 1].rstrip().endswith(":")
        ]
        if not marks:
            wrong.append(f"{kernel.name} marks no output")
            continue
        before = {argument.arg for argument in kernel.args.args if argument.lineno < marks[0]}
        wrong += [f"{kernel.name} writes to {name} above the mark" for name in sorted(written(kernel) & before)]
        if len(before) == len(kernel.args.args):
            wrong.append(f"{kernel.name} has nothing below the mark")
    return wrong


def names(source: str) -> list[str]:
    """What is wrong with the names of kernels."""
    wrong = []
    for kernel in decorated(ast.parse(source), "kernel"):
        words = kernel.name.split("_")
        if len(words) < 2 or not all(words):
            wrong.append(f"{kernel.name}: two words or more")
        if words[-1] == "kernel":
            wrong.append(f"{kernel.name}: the ending says nothing")
        if any(word.isdigit() for word in words):
            wrong.append(f"{kernel.name}: say what the number is (_b2 for blocks of two)")
    return wrong


def indices(source: str) -> list[str]:
    """Indices of a thread that are thrown away under another name than the one that says why."""
    wrong = []
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Assign) and ast.unparse(node.value) == "wp.tid()":
            taken = node.targets[0].elts if isinstance(node.targets[0], ast.Tuple) else []
            unused = [ast.unparse(name) for name in taken if ast.unparse(name).startswith("_")]
            if unused not in ([], ["_compiled_once"]):
                wrong.append(ast.unparse(node))
    return wrong


def late_reads(source: str) -> list[str]:
    """Several elements of arrays assigned at once where the arrays are written to: Warp reads them at their use."""
    wrong = []
    for function in (f for kind in ("kernel", "func") for f in decorated(ast.parse(source), kind)):
        changed = written(function)
        for node in ast.walk(function):
            if isinstance(node, ast.Assign) and isinstance(node.value, ast.Tuple):
                read = [part.value for part in node.value.elts if isinstance(part, ast.Subscript)]
                if any(isinstance(array, ast.Name) and array.id in changed for array in read):
                    wrong.append(f"{function.name}: {ast.unparse(node)}")
    return wrong


CHECKS = (array_types, outputs, names, indices, late_reads)


@pytest.mark.parametrize("check", CHECKS, ids=lambda check: check.__name__)
def test_kernels_are_in_one_style(check):
    assert len(FILES) > 20
    found = {str(file.relative_to(PACKAGE)): check(file.read_text("utf-8")) for file in SOURCES}
    assert {file: wrong for file, wrong in found.items() if wrong} == {}


def test_no_two_kernels_have_one_name():
    count = Counter(k.name for file in FILES for k in decorated(ast.parse(file.read_text("utf-8")), "kernel"))
    assert [name for name, times in count.items() if times > 1] == []


def test_what_is_against_the_style_is_found():
    good = """
@wp.kernel
def scale_values(
    factor: wp.float64,
    # Data in and out:
    values: wp.array[wp.float64],
):
    i, _compiled_once = wp.tid()
    values[i] = factor * values[i]
"""
    assert [wrong for check in CHECKS for wrong in check(good)] == []
    assert array_types(good.replace("wp.array[wp.float64]", "wp.array(dtype=wp.float64)")) != []
    assert outputs(good.replace("# Data in and out:", "# Values:")) == ["scale_values marks no output"]
    turned = good.replace("    # Data in and out:\n", "").replace("    factor: ", "    # Data out:\n    factor: ")
    assert outputs(turned) == []
    early = "@wp.kernel\ndef f_g(\n    a: wp.array[int],\n    # Data out:\n    b: wp.array[int],\n):\n"
    assert outputs(early + "    wp.atomic_add(a, 0, 1)\n") == ["f_g writes to a above the mark"]
    assert outputs(early + "    a[0] += b[0]\n") == ["f_g writes to a above the mark"]
    for name in ("scale", "scale_kernel", "scale_2"):
        assert len(names(good.replace("scale_values", name))) == 1
    assert names(good.replace("scale_values", "scale_b2")) == []
    assert indices(good.replace("_compiled_once", "_")) != []
    both = good.replace("    values[i] = factor * values[i]", "    a, b = values[i], values[0]\n    values[i] = a + b")
    assert late_reads(both) == ["scale_values: a, b = (values[i], values[0])"]
