#!/usr/bin/env python3
"""Count the package: lines of code, files, numeric constants, large functions, floors and loose modules.

A line of code holds a token that is neither a comment nor part of a docstring. A numeric constant is an assignment of
numbers alone at the level of a module. Floors are how many packages and loose modules at the top import one another
in a row at the most, imports inside of functions and for type checkers included.
"""

from __future__ import annotations

import ast
import io
import sys
import tokenize
from pathlib import Path

PACKAGE = Path(__file__).resolve().parents[1] / "omtwarp"
NO_CODE = {
    tokenize.COMMENT,
    tokenize.NL,
    tokenize.NEWLINE,
    tokenize.INDENT,
    tokenize.DEDENT,
    tokenize.ENCODING,
    tokenize.ENDMARKER,
}
BRANCHES = (ast.If, ast.IfExp, ast.For, ast.While, ast.ExceptHandler, ast.Assert, ast.match_case)
MOST_LINES, MOST_BRANCHES = 80, 20
ENTRIES = {"__init__", "__main__"}  # the package itself and its command, which import from everywhere


def code_lines(text: str, tree: ast.Module) -> int:
    """Return how many lines hold code; texts that stand alone are docstrings, of constants too."""
    lines: set[int] = set()
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        if token.type not in NO_CODE:
            lines |= set(range(token.start[0], token.end[0] + 1))
    for node in ast.walk(tree):
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str):
            lines -= set(range(node.lineno, (node.end_lineno or node.lineno) + 1))
    return len(lines)


def is_number(node: ast.expr) -> bool:
    """Return whether an expression is made of numbers alone, or wraps them for kernels."""
    if isinstance(node, ast.UnaryOp):
        return is_number(node.operand)
    if isinstance(node, ast.BinOp):
        return is_number(node.left) and is_number(node.right)
    if isinstance(node, ast.Call) and ast.unparse(node.func).startswith(("wp.", "np.")):
        return bool(node.args) and not node.keywords and all(map(is_number, node.args))
    return isinstance(node, ast.Constant) and type(node.value) in (int, float)


def constants(tree: ast.Module) -> int:
    """Return how many names a module gives to numbers; a tuple of numbers gives as many as it has names."""
    count = 0
    for node in tree.body:
        if isinstance(node, ast.Assign | ast.AnnAssign) and node.value is not None:
            target = node.targets[0] if isinstance(node, ast.Assign) else node.target
            if isinstance(node.value, ast.Tuple) and all(map(is_number, node.value.elts)):
                count += len(target.elts) if isinstance(target, ast.Tuple) else 1
            else:
                count += is_number(node.value)
    return count


def too_large(tree: ast.Module) -> int:
    """Return how many functions are over 80 lines, docstring apart, or 20 branches (McCabe 1976); kernels are not."""
    count = 0
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef) and not any("wp." in ast.unparse(d) for d in node.decorator_list):
            lines = (node.end_lineno or 0) - node.lineno + 1
            if ast.get_docstring(node) is not None:
                lines -= (node.body[0].end_lineno or 0) - node.body[0].lineno + 1
            branches = 1
            for inner in ast.walk(node):
                branches += isinstance(inner, BRANCHES)
                branches += len(inner.values) - 1 if isinstance(inner, ast.BoolOp) else 0
                branches += 1 + len(inner.ifs) if isinstance(inner, ast.comprehension) else 0
            count += lines > MOST_LINES or branches > MOST_BRANCHES
    return count


def imported(tree: ast.Module) -> set[str]:
    """Return the packages and loose modules at the top that a module imports from."""
    names: set[str] = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and node.module == "omtwarp":
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and (node.module or "").startswith("omtwarp."):
            names.add(str(node.module).split(".")[1])
        elif isinstance(node, ast.Import):
            names |= {alias.name.split(".")[1] for alias in node.names if alias.name.startswith("omtwarp.")}
    return names


def floors(needs: dict[str, set[str]]) -> int:
    """Return the length of the longest row of packages of which each imports the next.

    Raises:
        ValueError: packages import each other.
    """
    heights: dict[str, int] = {}
    while len(heights) < len(needs):
        free = [n for n in needs if n not in heights and (needs[n] & needs.keys()) - {n} <= heights.keys()]
        if not free:
            raise ValueError(f"these import each other: {', '.join(sorted(needs.keys() - heights.keys()))}")
        for name in free:
            heights[name] = 1 + max((heights[other] for other in (needs[name] & needs.keys()) - {name}), default=0)
    return max(heights.values(), default=0)


def count(package: Path = PACKAGE) -> dict[str, int]:
    """Return the figures of a package, by name."""
    found = dict.fromkeys(("lines of code", "files", "numeric constants", "functions over 80 lines or 20 branches"), 0)
    needs: dict[str, set[str]] = {}
    for file in sorted(package.rglob("*.py")):
        text = file.read_text("utf-8")
        tree = ast.parse(text)
        found["lines of code"] += code_lines(text, tree)
        found["files"] += 1
        found["numeric constants"] += constants(tree)
        found["functions over 80 lines or 20 branches"] += too_large(tree)
        own = file.relative_to(package).with_suffix("").parts[0]
        if own not in ENTRIES:
            needs.setdefault(own, set()).update(imported(tree))
    loose = {file.stem for file in package.glob("*.py")} - ENTRIES
    return found | {"floors": floors(needs), "loose modules": len(loose)}


if __name__ == "__main__":
    sys.stdout.write("".join(f"{name}: {number:,}\n" for name, number in count().items()))
