"""Count what makes the code easy or hard to enter: lines, keys, packages, words, shapes, literals, cycles.

    python -m benchmarks.codebase_counts [--list COUNT]

Prints one line per count; `--list` names the places behind one of them. `tests/test_codebase.py` holds the
bars.
"""

import argparse
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

ROOT = Path(__file__).parent.parent
LONGEST_LINE = 110
PRIVATE_WORDS = frozenset(
    "minds told tells kept strange torn mended bare slid firmness quicken pace habits haunts sees beside aside "
    "buried drafted bent missed led cheapest relax relatives alike likeness bore strayed shy bold".split()
)
"""Words that this project once used for terms that the field has other names for; see docs/glossary.md."""
KEYS_OF_FILES = ("pace_m",)
"""Names that artifacts and models hold; `longterm.json` has this one."""
PLAIN_NUMBERS = frozenset((60, 90, 180, 255, 127.5, 360, 0.5, 0.25, 2.5, 97.5, 95, 99, 99.5))
"""Numbers that explain themselves; so do integers below 10, powers of two and of ten, the largest values of
integer types (127, 65535), the bounds of a 95 % interval, percentiles of the tail, and what only keeps a
quotient finite."""
NAMED_BY_CALL = ("Check", "qa.Check", "np.quantile", "np.percentile")
"""Calls whose numbers have their name beside them: the thresholds of a quality check, the order of a
quantile."""
DRAWN = ("stages/synthesize_capture",)
"""Where numbers are the measures of a drawn world."""
FIGURES = ("pictures.py", "plots.py")
"""Modules in which numbers are sizes, line widths and colours of figures."""
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


def place(path: Path, line: int) -> str:
    """Return `file:line` relative to the checkout."""
    return f"{path.relative_to(ROOT)}:{line}"


def lines() -> list[str]:
    """Every line of `pipeline/` and `stages/`."""
    return [
        place(path, number)
        for path in sources("pipeline", "stages")
        for number, _ in enumerate(path.read_text().splitlines(), 1)
    ]


def long_lines() -> list[str]:
    """Lines longer than 110 columns."""
    return [
        place(path, number)
        for path in sources("pipeline", "stages")
        for number, line in enumerate(path.read_text().splitlines(), 1)
        if len(line) > LONGEST_LINE
    ]


def keys() -> list[str]:
    """Recipe keys: the fields of every stage's `Config`, nested tables resolved; a shared one counts once."""

    def fields(config: object, table: str) -> list[str]:
        return [
            name
            for key, value in vars(config).items()
            for name in (
                fields(value, f"{table}.{key}") if dataclasses.is_dataclass(value) else [f"{table}.{key}"]
            )
        ]

    found, counted = [], set()
    for door in sorted((ROOT / "stages").rglob("__main__.py")):
        stage = ".".join(door.parent.relative_to(ROOT).parts)
        module = "config" if door.with_name("config.py").exists() else "__main__"
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
    """Identifiers of which a part is one of the project's former private words."""
    found = []
    for path in sources("pipeline", "stages"):
        for token in tokenize.generate_tokens(io.StringIO(path.read_text()).readline):
            parts = re.findall(r"[A-Z]?[a-z]+", token.string) if token.type == tokenize.NAME else ()
            if token.string not in KEYS_OF_FILES and any(part.lower() in PRIVATE_WORDS for part in parts):
                found.append(f"{place(path, token.start[0])} {token.string}")
    return found


def telling() -> list[str]:
    """Places in code, recipes and guides that say that something tells or was told."""
    files = [
        *sources("pipeline", "stages"),
        *(path for path in (ROOT / "docs").glob("*.md") if path.name != "glossary.md"),  # lists former names
        *(ROOT / "agents").rglob("*.toml"),
    ]
    files += [ROOT / "README.md", ROOT / "ERRORS.md", ROOT / "data_layout.md"]
    return [
        place(path, number)
        for path in files
        for number, line in enumerate(path.read_text().splitlines(), 1)
        for _ in re.findall(r"(?<!\.)\b(?:tells?|told|telling)\b", line, re.IGNORECASE)  # not file.tell()
    ]


