"""The recipe of an agent and the overlays of its variants, checked against the known tables and keys.

`read` refuses unknown tables and keys; `flow`, `builtin_remarks` and `trials` return what the planner needs
before any stage runs. Standard library only.
"""

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

from pipeline.core import config
from pipeline.core.errors import InputError
from pipeline.workflow import artifact, captures, dag, sources
from pipeline.workflow.dag import Flow

VIDEOS_TABLE, FLOW_TABLE, TABLES_STAGE, TRIED_TABLE = "videos", "flow", "tabulate_behavior", "train_behavior"
NAME = re.compile(r"[a-z0-9][a-z0-9_-]{0,62}\Z")
NAME_RULE = "use a-z, 0-9, _ and -, beginning with a letter or digit, 63 at most"
HOMES = "homes"
"""The key of `TRIED_TABLE` that names further builds of the same animal."""
BASE = "base"
"""The key at the top of a variant that names the variant whose keys it starts from."""
OURS = "ats"
"""The method that all others in the tables are compared with."""


@dataclass(frozen=True)
class Trial:
    """One method with one seed, for the tables."""

    id: str
    """`<method>-<seed>`."""
    overlay: dict[str, Any]
    """Changed keys of the trained stage's table."""


def read(path: Path) -> tuple[dict[str, Any], str]:
    """Read a recipe, or the overlay of a variant merged onto its `base`.

    Raises REC-005 for unknown recipes, REC-001 and REC-002 for tables and keys that no stage knows and values
    of a kind that it does not want.
    """
    if not path.is_file():
        known = ", ".join(sorted(other.stem for other in path.parent.glob("*.toml"))) or "none"
        new = "" if path.parent.name == "variants" else "; a new animal: make new AGENT=..."
        remedy = f"known: {known}{new}"
        raise InputError("REC-005", "there is no such recipe", str(path), remedy)
    recipe = config.read_table(path)
    base = recipe.pop(BASE, None) if path.parent.name == "variants" else None
    if base is not None:
        return merged(_base(base, path), _checked(recipe, path)), str(path)
    return _checked(recipe, path), str(path)


def _base(name: object, path: Path) -> dict[str, Any]:
    """Return the keys of the base of the variant at `path`; a base has no base itself."""
    other = path.with_name(f"{name}.toml")
    if not isinstance(name, str) or not other.is_file() or BASE in config.read_table(other):
        others = path.parent.glob("*.toml")
        known = sorted(each.stem for each in others if BASE not in config.read_table(each))
        what = f"{BASE}: {config.shown(name)} is no variant without a {BASE} of its own"
        raise InputError("REC-002", what, str(path), f"known: {', '.join(known)}")
    return read(other)[0]


def _checked(recipe: dict[str, Any], path: Path) -> dict[str, Any]:
    """Return a recipe after checking that all tables and keys are known and all values possible."""
    stages = {dag.table_of(node): node for node in reversed(dag.FLOW)}
    config.refuse_unknown(recipe, {*stages, VIDEOS_TABLE, FLOW_TABLE}, where=str(path), kind="table")
    for name, table in recipe.items():
        if not isinstance(table, dict):
            raise InputError("REC-002", f"{name!r} is no table", str(path), f"write [{name}]")
        if name == VIDEOS_TABLE:
            for recording, remarks in table.items():
                at = f"{path}: [{name}]"
                if not isinstance(remarks, dict):
                    what = f"{recording!r}: {config.shown(remarks)} is no table"
                    raise InputError("REC-002", what, at, f"write [{name}.{recording!r}]")
                ending = next((key for key, value in remarks.items() if isinstance(value, dict)), "")
                if ending and "." not in recording:
                    remedy = f'write [{name}."{recording}.{ending}"]'
                    raise InputError("REC-002", "a file name with a dot needs quotes", at, remedy)
                config.from_table(captures.Remarks, remarks, where=f"{at}: {recording!r}")
        if name not in stages:
            continue
        declared = sources.config_of(stages[name].stage)
        keys = {field.name for field in fields(declared)} - stages[name].fixed.keys()
        config.refuse_unknown(table, keys, where=f"{path}: [{name}]")
        config.from_table(declared, table, where=f"{path}: [{name}]")
    return recipe


