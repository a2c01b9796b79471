"""Count properties that affect readability: lines, recipe keys, packages, words, array shapes, literals, cycles.

    python -m benchmarks.codebase_counts [--list COUNT]

Prints one line per count; `--list` prints the locations behind one of them. `tests/test_codebase.py` holds the
limits.
"""

import ast
import dataclasses
import importlib
import io
import math
import re
import tokenize
from collections import Counter
from collections.abc import Iterator
from functools import cache
from pathlib import Path

from benchmarks import command_lines

ROOT = Path(__file__).parent.parent
MAX_COLUMNS = 110
PRIVATE_WORDS = frozenset(
    "minds told tells kept strange torn mended bare slid firmness quicken pace habits haunts sees beside aside "
    "buried drafted bent missed led cheapest relax relatives alike likeness bore strayed shy bold".split()
)
"""Former project-specific words for terms that have established names in the field; see docs/glossary.md."""
FILE_FORMAT_KEYS = ("pace_m",)
"""Identifiers that are keys of file formats: `pace_m` is one of `longterm.json`."""
SELF_EXPLANATORY = frozenset((60, 90, 180, 255, 127.5, 360, 0.5, 0.25, 2.5, 97.5, 95, 99, 99.5))
"""Self-explanatory numbers; so are integers below 10, powers of two and of ten, the largest values of integer types
(127, 65535), the bounds of a 95 % interval, tail percentiles, and small constants that avoid a division by zero."""
CALLS_WITH_NAMED_NUMBERS = ("Check", "qa.Check", "np.quantile", "np.percentile")
"""Calls whose numeric arguments need no name: the thresholds of a quality check, the order of a quantile."""
SYNTHETIC = ("stages/synthesize_capture",)
"""Packages whose numbers are dimensions of the synthetic world."""
PLOT_MODULES = ("pictures.py", "plots.py")
"""Modules whose numbers are sizes, line widths and colors of plots."""
ARRAYS = re.compile(r"\b(ndarray|Tensor)\b")
SHAPED = re.compile(r"\b(Float|Int|UInt8|UInt|Bool|Shaped|Num|Inexact|Real|Complex|Int64|Float32|Float64)\[")


def sources(*tops: str) -> list[Path]:
    """Return the Python files below the folders `tops` of the checkout."""
    files = (path for top in tops for path in (ROOT / top).rglob("*.py"))
    return sorted(path for path in files if not {"node_modules", "build"} & set(path.parts))


@cache
def tree_of(path: Path) -> ast.Module:
    """Return the syntax tree of a file."""
    return ast.parse(path.read_text(), str(path))


def location(path: Path, line: int) -> str:
    """Return `file:line` relative to the checkout."""
    return f"{path.relative_to(ROOT)}:{line}"


def lines() -> list[str]:
    """Every line of `pipeline/` and `stages/`."""
    return [
        location(path, number)
        for path in sources("pipeline", "stages")
        for number, _ in enumerate(path.read_text().splitlines(), 1)
    ]


def long_lines() -> list[str]:
    """Lines longer than 110 columns."""
    return [
        location(path, number)
        for path in sources("pipeline", "stages")
        for number, line in enumerate(path.read_text().splitlines(), 1)
        if len(line) > MAX_COLUMNS
    ]


def keys() -> list[str]:
    """Recipe keys: the fields of every stage's `Config` with nested tables flattened; a shared `Config` counts once."""

    def fields(config: object, table: str) -> list[str]:
        return [
            name
            for key, value in vars(config).items()
            for name in (
                fields(value, f"{table}.{key}") if dataclasses.is_dataclass(value) else [f"{table}.{key}"]
            )
        ]

    found, counted = [], set()
    for main_file in sorted((ROOT / "stages").rglob("__main__.py")):
        stage = ".".join(main_file.parent.relative_to(ROOT).parts)
        module = "config" if main_file.with_name("config.py").exists() else "__main__"
        config = getattr(importlib.import_module(f"{stage}.{module}"), "Config", None)
        if config is not None and config not in counted:
            counted.add(config)
            found += fields(config(), stage.removeprefix("stages."))
    return found


def large_packages() -> list[str]:
    """Packages of `pipeline/` with more than 16 modules."""
    sizes = Counter(path.parent.name for path in sources("pipeline") if path.name != "__init__.py")
    return [f"{package}: {size}" for package, size in sizes.items() if size > 16]


def private_words() -> list[str]:
    """Identifiers that contain one of `PRIVATE_WORDS`."""
    found = []
    for path in sources("pipeline", "stages"):
        for token in tokenize.generate_tokens(io.StringIO(path.read_text()).readline):
            parts = re.findall(r"[A-Z]?[a-z]+", token.string) if token.type == tokenize.NAME else ()
            if token.string not in FILE_FORMAT_KEYS and any(part.lower() in PRIVATE_WORDS for part in parts):
                found.append(f"{location(path, token.start[0])} {token.string}")
    return found


def tell_and_told() -> list[str]:
    """Uses of "tell" and "told" in code, recipes and guides."""
    files = [
        *sources("pipeline", "stages"),
        *(path for path in (ROOT / "docs").glob("*.md") if path.name != "glossary.md"),  # lists former names
        *(ROOT / "agents").rglob("*.toml"),
    ]
    files += [ROOT / "README.md", ROOT / "ERRORS.md", ROOT / "data_layout.md"]
    return [
        location(path, number)
        for path in files
        for number, line in enumerate(path.read_text().splitlines(), 1)
        for _ in re.findall(r"(?<!\.)\b(?:tells?|told|telling)\b", line, re.IGNORECASE)  # not file.tell()
    ]


