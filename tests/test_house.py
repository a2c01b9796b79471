"""The rules of the house: floors, sizes, docstrings, doors, and a declaration that fits the programs."""

import ast
import builtins
import json
import re
import subprocess
import symtable
import sys
from functools import cache
from pathlib import Path

import pytest

from pipeline.core import config
from pipeline.workflow import dag, recipes, sources

ROOT = Path(__file__).parent.parent
FILES = sorted(
    path
    for top in ("pipeline", "stages")
    for path in (ROOT / top).rglob("*.py")
    if "node_modules" not in path.parts
)
FRONTS = sorted((ROOT / "stages").rglob("__main__.py"))
CONFIGS = sorted(path for path in FILES if path.name == "config.py" and path.parent.name != "core")
PACKAGES = (
    "core",
    "geometry",
    "mapping",
    "data",
    "recordings",
    "workflow",
    "backends",
    "localization",
    "fields",
    "behavior",
    "longterm",
    "baselines",
    "metrics",
    "environments",
    "adapters",
)
"""Packages of `pipeline/` in flow order: each imports itself and earlier ones."""
FOR_FRONTS_ONLY = "workflow"
"""The package that knows the disk: the science of stages does not."""


def name_of(path: Path) -> str:
    return path.relative_to(ROOT).as_posix()


def stage_of(front: Path) -> str:
    """Return the program's name: its room, or the room and the part that is a program of its own."""
    return ".".join(front.parent.relative_to(ROOT / "stages").parts)


@cache
def tree_of(path: Path) -> ast.Module:
    return ast.parse(path.read_text(), str(path))


def imports(path: Path) -> set[str]:
    """Return the absolute names that a file imports, wherever in the file."""
    names: set[str] = set()
    for node in ast.walk(tree_of(path)):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{name_of(path)}:{node.lineno}: imports are absolute"
            assert all(alias.name != "*" for alias in node.names), f"{name_of(path)}:{node.lineno}: import *"
            names |= {f"{node.module}.{alias.name}" for alias in node.names}
    return names


@pytest.mark.parametrize("path", FILES, ids=name_of)
def test_imports_go_downstairs_only(path):
    parts = path.relative_to(ROOT).with_suffix("").parts
    for name in imports(path):
        top, *rest = name.split(".")
        if top == "stages":
            assert parts[0] == "stages", f"the ground floor imports {name}"
            assert rest[0] == parts[1], f"a room imports another: {name}"
        if top == "pipeline" and parts[0] == "pipeline" and parts[1] != "__init__":
            assert PACKAGES.index(rest[0]) <= PACKAGES.index(parts[1]), f"{parts[1]} comes before {rest[0]}"
        if top == "pipeline" and parts[0] == "stages" and parts[-1] != "__main__":
            assert rest[0] != FOR_FRONTS_ONLY, f"science knows the disk: {name}"


@pytest.mark.parametrize("path", FILES, ids=name_of)
def test_sizes(path):
    lines = path.read_text().count("\n")
    assert lines <= (80 if path.name == "__main__.py" else 400), f"{lines} lines"
    longest_function = 60 if path.is_relative_to(ROOT / "pipeline") else 69
    for node in ast.walk(tree_of(path)):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            length = node.end_lineno - node.lineno + 1
            assert length <= longest_function, f"{node.name} has {length} lines"


@pytest.mark.parametrize("path", FILES, ids=name_of)
def test_docstrings(path):
    tree = tree_of(path)
    if tree.body:
        assert ast.get_docstring(tree), "the module has no docstring"
    for node in tree.body:
        if isinstance(node, ast.FunctionDef | ast.ClassDef) and not node.name.startswith("_"):
            if any(ast.unparse(each) == "overload" for each in node.decorator_list):
                continue  # the implementation has the docstring
            assert ast.get_docstring(node), f"{node.name} has no docstring"


@pytest.mark.parametrize("path", FILES, ids=name_of)
def test_names_and_marks(path):
    assert path.name not in {"utils.py", "helpers.py", "common.py", "misc.py"}
    assert not re.search(r"\b(TODO|FIXME|XXX)\b", path.read_text()), "no marks for later"
    for node in ast.walk(tree_of(path)):
        assert not (isinstance(node, ast.ExceptHandler) and node.type is None), (
            f"line {node.lineno}: bare except"
        )


def undefined(table: symtable.SymbolTable, known: set[str]) -> set[str]:
    """Return the names that a scope or one within it reads from the module, and that are not there."""
    here = {
        symbol.get_name() for symbol in table.get_symbols() if symbol.is_global() and symbol.is_referenced()
    }
    return (here - known).union(*(undefined(inner, known) for inner in table.get_children()))


@pytest.mark.parametrize("path", FILES, ids=name_of)
def test_every_name_is_defined(path):
    """The linter cannot tell: to it the shapes of arrays in annotations are names as well."""
    module = symtable.symtable(path.read_text(), str(path), "exec")
    own = {
        symbol.get_name() for symbol in module.get_symbols() if symbol.is_assigned() or symbol.is_imported()
    }
    assert not undefined(module, {*own, *dir(builtins), "__file__"})


@pytest.mark.parametrize("path", [*FRONTS, *CONFIGS], ids=name_of)
def test_settings_are_documented(path):
    """Every setting is typed, defaulted and documented beneath; its dataclass is frozen and names no
    `Any`.
    """
    for cls in (node for node in tree_of(path).body if isinstance(node, ast.ClassDef)):
        if path.name == "__main__.py" and cls.name != "Config":
            continue
        assert "frozen=True" in ast.unparse(cls.decorator_list[0])
        for field, following in zip(cls.body, [*cls.body[1:], None], strict=True):
            if isinstance(field, ast.AnnAssign):
                documented = isinstance(following, ast.Expr) and isinstance(following.value, ast.Constant)
                assert field.value is not None, f"{cls.name}.{field.target.id} has no default"
                assert documented, f"{cls.name}.{field.target.id} is not documented"
                assert "Any" not in ast.unparse(field.annotation), (
                    f"{cls.name}.{field.target.id} is of any type"
                )