def flow(table: Mapping[str, Any], where: str) -> Flow:
    """Return what the agent's flow starts from, by the recipe's `[flow]`."""
    config.refuse_unknown(table, ("begins_at",), where=f"{where}: [flow]")
    begins = table.get("begins_at", "recordings")
    if not isinstance(begins, str) or begins not in dag.BUILTIN:
        what, remedy = f"no flow begins at {config.shown(begins)}", f"begins_at: {' or '.join(dag.BUILTIN)}"
        raise InputError("REC-002", what, f"{where}: [flow]", remedy)
    return begins


def refuse_homes(agent: str, table: Mapping[str, Any], where: str) -> None:
    """Raise REC-002 for `homes` that do not name other builds, ART-003 for builds that do not exist yet."""
    for name in table.get(HOMES, ()):
        if not NAME.match(name) or name == agent:
            what = f"{HOMES}: {name!r} is no other build"
            remedy = "name other builds of the same animal, folders below build/"
            raise InputError("REC-002", what, f"{where}: [{TRIED_TABLE}]", remedy)
        artifact.require(Path("build", name), *dag.HOME_ARTIFACTS, remedy=f"make {name}")


def trials(table: Mapping[str, Any]) -> Iterator[Trial]:
    """Yield every trained method of the tables with every seed; a method is that variant's training."""
    settings = {**vars(sources.config_of(TABLES_STAGE)()), **table}
    count, methods = settings["seeds"], settings["methods"]
    if OURS not in methods or not count:
        what = f"{count} trainings of {', '.join(methods) or 'no method'} make no tables"
        remedy = f"one seed at least, and {OURS!r} among the methods"
        raise InputError("REC-002", what, f"[{TABLES_STAGE}]: methods, seeds", remedy)
    for method in methods:
        path = Path("agents", "variants", f"{method}.toml")
        overlay, _ = read(path)
        if TRIED_TABLE not in overlay:
            config.refuse_unknown(
                overlay, (TRIED_TABLE,), where=f"{path}, a method of the tables", kind="table"
            )
        for seed, id in enumerate(trial_ids((method,), count)):
            yield Trial(id, {**overlay.get(TRIED_TABLE, {}), "seed": seed})


def trial_ids(methods: Sequence[str], seeds: int) -> tuple[str, ...]:
    """Return the ids of the trials that the tables are made of: `<method>-<seed>`."""
    return tuple(f"{method}-{seed}" for method in methods for seed in range(seeds))


def merged(table: Mapping[str, Any], overlay: Mapping[str, Any]) -> dict[str, Any]:
    """Return the table with the overlay's keys, merging nested tables recursively."""
    inner = {
        key: merged(table[key], value)
        for key, value in overlay.items()
        if isinstance(value, Mapping) and key in table
    }
    return {**table, **overlay, **inner}


def builtin_remarks(begins: Flow, recipe: Mapping[str, Any], where: str) -> dict[str, captures.Remarks]:
    """Return the remarks on the built-in recordings, with overrides as for a user's recordings."""
    node, overrides = dag.NODES[dag.BUILTIN[begins]], recipe.get(VIDEOS_TABLE, {})
    settings = {**vars(sources.config_of(node.stage)()), **recipe.get(dag.table_of(node), {})}
    if begins == "recordings":
        keys = ("session_count", "heldout_of", "foreign_sessions", "companion")
        builtin = captures.builtin(*(settings[key] for key in keys))
    else:
        keys = ("homes", "sessions_per_home", "test_homes", "test_sessions")
        builtin = captures.builtin_lives(*(settings[key] for key in keys))
    for name in (name for name in overrides if name not in builtin):
        known = ", ".join(builtin)
        remedy = f"copy it into captures/, beside the others; without any, the built-in capture has {known}"
        raise InputError("REC-001", f"unknown recording {name!r}", f"{where}: [videos]", remedy)
    at = f"{where}: [videos]"
    return {
        name: config.from_table(captures.Remarks, overrides.get(name, {}), where=f"{at}: {name!r}", base=said)
        for name, said in builtin.items()
    }
