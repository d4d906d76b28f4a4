"""Numbers that decide have names: no bare tolerance, factor or count stands inside a function."""

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

PACKAGE = Path(__file__).resolve().parents[1] / "omtwarp"

# Coefficients, units and shares that say themselves: whole numbers below a thousand, and these.
UNITS = {1e3, 1e6, 1e9, 1024, 65535}
SHARES = {0.5, 0.25, 0.125}
TOLERANCE, OVERFLOW = 1e-2, 1e12  # what is smaller or larger than these is no coefficient in any module
FEW = 8  # rounds of a loop that need no name: corners, sides, levels of a solid
# Modules that draw: proportions of a picture or of a made shape stand where they are drawn, but tolerances do not.
DRAWINGS = {
    "mesh/shapes.py",
    "render/annotate.py",
    "render/arrows.py",
    "render/films.py",
    "render/light.py",
    "render/output.py",
    "render/ray_kernels.py",
    "render/scene.py",
    "render/subject.py",
    "reporting/charts.py",
    "reporting/notebook.py",
    "reporting/page.py",
    "reporting/torus_page.py",
    "texturing/pattern_kernels.py",
    "texturing/patterns.py",
    "torus/pictures.py",
}
# Functions whose numbers are a published formula's, and the words of their docstrings that name it.
FORMULAS = {
    ("render/ray_kernels.py", "to_srgb"): "IEC 61966-2-1",
    ("start/decimation.py", "_scramble"): "MurmurHash3",
}


def numbers(node: ast.AST, counted: bool = False) -> Iterator[tuple[ast.Constant, bool]]:
    """Numbers in a function's body, and whether each counts the rounds of a loop.

    Left out are indices, annotations, functions inside, and defaults of parameters, which have the parameters' names.
    """
    for field, value in ast.iter_fields(node):
        if field in ("annotation", "returns", "decorator_list", "args") and not isinstance(node, ast.Call):
            continue
        if field == "slice" and isinstance(node, ast.Subscript):
            continue
        loop = counted or (isinstance(node, ast.Call) and ast.unparse(node.func) == "range")
        for child in value if isinstance(value, list) else [value]:
            if isinstance(child, ast.Constant) and type(child.value) in (int, float):
                yield child, loop
            elif isinstance(child, ast.AST) and not isinstance(child, ast.FunctionDef | ast.AsyncFunctionDef):
                yield from numbers(child, loop and not isinstance(child, ast.Call))


def decides(value: float, rounds: bool, drawn: bool) -> bool:
    """Whether a number is a tolerance, a factor or a count that wants a name."""
    if rounds and isinstance(value, int):
        return value > FEW
    if isinstance(value, int):
        return value >= 1000 and value not in UNITS
    if 0.0 < value < TOLERANCE or value >= OVERFLOW:
        return True
    whole = value == int(value) and value < 1000.0
    return not (whole or drawn or value in UNITS | SHARES)


def bare(source: str, name: str) -> list[str]:
    """Numbers of a module that decide and have no name."""
    found = []
    for function in ast.walk(ast.parse(source)):
        if not isinstance(function, ast.FunctionDef | ast.AsyncFunctionDef):
            continue
        formula = FORMULAS.get((name, function.name))
        if formula is not None and formula in (ast.get_docstring(function) or ""):
            continue
        for node, rounds in numbers(function):
            if decides(node.value, rounds, name in DRAWINGS):
                found.append(f"{name}:{node.lineno} {function.name}: {node.value}")
    return found


def test_numbers_that_decide_have_names():
    files = sorted(PACKAGE.rglob("*.py"))
    assert len(files) > 200
    found = [line for file in files for line in bare(file.read_text("utf-8"), file.relative_to(PACKAGE).as_posix())]
    assert not found, "\n".join(found)


def test_what_is_allowed_is_there():
    for name in DRAWINGS:
        assert (PACKAGE / name).is_file(), name
    for (name, function), formula in FORMULAS.items():
        tree = ast.parse((PACKAGE / name).read_text("utf-8"))
        node = next(n for n in ast.walk(tree) if isinstance(n, ast.FunctionDef) and n.name == function)
        assert formula in (ast.get_docstring(node) or ""), (name, function)


@pytest.mark.parametrize(
    ("body", "count"),
    [
        ("return x < 1e-12", 1),
        ("return wp.max(x, wp.float64(1.0e-30))", 1),
        ("step = 0.3 * step", 1),
        ("for _ in range(30):\n        pass", 1),
        ("if x > 20_000:\n        pass", 1),
        ("return x.clip(0.1, 0.9)", 2),
        ("return 0.5 * x + 12.0 / 7.0", 0),
        ("for k in range(3):\n        pass", 0),
        ("return 1e3 * x[12345] / 1024", 0),
        ("y: Annotated[float, 0.3] = x\n    return y", 0),
    ],
)
def test_a_bare_number_is_found(body, count):
    assert len(bare(f"def f(x, tolerance=1e-9):\n    {body}\n", "pipeline.py")) == count


def test_proportions_stay_where_they_are_drawn_and_tolerances_do_not():
    assert bare("def f(x):\n    return 0.3 * x\n", "reporting/charts.py") == []
    assert len(bare("def f(x):\n    return x + 1e-9\n", "reporting/charts.py")) == 1
