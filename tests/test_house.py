"""Rules of the architecture: imports, sizes, docstrings, command lines, and a flow that fits the programs."""

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
COMMAND_LINES = sorted((ROOT / "stages").rglob("__main__.py"))
CONFIGS = sorted(path for path in FILES if path.name == "config.py" and path.parent.name != "core")
PACKAGES = (
    "core",
    "geometry",
    "mapping",
    "data",
    "recordings",
    "calibration",
    "workflow",
    "backends",
    "segmentation",
    "localization",
    "fields",
    "behavior",
    "longterm",
    "baselines",
    "metrics",
    "environments",
    "adapters",
)
"""Packages of `pipeline/` in import order: each imports itself and earlier ones."""
FOR_COMMAND_LINES_ONLY = "workflow"
"""The package that accesses the disk; only `__main__` modules of stages import it."""


def name_of(path: Path) -> str:
    return path.relative_to(ROOT).as_posix()


def stage_of(main_file: Path) -> str:
    """Return the dotted name of a program below `stages`."""
    return ".".join(main_file.parent.relative_to(ROOT / "stages").parts)


@cache
def tree_of(path: Path) -> ast.Module:
    return ast.parse(path.read_text(), str(path))


def imports(path: Path) -> set[str]:
    """Return the absolute names that a file imports anywhere."""
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
def test_imports_respect_the_layers(path):
    parts = path.relative_to(ROOT).with_suffix("").parts
    for name in imports(path):
        top, *rest = name.split(".")
        if top == "stages":
            assert parts[0] == "stages", f"pipeline imports {name}"
            assert rest[0] == parts[1], f"a stage imports another: {name}"
        if top == "pipeline" and parts[0] == "pipeline" and parts[1] != "__init__":
            assert PACKAGES.index(rest[0]) <= PACKAGES.index(parts[1]), f"{parts[1]} comes before {rest[0]}"
        if top == "pipeline" and parts[0] == "stages" and parts[-1] != "__main__":
            assert rest[0] != FOR_COMMAND_LINES_ONLY, f"only __main__ may import {name}"


@pytest.mark.parametrize("path", FILES, ids=name_of)
def test_files_and_functions_are_small(path):
    lines = path.read_text().count("\n")
    assert lines <= (80 if path.name == "__main__.py" else 400), f"{lines} lines"
    longest_function = 60 if path.is_relative_to(ROOT / "pipeline") else 69
    for node in ast.walk(tree_of(path)):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            length = node.end_lineno - node.lineno + 1
            assert length <= longest_function, f"{node.name} has {length} lines"


@pytest.mark.parametrize("path", FILES, ids=name_of)
def test_public_names_have_docstrings(path):
    tree = tree_of(path)
    if tree.body:
        assert ast.get_docstring(tree), "the module has no docstring"
    for node in tree.body:
        if isinstance(node, ast.FunctionDef | ast.ClassDef) and not node.name.startswith("_"):
            if any(ast.unparse(each) == "overload" for each in node.decorator_list):
                continue  # the implementation has the docstring
            assert ast.get_docstring(node), f"{node.name} has no docstring"


@pytest.mark.parametrize("path", FILES, ids=name_of)
def test_no_catch_all_modules_markers_or_bare_excepts(path):
    assert path.name not in {"utils.py", "helpers.py", "common.py", "misc.py"}
    assert not re.search(r"\b(TODO|FIXME|XXX)\b", path.read_text()), "no TODO markers"
    for node in ast.walk(tree_of(path)):
        assert not (isinstance(node, ast.ExceptHandler) and node.type is None), (
            f"line {node.lineno}: bare except"
        )


def undefined(table: symtable.SymbolTable, known: set[str]) -> set[str]:
    """Return the names that a scope or an inner one reads from the module and that it does not define."""
    here = {
        symbol.get_name() for symbol in table.get_symbols() if symbol.is_global() and symbol.is_referenced()
    }
    return (here - known).union(*(undefined(inner, known) for inner in table.get_children()))


@pytest.mark.parametrize("stage", sorted({node.stage for node in dag.FLOW if node.gpu}))
def test_stages_with_a_gpu_are_tested_on_a_simulated_device(stage):
    """`tests/stages/<stage>/test_device.py` runs what the stage does on its device."""
    path = ROOT.joinpath("tests", "stages", *stage.split("."), "test_device.py")
    assert path.exists() and "with simulated_device():" in path.read_text(), f"{name_of(path)} is missing"


