"""The direction of imports, what is imported when, and the public names."""

from __future__ import annotations

import ast
import copy
import inspect
import subprocess
import sys
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest

import femsense

PACKAGE = Path(femsense.__file__).parent
ROOMS = (
    ("core",),
    ("fem", "pointcloud", "qp"),
    ("model",),
    ("inference",),
    ("io",),
    ("calib",),
    ("control",),
    ("rig",),
    ("sensing",),
    ("loop",),
    ("xr",),
    ("live",),
    ("report",),
    ("many",),
    ("app",),
    ("__main__",),
)
"""Each sees its own room and those before it. Rooms on one floor take arrays and see nothing of each other."""
LOOP = ("thresholds", "options", "result", "data", "fit", "search", "verdict", "design", "files", "improve")
"""The same inside `loop/`."""
RIG_IS_FOR = {"rig", "design", "app"}
"""What estimates never sees the virtual rig; `loop/design` proposes experiments on it, and `app` runs it."""
HEAVY = {"open3d", "cv2", "trimesh", "matplotlib", "mpl_toolkits", "pytetwild", "pyvista"}
"""Imported inside the functions that use them."""
FILES = sorted(file for file in PACKAGE.rglob("*.py") if "viewer" not in file.parts and file.name != "__init__.py")
NAMES = [file.relative_to(PACKAGE).as_posix() for file in FILES]


def room_of(module: str) -> str:
    """Return the room of a module by its full name: femsense.fem.mesh is in fem."""
    return module.split(".")[1]


def floor_of(room: str) -> int:
    floor = next((i for i, rooms in enumerate(ROOMS) if room in rooms), -1)
    assert floor >= 0, f"{room} has no place in ROOMS of this test"
    return floor


def module_of(file: Path) -> str:
    """Return the full name of the module in a file."""
    return ".".join(("femsense", *file.relative_to(PACKAGE).with_suffix("").parts))


KNOWN = {module_of(file) for file in FILES}