def repeated_classes() -> list[str]:
    """Names that several files give to different classes."""
    places: dict[str, list[str]] = {}
    for path in sources("pipeline", "stages"):
        for node in tree_of(path).body:
            if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
                places.setdefault(node.name, []).append(location(path, node.lineno))
    generic = ("Config", "Inputs")  # every stage has these two
    return [
        f"{name}: {' '.join(where)}"
        for name, where in places.items()
        if len(where) > 1 and name not in generic
    ]


def is_exponent(node: ast.AST, parent: ast.AST) -> bool:
    """Return whether a number is a shift count (`1 << 20`) or the exponent of a literal (`2**30`)."""
    if not isinstance(parent, ast.BinOp) or node is not parent.right:
        return False
    of_number = isinstance(parent.op, ast.Pow) and isinstance(parent.left, ast.Constant)
    return of_number or isinstance(parent.op, ast.LShift | ast.RShift)


def numbers_in(tree: ast.AST) -> list[ast.Constant]:
    """Return the numeric literals in function bodies that are neither self-explanatory nor named."""

    def self_explanatory(value: float) -> bool:
        small = isinstance(value, int) and value < 10
        largest = isinstance(value, int) and value >= 127 and (value + 1).bit_count() == 1
        power = (value > 0 and math.log10(value).is_integer()) or (
            value >= 1 and math.log2(value).is_integer()
        )
        return small or largest or power or value in SELF_EXPLANATORY or abs(value) <= 1e-5

    def walk(node: ast.AST) -> Iterator[ast.AST]:
        yield node
        for child in ast.iter_child_nodes(node):
            own = isinstance(node, ast.Call) and ast.unparse(node.func) in CALLS_WITH_NAMED_NUMBERS
            number = child.value if isinstance(child, ast.keyword) else child
            listed = isinstance(number, ast.List) and all(isinstance(e, ast.Constant) for e in number.elts)
            named = own and (listed or isinstance(number, ast.Constant))
            if not named and not is_exponent(child, node):
                yield from walk(child)

    return [
        node
        for function in ast.walk(tree)
        if isinstance(function, ast.FunctionDef)
        for statement in function.body
        for node in walk(statement)
        if isinstance(node, ast.Constant)
        and type(node.value) in (int, float)
        and not self_explanatory(node.value)
    ]


def unnamed_numbers() -> list[str]:
    """Numeric literals in function bodies that are neither self-explanatory nor named."""
    return sorted(
        {
            f"{location(path, node.lineno)} {node.value}"
            for path in sources("pipeline", "stages")
            if not path.relative_to(ROOT).as_posix().startswith(SYNTHETIC) and path.name not in PLOT_MODULES
            for node in numbers_in(tree_of(path))
        }
    )


def public_array_functions() -> list[tuple[str, bool]]:
    """Return public functions and methods with array arguments or results, and whether all their arrays have shapes."""
    found = []
    for path in sources("pipeline", "stages"):
        scopes = [tree_of(path).body]
        scopes += [
            n.body for n in tree_of(path).body if isinstance(n, ast.ClassDef) and not n.name.startswith("_")
        ]
        for node in (node for body in scopes for node in body):
            if not isinstance(node, ast.FunctionDef) or node.name.startswith("_"):
                continue
            hints = [a.annotation for a in (*node.args.args, *node.args.kwonlyargs)] + [node.returns]
            annotations = [ast.unparse(hint) for hint in hints if hint is not None]
            arrays = [hint for hint in annotations if ARRAYS.search(hint)]
            if arrays:
                unshaped_array = any(len(ARRAYS.findall(h)) > len(SHAPED.findall(h)) for h in arrays)
                found.append((f"{location(path, node.lineno)} {node.name}", not unshaped_array))
    return found


def unshaped() -> list[str]:
    """Public functions with an array without a shape in the signature."""
    return [name for name, shaped in public_array_functions() if not shaped]


def cycles() -> list[str]:
    """Modules that import each other, directly or indirectly."""
    graph = {}
    for path in sources("pipeline", "stages"):
        name = ".".join(path.relative_to(ROOT).with_suffix("").parts)
        graph[name] = {
            module
            for node in ast.walk(tree_of(path))
            if isinstance(node, ast.ImportFrom) and node.module
            for module in (node.module, *(f"{node.module}.{alias.name}" for alias in node.names))
        }

    def reachable(start: str) -> set[str]:
        pending, visited = list(graph[start]), set()
        while pending:
            module = pending.pop()
            if module in graph and module not in visited:
                visited.add(module)
                pending += graph[module]
        return visited

    return [name for name in graph if name in reachable(name)]


COUNTS = {
    "lines": lines,
    "lines over 110 columns": long_lines,
    "recipe keys": keys,
    "packages over 16 modules": large_packages,
    "private words in identifiers": private_words,
    "tell, told": tell_and_told,
    "class names used twice": repeated_classes,
    "unnamed numbers": unnamed_numbers,
    "unshaped public functions": unshaped,
    "modules in import cycles": cycles,
}


def main() -> None:
    """Print the counts, or the locations behind one of them."""
    parser = command_lines.described(__doc__)
    parser.add_argument("--list", choices=COUNTS, help="print the locations behind this count")
    arguments = parser.parse_args()
    if arguments.list:
        print(*COUNTS[arguments.list](), sep="\n")
        return
    for name, count in COUNTS.items():
        print(f"{len(count()):7} {name}")
    shaped = [ok for _, ok in public_array_functions()]
    print(
        f"{100 * sum(shaped) / len(shaped):6.1f}% of {len(shaped)} public functions with arrays have shapes"
    )


if __name__ == "__main__":
    main()
