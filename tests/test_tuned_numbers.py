"""The numbers on the way from a closed surface to its default map: those that are tuned, and why the others are not."""

import ast
import re
from pathlib import Path

from test_constants import is_number

import omtwarp

PACKAGE = Path(omtwarp.__file__).parent

WAY = (
    "conformal mapping optimal untangling start flips solvers moser.py geometry/axes.py geometry/intrinsic.py"
).split()
ELSEWHERE = (
    # Other kinds of surfaces, options, and maps that are judged.
    "mapping/any_surface.py mapping/verdict.py optimal/density.py optimal/exact.py optimal/plane.py "
    "optimal/refinement.py flips/guard.py solvers/cudss.py"
).split()

# A tuned number changes the map, and was chosen by what comes out: more of one thing for less of another.
TUNED = {
    "optimal/nested.py": "SHAPE_SHARE AREA_FACTOR VERTICES_PER_COARSE PENALTIES",
    "optimal/solver.py": "PENALTY",
    "optimal/steps.py": "MOST_HELD",
    "optimal/local.py": "GAIN_SHARE MAX_GAIN_SHARE MAX_CHOSEN_SHARE FREED_RINGS",
    "solvers/motion_kernels.py": "NEXT_SHARE",
    "solvers/triangle.py": "AREA_WEIGHT",
    "untangling/untangle.py": "RINGS LOWERED CONFORMAL_AREA_WEIGHT",
    "start/hierarchical.py": "SWEEPS COARSE_WEIGHT",
    "start/decimation.py": "EVEN_SHARE CHEAPER_SHARE FREE_VALENCE",
}
OTHERS = {
    # Where an iteration ends: less takes longer for the same map.
    "tolerance": {
        "conformal/centring.py": "TOLERANCE",
        "conformal/maps.py": "GAIN",
        "optimal/cells.py": "MAX_RING_RMS MAX_RING_ERROR MAX_CELL_RMS MAX_CELL_ERROR",
        "optimal/energy.py": "exact_tolerance",
        "optimal/nested.py": "PENALISED_GAIN",
        "optimal/solver.py": "GAIN LOCAL_GAIN_SHARE LEAST_AREA_GAIN",
        "optimal/turns.py": "LEAST_TURNED",
        "untangling/untangle.py": "LARGEST_EPSILON SMALLEST_EPSILON SETTLED_GAIN",
        "moser.py": "courant",
        "solvers/cholesky/multifrontal.py": "ACCURACY",
    },
    # Work that is allowed at most: what ends well needs less.
    "bound of work": {
        "conformal/centring.py": "MAXIMUM_STEPS",
        "conformal/maps.py": "STEPS",
        "optimal/local.py": "MAX_OPERATIONS MAX_STEPS",
        "optimal/patch_kernels.py": "MAX_HALVINGS",
        "optimal/nested.py": "STEPS PENALISED_STEPS",
        "optimal/solver.py": "MAX_HALVINGS",
        "solvers/cholesky/multifrontal.py": "REFINEMENTS",
        "moser.py": "SHORTEST_STEP MAX_STEPS",
        "start/hierarchical.py": "insertion_attempts",
        "start/hierarchical_kernels.py": "_HALVINGS",
        "optimal/steps.py": "holds",
        "untangling/untangle.py": "ROUND_STEPS STEP_WORK WORK_PER_VERTEX MAX_HALVINGS",
    },
    # What keeps matrices solvable and quotients finite, and below what rounding decides.
    "regularisation": {
        "conformal/centring.py": "MAX_CENTRE",
        "geometry/axes.py": "SMALLEST_DIFFERENCE OBLIQUE",
        "geometry/intrinsic.py": "ROUND_OFF least most",
        "optimal/energy.py": "LEAST_EIGENVALUE REGULARISATION STIFFER",
        "optimal/kernels.py": "LINE",
        "optimal/patch_kernels.py": "REGULARISATION",
        "optimal/nested.py": "APART LEAST_COST LEAST_BEND",
        "optimal/solver.py": "LEAST_PENALTY MIN_COST",
        "optimal/turns.py": "SHORTEST",
        "flips/exact.py": "SCALE UNIT_ROUNDOFF",
        "solvers/motion_kernels.py": "ROUND_OFF",
        "solvers/newton.py": "DIAGONAL_SHIFTS",
        "start/choice.py": "SMALLEST_AREA",
        "start/hierarchical.py": "_LEAST_DETERMINANT part",
        "start/hierarchical_kernels.py": "_SAFE_DETERMINANT",
        "untangling/untangle.py": "FATTENED DAMPING",
    },
    # Of line searches and barriers, which say how a minimum is reached and not which.
    "safeguard": {
        "optimal/solver.py": "CORRECTED",
        "optimal/shape.py": "NEEDLE_SHARE",
        "optimal/shape_kernels.py": "STEEP_COSINE",
        "solvers/motion_kernels.py": "MIN_VOLUME_SHARE LEAST_SHARE",
        "solvers/newton.py": "SUFFICIENT_DECREASE",
        "start/decimation.py": "WORST_SHAPE",
        "start/hierarchical_kernels.py": "_SUFFICIENT_DECREASE",
    },
    # Sizes of arrays and blocks, and from where on threads share: maps are the same without.
    "size": {
        "flips/exact.py": "_CERTAIN UNCERTAIN",
        "optimal/nested.py": "LEAST_COARSE MOST_COARSE",
        "optimal/patch_kernels.py": "DEFINITE MERIT EXPECTED LENGTH",
        "moser.py": "parts",
        "solvers/cholesky/dissection.py": "MAX_LEAF_VERTICES CUT_WINDOW MIN_REFINED BAND_RINGS",
        "solvers/cholesky/envelope.py": "COLUMNS smoothings",
        "solvers/cholesky/multifrontal.py": "MIN_PARALLEL_OPERATIONS MIN_SHARED_NUMBERS MIN_LIMITED_OPERATIONS"
        " BRANCHES_PER_THREAD",
        "solvers/cholesky/saddle.py": "UNKNOWNS COORDINATES",
        "optimal/local.py": "MIN_SHARED_TRIANGLES BLOCK",
        "start/decimation.py": "MAX_VALENCE INSIDE RIM POLE",
    },
    # The paper's and elementary geometry's.
    "constant of nature": {
        "optimal/cells.py": "CORNER_SHARE MIDDLE_SHARE",
        "solvers/triangle.py": "EQUILATERAL_HEIGHT",
    },
    # Of options that the default map does not take, and of what the report calls optimal.
    "option or report": {
        "mapping/pipeline.py": "FAR_GAP FAR_CURL FAR_COST NO_BOUND DISTANCE_SHAPE GAP_ASCENT_STEPS AREAS_OF_HALVES",
        "optimal/energy.py": "SHAPE_WEIGHT",
        "optimal/solver.py": "SOFTNESS",
        "start/hierarchical.py": "HEMISPHERE_SWEEPS",
    },
}