def imported_modules(tree: ast.AST) -> Iterator[str]:
    """Yield the full names of what a tree imports, anywhere in it."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module == "femsense":
            yield from (f"femsense.{alias.name}" for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module is not None:
            yield node.module


def without_functions(tree: ast.AST) -> ast.AST:
    """Return a tree without the bodies of functions and of `if TYPE_CHECKING:`: what runs when the module is imported."""

    class Cut(ast.NodeTransformer):
        def visit_FunctionDef(self, node: ast.FunctionDef) -> None:
            return None

        def visit_If(self, node: ast.If) -> ast.AST | None:
            return None if ast.unparse(node.test) == "TYPE_CHECKING" else self.generic_visit(node)

    return Cut().visit(copy.deepcopy(tree))


@cache
def parse(file: Path) -> ast.AST:
    return ast.parse(file.read_text(encoding="utf-8"))


@cache
def inner_imports(file: Path) -> list[str]:
    """Return the modules of femsense that a file imports, names of modules that are imported from packages resolved."""
    found = []
    for node in ast.walk(parse(file)):
        if isinstance(node, ast.ImportFrom) and node.module and node.module.startswith("femsense"):
            inside = [f"{node.module}.{alias.name}" for alias in node.names]
            found += [name if name in KNOWN else node.module for name in inside]
        elif isinstance(node, ast.Import):
            found += [alias.name for alias in node.names if alias.name.startswith("femsense.")]
    return [name for name in found if name != "femsense"]


@pytest.mark.parametrize("file", FILES, ids=NAMES)
def test_imports_go_upwards(file: Path) -> None:
    room = room_of(module_of(file))
    for module in inner_imports(file):
        other = room_of(module)
        assert room == other or floor_of(other) < floor_of(room), f"{room} imports {module}, which is not below it"


@pytest.mark.parametrize("file", [f for f in FILES if f.relative_to(PACKAGE).parts[0] == "loop"], ids=lambda f: f.stem)
def test_imports_go_upwards_inside_the_loop(file: Path) -> None:
    own = module_of(file).split(".")[2]
    for module in inner_imports(file):
        if module.startswith("femsense.loop."):
            other = module.split(".")[2]
            assert own == other or LOOP.index(other) < LOOP.index(own), f"loop/{own} imports {module}, which is not below it"


@pytest.mark.parametrize("file", FILES, ids=NAMES)
def test_what_estimates_does_not_see_the_rig(file: Path) -> None:
    if not RIG_IS_FOR & set(module_of(file).split(".")):
        assert not [module for module in inner_imports(file) if room_of(module) == "rig"]


def test_no_circles() -> None:
    wanted = {module_of(file): set(inner_imports(file)) for file in FILES}
    todo = dict(wanted)
    while todo:
        free = [name for name, needs in todo.items() if not needs & todo.keys() - {name}]
        assert free, f"modules that import each other in a circle are among {sorted(todo)}"
        for name in free:
            del todo[name]


@pytest.mark.parametrize("file", sorted(PACKAGE.rglob("*.py")), ids=lambda file: file.relative_to(PACKAGE).as_posix())
def test_a_file_is_formatted_as_all_are(file: Path) -> None:
    text = file.read_text(encoding="utf-8")
    assert "fmt: skip" not in text and "fmt: off" not in text


@pytest.mark.parametrize("file", FILES, ids=NAMES)
def test_heavy_modules_are_imported_where_they_are_used(file: Path) -> None:
    found = {module.split(".")[0] for module in imported_modules(without_functions(parse(file)))} & HEAVY
    assert not found


def test_the_rules_are_seen_to_be_broken() -> None:
    source = "import open3d.t\nfrom femsense.app import cli\ndef f():\n    import cv2\n    from femsense.qp.solve import x\n"
    assert list(imported_modules(ast.parse(source))) == ["open3d.t", "femsense.app", "cv2", "femsense.qp.solve"]
    assert list(imported_modules(without_functions(ast.parse(source)))) == ["open3d.t", "femsense.app"]
    guarded = "if TYPE_CHECKING:\n    import trimesh\nif True:\n    import numpy\n"
    assert list(imported_modules(without_functions(ast.parse(guarded)))) == ["numpy"]


def modules_after(code: str) -> set[str]:
    """Return the modules that an interpreter of its own has loaded after some code."""
    end = "\nimport sys; print('\\n' + ' '.join(sys.modules), file=sys.stderr)"
    done = subprocess.run([sys.executable, "-c", code + end], capture_output=True, text=True, check=True, cwd=PACKAGE.parent)
    return set(done.stderr.splitlines()[-1].split())


@pytest.mark.parametrize(
    "code",
    [
        "import femsense",
        "from femsense.app.cli import run; assert run(['--help']) == 0",
        "from femsense.app.cli import run; assert run(['estimate', '--help']) == 0",
    ],
)
def test_help_and_the_bare_import_load_nothing_heavy(code: str) -> None:
    assert not modules_after(code) & ({"numpy", "scipy", "numba", "rich"} | HEAVY)


# What scripts import is there

ROOT = PACKAGE.parent
SCRIPTS = sorted(file for folder in ("benchmarks", "meshes", "scripts") for file in (ROOT / folder).rglob("*.py"))


def file_of(module: str) -> Path | None:
    """Return the file of a module of femsense; None where there is none."""
    path = ROOT.joinpath(*module.split("."))
    return next((file for file in (path.with_suffix(".py"), path / "__init__.py") if file.is_file()), None)


def defined_names(file: Path) -> set[str]:
    """Return the names that a module has, whichever branch or import gives them."""
    names = set(femsense.__all__) if file == PACKAGE / "__init__.py" else set()
    for node in ast.walk(parse(file)):
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            names.add(node.name)
        elif isinstance(node, ast.Import | ast.ImportFrom):
            names |= {(alias.asname or alias.name).split(".")[0] for alias in node.names}
        elif isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
            names.add(node.id)
    return names


def missing_imports(tree: ast.AST) -> Iterator[str]:
    """Yield what a tree imports of femsense that is not there."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (a.name for a in node.names if a.name.split(".")[0] == "femsense" and file_of(a.name) is None)
        elif isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] == "femsense":
            file = file_of(node.module)
            known = defined_names(file) if file else set()
            yield from (a.name for a in node.names if a.name not in known and file_of(f"{node.module}.{a.name}") is None)