def repeated_classes() -> list[str]:
    """Class names that stand for different things in different files."""
    places: dict[str, list[str]] = {}
    for path in sources("pipeline", "stages"):
        for node in tree_of(path).body:
            if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
                places.setdefault(node.name, []).append(place(path, node.lineno))
    generic = ("Config", "Inputs")  # every stage has these two
    return [
        f"{name}: {' '.join(where)}"
        for name, where in places.items()
        if len(where) > 1 and name not in generic
    ]


def is_exponent(node: ast.AST, parent: ast.AST) -> bool:
    """Return whether a number is one of bits (`1 << 20`) or the exponent of another number (`2**30`)."""
    if not isinstance(parent, ast.BinOp) or node is not parent.right:
        return False
    of_number = isinstance(parent.op, ast.Pow) and isinstance(parent.left, ast.Constant)
    return of_number or isinstance(parent.op, ast.LShift | ast.RShift)


def numbers_in(tree: ast.AST) -> list[ast.Constant]:
    """Return the numeric literals in a tree's functions that neither explain themselves nor have a name."""

    def plain(value: float) -> bool:
        small = isinstance(value, int) and value < 10
        largest = isinstance(value, int) and value >= 127 and (value + 1).bit_count() == 1
        power = (value > 0 and math.log10(value).is_integer()) or (
            value >= 1 and math.log2(value).is_integer()
        )
        return small or largest or power or value in PLAIN_NUMBERS or abs(value) <= 1e-5

    def walk(node: ast.AST) -> Iterator[ast.AST]:
        yield node
        for child in ast.iter_child_nodes(node):
            own = isinstance(node, ast.Call) and ast.unparse(node.func) in NAMED_BY_CALL
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
        if isinstance(node, ast.Constant) and type(node.value) in (int, float) and not plain(node.value)
    ]


def unnamed_numbers() -> list[str]:
    """Numeric literals in function bodies that neither explain themselves nor have a name."""
    return sorted(
        {
            f"{place(path, node.lineno)} {node.value}"
            for path in sources("pipeline", "stages")
            if not path.relative_to(ROOT).as_posix().startswith(DRAWN) and path.name not in FIGURES
            for node in numbers_in(tree_of(path))
        }
    )


def public_array_functions() -> list[tuple[str, bool]]:
    """Public functions and methods that take or return arrays, and whether each array has its shape in the
    signature.
    """
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
            spelled = [ast.unparse(hint) for hint in hints if hint is not None]
            arrays = [hint for hint in spelled if ARRAYS.search(hint)]
            if arrays:
                bare = any(len(ARRAYS.findall(h)) > len(SHAPED.findall(h)) for h in arrays)
                found.append((f"{place(path, node.lineno)} {node.name}", not bare))
    return found


def unshaped() -> list[str]:
    """Public functions with an array that has no shape in the signature."""
    return [name for name, shaped in public_array_functions() if not shaped]


def cycles() -> list[str]:
    """Modules that import one another, directly or by way of others."""
    graph = {}
    for path in sources("pipeline", "stages"):
        name = ".".join(path.relative_to(ROOT).with_suffix("").parts)
        graph[name] = {
            module
            for node in ast.walk(tree_of(path))
            if isinstance(node, ast.ImportFrom) and node.module
            for module in (node.module, *(f"{node.module}.{alias.name}" for alias in node.names))
        }

    def reached(start: str) -> set[str]:
        waiting, seen = list(graph[start]), set()
        while waiting:
            module = waiting.pop()
            if module in graph and module not in seen:
                seen.add(module)
                waiting += graph[module]
        return seen

    return [name for name in graph if name in reached(name)]


COUNTS = {
    "lines": lines,
    "lines over 110 columns": long_lines,
    "recipe keys": keys,
    "packages over 16 modules": large_packages,
    "private words in identifiers": private_words,
    "tell, told": telling,
    "class names used twice": repeated_classes,
    "unnamed numbers": unnamed_numbers,
    "unshaped public functions": unshaped,
    "modules in import cycles": cycles,
}


def main() -> None:
    """Print the counts, or the places behind one of them."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--list", choices=COUNTS, help="name the places behind this count")
    given = parser.parse_args()
    if given.list:
        print(*COUNTS[given.list](), sep="\n")
        return
    for name, count in COUNTS.items():
        print(f"{len(count()):7} {name}")
    shaped = [ok for _, ok in public_array_functions()]
    print(
        f"{100 * sum(shaped) / len(shaped):6.1f}% of {len(shaped)} public functions with arrays have shapes"
    )


if __name__ == "__main__":
    main()
