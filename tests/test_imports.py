"""Sub-packages import downwards only, in the order of the table of docs/architecture.md."""

import ast
import re
import sys
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "omtwarp"

# Imported inside of functions: what is optional or slow to load, and is not needed by everyone who loads the module.
# On the command line everything but the options is, so that ``omtwarp --help`` answers at once.
HEAVY = {
    "IPython",
    "OpenGL",
    "PIL",
    "distributed",
    "fcntl",  # not on Windows, and so is resource
    "imageio_ffmpeg",
    "matplotlib",
    "meshio",
    "nibabel",
    "nvmath",
    "nilearn",
    "ot",
    "polyscope",
    "pyarrow",
    "pygltflib",
    "pyrender",
    "pyvista",
    "resource",
    "rich",
    "scipy",  # parts of it that few maps need; scipy.linalg once BLAS is told how many threads to use
    "submitit",
    "threadpoolctl",
    "trimesh",
}
HEAVY_ROOMS = {
    # Kernels that few maps launch: reading their text takes as long as a tenth of a small map.
    "omtwarp.mapping": {"omtwarp.baselines", "omtwarp.moser", "omtwarp.transport.flow", "omtwarp.transport.paper"},
    "omtwarp.optimal": {"omtwarp.start.hierarchical"},
    "omtwarp.start": {"omtwarp.start.hierarchical"},
    "omtwarp.open_surfaces": {"omtwarp.start.hierarchical"},
    # A driver waits for processes, and draws pictures, and registers a group, at the end.
    "omtwarp.cohort": {"omtwarp.cohort.page", "omtwarp.registration"},
    # A picture by OpenGL needs no Warp, and the process that draws it nothing but its own modules.
    "omtwarp.render": {
        "omtwarp.device",
        "omtwarp.texturing.painted",
        "omtwarp.texturing.read",
        "omtwarp.render.ray_caster",
        "omtwarp.render.pyrender_",
        "omtwarp.maps",
        "omtwarp.texturing.smooth",
        "omtwarp.texturing.textured",
    },
}


def module_name(file: Path) -> str:
    parts = list(file.relative_to(ROOT).with_suffix("").parts)
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


FILES = {module_name(file): file for file in sorted(PACKAGE.rglob("*.py"))}


