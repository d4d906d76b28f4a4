"""Constants say what they bound, in a comment on their line or above, or in a text below."""

import ast
import io
import re
import tokenize
from pathlib import Path

import omtwarp

PACKAGE = Path(omtwarp.__file__).parent
# Names that say their values, and points of the compass.
SAYS_ITSELF = re.compile(
    r"^_?(ZERO|(ONE|TWO|THREE)?_?(HALF|THIRD|QUARTER|SIXTH|EIGHTH|TENTH)S?|ONE|TWO|FOUR|PI(_F)?|NORTH)$"
)


def is_number(node: ast.expr) -> bool:
    """Whether an expression is made of numbers alone, or wraps them for kernels."""
    if isinstance(node, ast.UnaryOp):
        return is_number(node.operand)
    if isinstance(node, ast.BinOp):
        return is_number(node.left) and is_number(node.right)
    if isinstance(node, ast.Tuple | ast.List):
        return bool(node.elts) and all(map(is_number, node.elts))
    if isinstance(node, ast.Call) and ast.unparse(node.func).startswith(("wp.", "np.")):
        return bool(node.args) and not node.keywords and all(map(is_number, node.args))
    return isinstance(node, ast.Constant) and isinstance(node.value, int | float) and not isinstance(node.value, bool)


def unexplained(file: Path) -> list[str]:
    """Constants of a module that are numbers, and of which nothing is said."""
    text = file.read_text("utf-8")
    lines, body = text.splitlines(), ast.parse(text).body
    commented = {t.start[0] for t in tokenize.generate_tokens(io.StringIO(text).readline) if t.type == tokenize.COMMENT}
    found = []
    for k, node in enumerate(body):
        if not isinstance(node, ast.Assign) or not is_number(node.value):
            continue
        first = node.lineno
        for before in reversed(body[:k]):  # a comment may stand above several
            if not isinstance(before, ast.Assign) or before.end_lineno != first - 1:
                break
            first = before.lineno
        last = max(node.end_lineno or 0, node.lineno)
        after = body[k + 1] if k + 1 < len(body) else None
        told = (
            isinstance(after, ast.Expr) and isinstance(after.value, ast.Constant) and isinstance(after.value.value, str)
        )
        beside = any(line in commented for line in range(node.lineno, last + 1))
        name = ast.unparse(node.targets[0]).strip("(").split(",")[0]
        if not (beside or told or lines[first - 2].startswith("#") or SAYS_ITSELF.match(name)):
            found.append(f"{file.relative_to(PACKAGE)}:{node.lineno} {name}")
    return found


def test_numbers_of_modules_say_what_they_bound():
    assert [line for file in sorted(PACKAGE.rglob("*.py")) for line in unexplained(file)] == []


def test_the_least_divisor_stands_in_one_place():
    bare = [
        file.name for file in sorted(PACKAGE.rglob("*.py")) if re.search(r"\b1(\.0)?e-300\b", file.read_text("utf-8"))
    ]
    assert bare == ["arrays.py"]