def modules() -> list[str]:
    """The modules on the way, by their paths in the package."""
    files = [file for name in WAY for file in ([PACKAGE / name] if "." in name else (PACKAGE / name).rglob("*.py"))]
    return sorted({str(file.relative_to(PACKAGE)) for file in files} - set(ELSEWHERE))


def is_kernel(node: ast.AST) -> bool:
    return isinstance(node, ast.FunctionDef) and any("wp." in ast.unparse(one) for one in node.decorator_list)


def numbers(module: str) -> dict[str, int]:
    """Names that a module gives to numbers, and their lines: at its level, and in functions to others than 0, 1 and 2.

    Kernels begin sums with numbers; what they are tuned by stands at the level of their module.
    """
    names = {}

    def visit(node: ast.AST, inside: bool) -> None:
        if is_kernel(node):
            return
        if isinstance(node, ast.Assign) and is_number(node.value):
            targets, values = node.targets[0], node.value
            pairs = (
                zip(targets.elts, values.elts, strict=True) if isinstance(targets, ast.Tuple) else [(targets, values)]
            )
            for target, value in pairs:
                if isinstance(target, ast.Name) and not (
                    inside and ast.unparse(value) in {"0", "0.0", "1", "1.0", "2"}
                ):
                    names[target.id] = node.lineno
        for child in ast.iter_child_nodes(node):
            visit(child, inside or isinstance(node, ast.FunctionDef))

    visit(ast.parse((PACKAGE / module).read_text("utf-8")), False)
    return names


def listed(table: dict[str, str]) -> set[tuple[str, str]]:
    return {(module, name) for module, names in table.items() for name in names.split()}


def comment(module: str, line: int) -> str:
    """What is said beside a line and above it."""
    lines = (PACKAGE / module).read_text("utf-8").splitlines()
    above = line - 2
    while lines[above].startswith("#"):
        above -= 1
    return " ".join(lines[above + 1 : line])


def test_at_most_twenty_numbers_are_tuned():
    assert len(listed(TUNED)) <= 20


def test_a_tuned_number_says_what_more_or_less_of_it_does():
    silent = [
        f"{module} {name}"
        for module, name in sorted(listed(TUNED))
        if not re.search(
            r"\b(more|less|fewer|larger|smaller|slower|half|twice|with(out)?)\b", comment(module, numbers(module)[name])
        )
    ]
    assert silent == []


def test_every_other_number_is_none_that_is_tuned():
    found = {(module, name) for module in modules() for name in numbers(module)}
    others = [pair for table in OTHERS.values() for pair in listed(table)]
    assert len(others) == len(set(others)) and not set(others) & listed(TUNED)
    assert found == set(others) | listed(TUNED)
