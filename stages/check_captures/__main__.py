"""Check recordings before a build, up to a minute per file: what it is, how good, what to do better.

It has a command line of its own because it makes no artifact and runs before there is a plan.

make capture-check AGENT=luna        or: python -m stages.check_captures captures/luna
"""

import itertools
import sys
from pathlib import Path

from pipeline.core.errors import CommandLine, InputError, exit_code, printable
from pipeline.core.videos import Role
from pipeline.workflow import captures, recipes
from stages.check_captures import stage
from stages.check_captures.stage import CaptureVerdict


def main(arguments: list[str]) -> int:
    """Print a verdict per recording; return 2 when one cannot be used or the set is not complete."""
    parser = CommandLine(__doc__, prog="python -m stages.check_captures")
    parser.add_argument("folder", type=Path, help="captures/<agent>, or another folder with recordings")
    about = "recipe whose [videos] table gives roles (default: agents/<folder's name>.toml)"
    parser.add_argument("--recipe", type=Path, help=about)

    def program() -> int:
        given = parser.parse_args(arguments)
        return _check(given.folder, given.recipe or Path("agents", f"{given.folder.name}.toml"))

    return exit_code(program, "captures")


def _check(folder: Path, recipe: Path) -> int:
    said, files, refused = _said(folder, recipe)
    unusable = 0
    for verdict in itertools.chain(refused, stage.run(files)):
        unusable += not verdict.usable
        print(f"{printable(verdict.text)}\n", flush=True)
    for name in captures.unknown_files(folder):
        named = printable(captures.named(folder / name))
        known = "not a recording of a known format (CAP-003); convert other videos to .mp4"
        print(f"{named}  left alone: {known}\n")
    try:
        captures.assign(said, {}, dict.fromkeys(said), str(folder))
    except InputError as error:
        unusable += 1
        print(f"{error.code} {error.what}\n    -> {error.remedy}")
    return 2 if unusable else 0


def _said(
    folder: Path, recipe: Path
) -> tuple[dict[str, captures.Remarks], list[tuple[Path, Role]], list[CaptureVerdict]]:
    """Return what sidecars and recipe say, recordings with roles, and those with a bad sidecar."""
    given = recipes.read(recipe)[0] if recipe.is_file() else {}
    if recipes.flow(given.get(recipes.FLOW_TABLE, {}), str(recipe)) != "recordings":
        raise InputError("CAP-042", "tables of motion are checked by the build", str(folder), "run make")
    names = captures.find(folder)
    if not names:
        captures.refuse_unknown_files(folder)
        what = "there are no recordings; make builds from the built-in capture"
        raise InputError("CAP-042", what, str(folder), "copy recordings there (README: your own animal)")
    overrides = captures.by_file(given.get(recipes.VIDEOS_TABLE, {}), names, str(recipe))
    said, files, refused = {}, [], []
    for name in names:
        try:
            own = {name: overrides[name]} if name in overrides else {}
            remark = captures.remarks(folder, [name], own, str(recipe))[name]
            if remark.role == captures.UNUSED:
                print(f"{printable(repr(name))}  left out: its role is {captures.UNUSED!r}\n")
                continue
            files.append((folder / name, captures.role_of(name, remark, str(folder))))
            said[name] = remark
        except InputError as error:
            refused.append(stage.refused(folder / name, "session", error))
    return said, files, refused


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