@pytest.mark.parametrize("path", CONFIGS, ids=name_of)
def test_settings_are_importable_without_libraries(path):
    """A config module imports the standard library, the ground floor without libraries, and config modules
    alone.
    """
    for name in imports(path):
        top, *rest = name.split(".")
        ours = top in ("pipeline", "stages")
        plain = rest[:2] in (["core", "errors"], ["core", "config"], ["core", "videos"])
        assert top in sys.stdlib_module_names or (ours and (plain or "config" in rest)), f"imports {name}"


def test_the_planner_reads_settings_without_libraries():
    """All config modules can be imported together where no library is installed."""
    modules = [name_of(path).removesuffix(".py").replace("/", ".") for path in CONFIGS]
    code = (
        f"import importlib, sys; [importlib.import_module(name) for name in {modules!r}]; print(*sys.modules)"
    )
    loaded = subprocess.run(
        [sys.executable, "-SE", "-c", code], cwd=ROOT, capture_output=True, text=True, check=True
    )
    assert not {"numpy", "torch"} & set(loaded.stdout.split())


ALL_HELP = """
import contextlib, io, json, runpy, sys
found = {}
for stage in sys.argv[1:]:
    sys.argv, text = [stage, "--help"], io.StringIO()
    try:
        with contextlib.redirect_stdout(text):
            runpy.run_module(f"stages.{stage}", run_name="__main__")
    except SystemExit as end:
        found[stage] = end.code or 0, text.getvalue()
print(json.dumps(found))
"""
"""Prints what `--help` prints of each program. One process for all: to import the libraries takes seconds."""


@cache
def all_help() -> dict[str, tuple[int, str]]:
    environment = {"COLUMNS": "1000", "OMP_NUM_THREADS": "1", "PYTHONPATH": str(ROOT)}
    command = [sys.executable, "-c", ALL_HELP, *map(stage_of, FRONTS)]
    told = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, env=environment)
    assert told.returncode == 0, told.stderr
    return json.loads(told.stdout.splitlines()[-1])


def help_of(stage: str) -> str:
    code, text = all_help()[stage]
    assert code == 0, text
    return text


@pytest.mark.parametrize("path", FRONTS, ids=stage_of)
def test_every_door_opens(path):
    """`--help` works and tells what the front's docstring tells."""
    assert ast.get_docstring(tree_of(path)).splitlines()[0] in help_of(stage_of(path))


@pytest.mark.parametrize("node", dag.FLOW, ids=lambda node: node.artifact)
def test_the_declaration_fits_the_program(node):
    """What the flow hands to a program is what the program asks for, and nothing that it must have is left
    out.
    """
    usage = help_of(node.stage).split("\n\n")[0]
    handed = {f"--{need.option or need.artifact.replace('_', '-')}" for need in dag.needs_of(node)}
    handed |= {"--variants" for need in dag.needs_of(node) if need.variants}
    known = set(re.findall(r"--[a-z-]+", usage))
    required = set(re.findall(r"--[a-z-]+", re.sub(r"\[[^\]]*\]", "", usage)))
    assert handed <= known, f"{node.stage} does not know {handed - known}"
    assert required <= handed | {"--out"}, f"{node.stage} also needs {required - handed}"


def test_every_room_is_in_the_flow():
    """Every stage program has its place in the declaration; these stand beside it."""
    assert {stage_of(path) for path in FRONTS} == {node.stage for node in dag.FLOW} | {
        "simulate",
        "check_captures",
        "annotate",
        "compile_gallery",
        "export",
    }


def test_truth_is_for_evaluate_alone():
    """No source outside the room that makes truth and the one that judges by it speaks of a truth file."""
    for path in FILES:
        if path.parts[len(ROOT.parts)] == "stages" and path.parent.name not in {
            "synthesize_capture",
            "evaluate",
        }:
            strings = [
                n.value
                for n in ast.walk(tree_of(path))
                if isinstance(n, ast.Constant) and isinstance(n.value, str)
            ]
            assert not any("truth/" in text for text in strings), name_of(path)


@pytest.mark.parametrize("path", sorted((ROOT / "agents").rglob("*.toml")), ids=name_of)
def test_recipes_fit_the_programs(path):
    """Every table of every recipe loads into its stage's Config."""
    nodes = {dag.table_of(node): node for node in dag.FLOW}
    for name, table in recipes.read(path)[0].items():
        if name in ("videos", "flow"):  # no stage's
            continue
        stage = nodes[name].stage
        declared = sources.config_of(stage)
        config.from_table(declared, table, where=f"{path}: [{name}]")


def test_every_code_is_in_the_catalogue():
    """What a user may meet is explained in one place, and nothing else is."""
    strings = {
        n.value
        for path in FILES
        for n in ast.walk(tree_of(path))
        if isinstance(n, ast.Constant) and isinstance(n.value, str)
    }
    codes = {text for text in strings if re.fullmatch(r"[A-Z]{3}-\d{3}", text)}
    codes |= set(re.findall(r"\b[A-Z]{3}-\d{3}\b", (ROOT / "envs/setup").read_text()))
    told = re.findall(
        r"[A-Z]{3}-\d{3}",
        "".join(re.findall(r"^\| ([^|]*) \|", (ROOT / "ERRORS.md").read_text(), re.MULTILINE)),
    )
    assert len(codes) > 70
    assert sorted(told) == sorted(codes), f"{codes ^ set(told)}, or told twice"
