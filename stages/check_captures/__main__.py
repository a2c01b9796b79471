"""Check recordings before a build, in under a minute each: what each is, how good it is, and what to do better.

make capture-check AGENT=luna        or: python -m stages.check_captures captures/luna
"""

import argparse
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pipeline import captures, config
from pipeline.errors import InputError
from pipeline.videos import Role
from stages.check_captures import checking


@dataclass(frozen=True)
class Config:
    """Settings of the check."""

    samples: int = 40
    """Frames that are looked at per recording."""
    seed: int = 0
    """Of random fits."""


def main(arguments: list[str]) -> int:
    """Print a verdict per recording; return 2 when one cannot be used or the set is not complete."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="captures/<agent>, or another folder with recordings")
    parser.add_argument("--recipe", type=Path, help="recipe whose [videos] table gives roles (default: agents/<folder's name>.toml)")
    given, settings = parser.parse_args(arguments), Config()
    try:
        files = _files(given.folder, given.recipe or Path("agents", f"{given.folder.name}.toml"))
    except InputError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    unusable = 0
    for verdict in checking.check(files, settings.samples, np.random.default_rng(settings.seed)):
        unusable += not verdict.usable
        print(f"{verdict.text}\n", flush=True)
    for name in captures.not_understood(given.folder):
        print(f"{captures.named(given.folder / name)}  left alone: not a recording of a known format (CAP-003)\n")
    missing = captures.missing_roles([role for _, role in files])
    for role, what in missing:
        print(f"CAP-040 there is no {role} among the recordings\n    -> add {what}")
    return 2 if unusable or missing else 0


def _files(folder: Path, recipe: Path) -> list[tuple[Path, Role]]:
    """Return the recordings and their roles, from names, sidecars and the recipe."""
    names = captures.find(folder)
    if not names:
        captures.refuse_strangers(folder)
        what = "there are no recordings; make builds from the built-in capture"
        raise InputError("CAP-042", what, str(folder), "copy recordings there (README: your own animal)")
    overrides = config.read_table(recipe).get("videos", {}) if recipe.is_file() else {}
    said = captures.remarks(folder, names, overrides, str(recipe))
    return [(folder / name, captures.role_of(name, said[name], str(folder))) for name in names]


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