def imports(module: str) -> list[tuple[str, bool]]:
    """Modules that a module imports, and whether it does so inside of a function."""
    found = []

    def visit(node: ast.AST, inside: bool) -> None:
        inside = inside or isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)
        if isinstance(node, ast.Import):
            found.extend((alias.name, inside) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{module} imports relatively"
            for alias in node.names:
                full = f"{node.module}.{alias.name}"
                found.append((full if full in FILES else str(node.module), inside))
        for child in ast.iter_child_nodes(node):
            visit(child, inside)

    visit(ast.parse(FILES[module].read_text("utf-8")), False)
    return found


def own_imports(module: str) -> set[str]:
    """The package's modules that a module imports; of the package itself only its name, which needs no other."""
    return {name for name, _ in imports(module) if name.split(".")[0] == "omtwarp" and name != module}


def room_of(module: str) -> str:
    """The sub-package or top-level module that a module belongs to."""
    return ".".join(module.split(".")[:2])


def allowed_order() -> list[str]:
    """Rooms from the lowest to the highest, as the table of the architecture page lists them."""
    page = (ROOT / "docs" / "architecture.md").read_text("utf-8")
    table = page.split("## Sub-packages")[1].split("## ")[0]
    rows = [row.split("|")[1] for row in table.splitlines() if row.startswith("| `")]
    return ["omtwarp." + name for row in rows for name in re.findall(r"`(\w+)/?`", row)]


ROOMS = {room_of(module) for module in FILES if module not in ("omtwarp", "omtwarp.__main__")}


def test_the_table_has_every_room_once():
    order = allowed_order()
    assert len(order) == len(set(order))
    assert set(order) >= ROOMS


@pytest.mark.parametrize("room", sorted(ROOMS))
def test_rooms_import_downwards_only(room):
    order = allowed_order()
    lower = set(order[: order.index(room) + 1])
    wrong = {
        f"{module} imports {name}"
        for module in FILES
        if room_of(module) == room
        for name in own_imports(module)
        if name != "omtwarp" and room_of(name) not in lower
    }
    assert not wrong


def test_no_files_import_each_other():
    """Imports for type checkers count too: names that two files need of each other belong into a third."""
    left = {module: own_imports(module) & set(FILES) - {"omtwarp"} for module in FILES if module != "omtwarp"}
    while left:
        free = [module for module, needs in left.items() if not needs & set(left)]
        assert free, f"these import each other: {sorted(left)}"
        for module in free:
            del left[module]


@cache
def runtime_imports(module: str) -> list[str]:
    """Modules that are loaded with a module: not those that functions or type checkers alone import."""
    found = []

    def visit(node: ast.AST) -> None:
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            return
        if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test):
            return
        if isinstance(node, ast.Import):
            found.extend(alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            full = [f"{node.module}.{alias.name}" for alias in node.names]
            found.extend(name if name in FILES else str(node.module) for name in full)
        for child in ast.iter_child_nodes(node):
            visit(child)

    visit(ast.parse(FILES[module].read_text("utf-8")))
    return found


def is_slow_to_load(module: str) -> bool:
    """Whether a module loads more than the standard library and click, itself or by others, or loads on demand."""
    left, seen = [module], set()
    while left:
        name = left.pop()
        parents = [name.rsplit(".", k)[0] for k in range(name.count("."))] if name in FILES else [name]
        for one in set(parents) - seen - {"omtwarp"}:
            seen.add(one)
            if one in FILES:
                if re.search(
                    r"^(def __getattr__|__all__, __getattr__, __dir__ =)", FILES[one].read_text("utf-8"), re.MULTILINE
                ):
                    return True
                left += runtime_imports(one)
            elif one.split(".")[0] not in sys.stdlib_module_names | {"omtwarp", "click"}:
                return True
    return False


@pytest.mark.parametrize("module", sorted(name for name in FILES if name.startswith("omtwarp.commands.")))
def test_commands_load_inside_of_functions_what_is_slow_to_load(module):
    """What is slow to load never stands at the top of a command, and what is not never stands elsewhere."""
    assert not [name for name in runtime_imports(module) if is_slow_to_load(name)]
    inside = {name for name, in_function in imports(module) if in_function}
    assert not [name for name in inside if not is_slow_to_load(name)]


def test_modules_that_are_slow_to_load_are_known():
    assert (
        is_slow_to_load("numpy")
        and is_slow_to_load("omtwarp.mapping.pipeline")
        and is_slow_to_load("omtwarp.mesh.read")
    )
    assert is_slow_to_load("omtwarp.texturing")  # names are loaded with it when they are asked for
    assert not is_slow_to_load("omtwarp.options") and not is_slow_to_load("json")


@pytest.mark.parametrize("module", sorted(set(FILES) - {"omtwarp"}))
def test_imports_stand_at_the_top(module):
    if module.startswith(("omtwarp.commands", "omtwarp.commands._cli", "omtwarp.__main__")):
        pytest.skip("commands load what is slow inside of functions, and their entry does all, behind its handler")
    inside = {name for name, in_function in imports(module) if in_function}
    rooms = HEAVY_ROOMS.get(room_of(module), set())
    wrong = {
        name
        for name in inside
        if not any(name == heavy or name.startswith(heavy + ".") for heavy in HEAVY)
        and not name.startswith(tuple(rooms) or ("-",))
    }
    assert not wrong


def test_modules_are_loaded_by_name_where_names_are_looked_up_alone():
    """Whatever else loads a module by its name hides an import from the tests above."""
    by_name = {module for module, file in FILES.items() if "import_module(" in file.read_text("utf-8")}
    packages = {module for module in by_name if FILES[module].name == "__init__.py"}
    assert by_name - packages == {"omtwarp.device.prewarm"}  # which compiles the kernels of every module


INSIDES = re.compile(
    r"\bsys\.modules\[|sys\.modules\.setdefault|\b(np|scipy|wp|warp)\.__(?!version)|warp\._src|scipy\._lib"
)


def inner_names(tree: ast.AST, defined: bool) -> set[str]:
    """Names with an underscore that a module defines, or that it asks other objects for."""
    names = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Attribute):
            names |= {node.attr} if isinstance(node.ctx, ast.Store) == defined else set()
        elif defined and isinstance(node, ast.FunctionDef | ast.ClassDef):
            names.add(node.name)
        elif defined and isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
            names.add(node.id)
    return {name for name in names if name.startswith("_") and not name.endswith("__")}


def test_nothing_reaches_into_other_libraries():
    """What pyrender is broken without stands in one file, with the addresses of the reports."""
    texts = {module: file.read_text("utf-8") for module, file in FILES.items()}
    own = {"_exit"} | {name for text in texts.values() for name in inner_names(ast.parse(text), True)}
    used = {module for module, text in texts.items() if inner_names(ast.parse(text), False) - own}
    found = {module for module, text in texts.items() if INSIDES.search(text)}
    assert found == {"omtwarp.render.pyrender_compat"} and used <= found
    assert len(re.findall(r"github\.com/\w+/\w+/issues/\d+", texts["omtwarp.render.pyrender_compat"])) == 6
    assert inner_names(ast.parse("a._b = c._d(e._f)"), False) == {"_d", "_f"}