@pytest.mark.parametrize("path", FILES, ids=name_of)
def test_every_name_is_defined(path):
    """The linter cannot check this: array shapes in annotations look like undefined names."""
    module = symtable.symtable(path.read_text(), str(path), "exec")
    own = {
        symbol.get_name() for symbol in module.get_symbols() if symbol.is_assigned() or symbol.is_imported()
    }
    assert not undefined(module, {*own, *dir(builtins), "__file__"})


@pytest.mark.parametrize("path", [*COMMAND_LINES, *CONFIGS], ids=name_of)
def test_settings_are_documented(path):
    """Every field has a type other than `Any`, a default and a docstring; its dataclass is frozen."""
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
    """A config module imports only the standard library, dependency-free modules of `pipeline.core`, and config modules."""
    for name in imports(path):
        top, *rest = name.split(".")
        ours = top in ("pipeline", "stages")
        plain = rest[:2] in (["core", "errors"], ["core", "config"], ["core", "videos"])
        assert top in sys.stdlib_module_names or (ours and (plain or "config" in rest)), f"imports {name}"


def test_config_modules_import_without_libraries():
    """Importing all config modules loads neither NumPy nor torch."""
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
"""Prints the help of each program, in one process, since importing the libraries takes seconds."""


@cache
def all_help() -> dict[str, tuple[int, str]]:
    environment = {"COLUMNS": "1000", "OMP_NUM_THREADS": "1", "PYTHONPATH": str(ROOT)}
    command = [sys.executable, "-c", ALL_HELP, *map(stage_of, COMMAND_LINES)]
    completed = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, env=environment)
    assert completed.returncode == 0, completed.stderr
    return json.loads(completed.stdout.splitlines()[-1])


def help_of(stage: str) -> str:
    code, text = all_help()[stage]
    assert code == 0, text
    return text


@pytest.mark.parametrize("path", COMMAND_LINES, ids=stage_of)
def test_help_shows_the_docstring(path):
    assert ast.get_docstring(tree_of(path)).splitlines()[0] in help_of(stage_of(path))


@pytest.mark.parametrize("node", dag.FLOW, ids=lambda node: node.artifact)
def test_flow_fits_the_options_of_the_program(node):
    """The flow passes only known options, and all required ones."""
    usage = help_of(node.stage).split("\n\n")[0]
    passed = {f"--{need.option or need.artifact.replace('_', '-')}" for need in dag.needs_of(node)}
    passed |= {"--variants" for need in dag.needs_of(node) if need.variants}
    known = set(re.findall(r"--[a-z-]+", usage))
    required = set(re.findall(r"--[a-z-]+", re.sub(r"\[[^\]]*\]", "", usage)))
    assert passed <= known, f"{node.stage} does not know {passed - known}"
    assert required <= passed | {"--out"}, f"{node.stage} also needs {required - passed}"


def test_every_stage_is_in_the_flow():
    """Every program belongs to the flow, except these."""
    assert {stage_of(path) for path in COMMAND_LINES} == {node.stage for node in dag.FLOW} | {
        "simulate",
        "check_captures",
        "annotate",
        "compile_gallery",
        "export",
    }


def test_only_synthesis_and_evaluation_use_ground_truth():
    """No other stage mentions a truth file."""
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
def test_recipes_load(path):
    """Every table of every recipe loads into the `Config` of its stage."""
    nodes = {dag.table_of(node): node for node in dag.FLOW}
    for name, table in recipes.read(path)[0].items():
        if name in ("videos", "flow"):  # not of a stage
            continue
        stage = nodes[name].stage
        declared = sources.config_of(stage)
        config.from_table(declared, table, where=f"{path}: [{name}]")


def test_every_code_is_documented_in_errors():
    """`ERRORS.md` explains exactly the error codes of the sources, each once."""
    strings = {
        n.value
        for path in FILES
        for n in ast.walk(tree_of(path))
        if isinstance(n, ast.Constant) and isinstance(n.value, str)
    }
    codes = {text for text in strings if re.fullmatch(r"[A-Z]{3}-\d{3}", text)}
    codes |= set(re.findall(r"\b[A-Z]{3}-\d{3}\b", (ROOT / "envs/setup").read_text()))
    documented = re.findall(
        r"[A-Z]{3}-\d{3}",
        "".join(re.findall(r"^\| ([^|]*) \|", (ROOT / "ERRORS.md").read_text(), re.MULTILINE)),
    )
    assert len(codes) > 70
    assert sorted(documented) == sorted(codes), f"{codes ^ set(documented)}, or documented twice"