@pytest.mark.parametrize("file", SCRIPTS, ids=lambda file: file.relative_to(ROOT).as_posix())
def test_scripts_import_what_is_there(file: Path) -> None:
    assert not list(missing_imports(parse(file)))


def test_a_missing_import_is_seen() -> None:
    gone = "import femsense.fem.cholesky\nfrom femsense.fem.mesh import TetMesh, nonsense\nfrom femsense import improve, core"
    assert list(missing_imports(ast.parse(gone))) == ["femsense.fem.cholesky", "nonsense"]


# How functions are called

MOST_DEFAULTS = 6
"""Beside `options`: a frozen type holds what else may be left out."""
FIXED_BY_CONTRACT = {"solve_equilibrium"}
"""Promised as it is: two drives of cables and two of chambers, loads, a start, and whether held cables push."""


def is_a_command(function: ast.FunctionDef) -> bool:
    """Return whether Typer calls a function: a command declares one parameter an option, and returns an `Answer`."""
    return function.returns is not None and ast.unparse(function.returns) == "Answer"


def defaulted(function: ast.FunctionDef) -> list[str]:
    """Return the names of the arguments that may be left out, beside `options`."""
    arguments = function.args
    plain = [a.arg for a in (*arguments.posonlyargs, *arguments.args)]
    named = [a.arg for a, default in zip(arguments.kwonlyargs, arguments.kw_defaults) if default is not None]
    return [name for name in (*plain[len(plain) - len(arguments.defaults) :], *named) if name != "options"]


def crowded_functions(tree: ast.AST) -> list[str]:
    """Return the names of functions with more defaulted arguments than one reads."""
    functions = [node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef) and not is_a_command(node)]
    return [f.name for f in functions if len(defaulted(f)) > MOST_DEFAULTS and f.name not in FIXED_BY_CONTRACT]


@pytest.mark.parametrize("file", FILES, ids=NAMES)
def test_beyond_six_defaults_there_is_an_options_type(file: Path) -> None:
    assert not crowded_functions(parse(file))


def test_a_crowded_function_is_seen() -> None:
    seven = "def f(x, *, a=1, b=2, c=3, d=4, e=5, f=6, g=7): ..."
    assert crowded_functions(ast.parse(seven)) == ["f"] and crowded_functions(ast.parse(seven.replace("*,", ""))) == ["f"]
    assert not crowded_functions(ast.parse(seven.replace("g=7", "options=None")))
    assert not crowded_functions(ast.parse(seven.replace(": ...", " -> Answer: ...")))


# The public names


def test_every_public_name_is_there_and_says_what_it_is() -> None:
    for name in femsense.__all__:
        value = getattr(femsense, name)
        assert name == "__version__" or (value.__doc__ and name in dir(femsense)), name
    with pytest.raises(AttributeError, match="no attribute 'nonsense'"):
        femsense.nonsense  # noqa: B018


@pytest.mark.parametrize(
    ("name", "operands", "keywords"),
    [
        ("load_robot", ["path_or_name"], []),
        ("load_recording", ["path"], []),
        ("solve_equilibrium", ["body"], ["tension", "shortening", "nodal_forces", "start"]),
        ("compliance", ["body", "equilibrium"], ["points", "directions"]),
        ("calibrate", ["robot", "recording"], []),
        ("estimate", ["robot", "recording", "calibration"], ["at", "progress"]),
        ("improve", ["robot", "recordings"], ["validation", "effects", "without", "progress"]),
        ("export_glb", ["run", "path"], []),
    ],
)
def test_signatures(name: str, operands: list[str], keywords: list[str]) -> None:
    parameters = inspect.signature(getattr(femsense, name)).parameters
    required = [p.name for p in parameters.values() if p.default is p.empty and p.kind is not p.KEYWORD_ONLY]
    assert required == operands
    assert set(keywords) <= {p.name for p in parameters.values() if p.kind is p.KEYWORD_ONLY}
