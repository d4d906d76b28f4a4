#!/usr/bin/env python3
"""Count the package: lines of code, files, numeric constants, large functions, repeats, floors and loose modules.

A line of code holds a token that is neither a comment nor part of a docstring. A numeric constant is an assignment of
numbers alone at the level of a module. A repeat is a pair of runs of statements inside of functions, each of six lines
or more, that are the same but for names, numbers and texts: a name in one stands where one other name stands in the
other. What a function declares, its parameters and docstring, is no statement. Floors are how many packages and loose
modules at the top import one another in a row at the most, imports inside of functions and for type checkers included.
"""

from __future__ import annotations

import ast
import io
import itertools
import keyword
import sys
import tokenize
from collections import defaultdict
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
REPEATED_LINES = 6
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


Statement = tuple[int, tuple[tuple[bool, str], ...]]  # lines of code, and tokens: whether it is a name, and its text


def statements(text: str, tree: ast.Module) -> list[Statement | None]:
    """Return the statements inside of functions, each header of a block as one; None stands between functions."""
    inside: set[int] = set()
    outside: set[int] = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef):
            inside |= set(range(node.body[0].lineno, (node.end_lineno or 0) + 1))
            outside |= set(range(min([node.lineno, *(d.lineno for d in node.decorator_list)]), node.body[0].lineno))
        elif isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant):
            outside |= set(range(node.lineno, (node.end_lineno or 0) + 1))
    listed: list[Statement | None] = []
    tokens: list[tuple[bool, str]] = []
    lines: set[int] = set()
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        if token.type == tokenize.NEWLINE:
            listed.append((len(lines), tuple(tokens)) if tokens else None)
            tokens, lines = [], set()
        elif token.type not in NO_CODE and token.start[0] in inside - outside:
            named = token.type == tokenize.NAME and not keyword.iskeyword(token.string)
            kept = {tokenize.NUMBER: "0", tokenize.STRING: "''"}.get(token.type, token.string)
            tokens.append((named, kept))
            lines |= set(range(token.start[0], token.end[0] + 1))
    return listed


def repeats(files: list[list[Statement | None]]) -> int:
    """Return how many pairs of runs of statements, of all files, repeat each other."""
    places: dict[tuple[tuple[int | str, ...], ...], list[tuple[int, int, int]]] = defaultdict(list)
    for file, listed in enumerate(files):
        for first in range(len(listed)):
            numbers: dict[str, int] = {}
            run: list[tuple[int | str, ...]] = []
            lines = 0
            for statement in listed[first : first + REPEATED_LINES]:
                if statement is None:
                    break
                lines += statement[0]
                run.append(tuple(numbers.setdefault(t, len(numbers)) if name else t for name, t in statement[1]))
                if lines >= REPEATED_LINES:
                    places[tuple(run)].append((file, first, len(run)))
                    break
    pairs = {
        (f, i, g, j)
        for same in places.values()
        for (f, i, length), (g, j, _) in itertools.combinations(same, 2)
        if f != g or j - i >= length
    }
    return sum((f, i - 1, g, j - 1) not in pairs for f, i, g, j in pairs)


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
    listed = []
    for file in sorted(package.rglob("*.py")):
        text = file.read_text("utf-8")
        tree = ast.parse(text)
        listed.append(statements(text, tree))
        found["lines of code"] += code_lines(text, tree)
        found["files"] += 1
        found["numeric constants"] += constants(tree)
        found["functions over 80 lines or 20 branches"] += too_large(tree)
        own = file.relative_to(package).with_suffix("").parts[0]
        if own not in ENTRIES:
            needs.setdefault(own, set()).update(imported(tree))
    loose = {file.stem for file in package.glob("*.py")} - ENTRIES
    found[f"repeats of {REPEATED_LINES} lines"] = repeats(listed)
    return found | {"floors": floors(needs), "loose modules": len(loose)}


if __name__ == "__main__":
    sys.stdout.write("".join(f"{name}: {number:,}\n" for name, number in count().items()))
