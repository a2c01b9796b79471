"""The recordings in `captures/<agent>/`: their roles, from file names and the recipe's `[videos]`.

`find` looks at the disk, `assign` decides roles and split; both raise `InputError` before anything is
written. User file names go into `videos.json` and nowhere else. Standard library only.
"""

import math
import re
import unicodedata
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pipeline.core import config
from pipeline.core.errors import InputError
from pipeline.core.videos import PERSON, ROLES, SPLITS, Role, Split, Video
from pipeline.recordings.formats import UNDERSTOOD, format_of, has_depth
from pipeline.workflow import dag
from pipeline.workflow.artifact import MANIFEST
from pipeline.workflow.dag import Flow

SIDECAR = ".toml"
"""`<recording>.toml` beside a recording may hold the same keys as its table in the recipe's `[videos]`."""
_NEEDED: dict[Flow, tuple[tuple[Role, str], ...]] = {
    "recordings": (
        ("walkthrough", "one slow walk through the empty room, named walkthrough..."),
        ("turnaround", "one circle around the resting animal, named turnaround..."),
        ("session", "one or more clips of the animal, named anything else"),
    ),
    "trajectories": (("session", "one or more tables of its motion, CSV or NPZ"),),
}
SHOWN_LETTERS, LONGEST_NAME_BYTES = 40, 200
"""of a recording's name: file systems allow 255 bytes, and sidecars append to it"""
UNUSED = "unused"
"""Role of a recording that the build leaves out."""
_ANIMAL = re.compile(r"[a-z][a-z0-9-]{0,30}\Z")
_NAMED = re.compile(r"turnaround_([^\W_](?:[^\W_]|-)*)")
TABLES = (".csv", ".npz")
"""Suffixes of tables of motion."""
ICLOUD = ".icloud"
"""Suffix of the hidden placeholder of a file that macOS has moved to iCloud."""


@dataclass(frozen=True)
class Remarks:
    """What the user says about one recording, in the recipe's `[videos]` or in a sidecar; None: not given."""

    role: str | None = None
    """`walkthrough`, `turnaround`, `session`, `heldout` or `unused`; otherwise the name decides."""
    split: str | None = None
    """`train` or `test` for a session; otherwise the last session is the test."""
    synchronized_with: str | None = None
    """File name of the recording whose clock this one shares."""
    offset_s: float | None = None
    """Time in that recording = time in this one + offset, seconds."""
    animal: str | None = None
    """Whose turnaround it is, in a home of several animals; otherwise `turnaround_<name>` says it."""


def find(folder: Path, flow: Flow = "recordings") -> list[str]:
    """Return the names of the recordings of known formats in `folder`, or of the tables of motion."""
    understood = format_of if flow == "recordings" else _is_table
    return [path.name for path in _visible(folder) if understood(path)]


def _visible(folder: Path) -> list[Path]:
    """Return the entries of a folder except hidden ones, but with those in iCloud, sorted by name."""
    found = sorted(folder.iterdir()) if folder.is_dir() else []
    return [path for path in found if not path.name.startswith(".") or path.suffix == ICLOUD]


def unknown_files(folder: Path, flow: Flow = "recordings") -> list[str]:
    """Return the names of all other visible entries."""
    found, kinds = find(folder, flow), {"", *(f".{kind}" for node in dag.FLOW for kind in node.sidecars)}
    known = {*found, *(f"{name}{kind}{SIDECAR}" for name in found for kind in kinds)}
    known |= {name for node in dag.FLOW for name in node.extra_inputs}
    return [path.name for path in _visible(folder) if path.name not in known]


def named(path: Path, flow: Flow = "recordings") -> str:
    """Return an unknown file's name for a message, with the reason why it is unusable if known."""
    if not path.exists():
        return f"{path.name!r} (a link that leads nowhere)"
    if path.suffix == ICLOUD:
        return f"{path.name!r} (only in iCloud: download it in Finder)"
    inner = find(path, flow)
    if flow == "recordings" and inner and len(_visible(path)) > len(inner) and not has_depth(path / inner[0]):
        return f"{path.name!r} ({inner[0]!r} has no folder depth/ beside it; alone, it is a plain video)"
    return f"{path.name!r} (move {inner[0]!r} out of it: that is one)" if inner else repr(path.name)


def refuse_unknown_files(folder: Path, flow: Flow = "recordings") -> None:
    """Raise CAP-003 if `folder` has files, but no recording that the flow can start from, CAP-042 if it is
    no folder or a link that leads nowhere."""
    for part in (folder.parent, folder):
        if part.is_file() or (part.is_symlink() and not part.exists()):
            what = "is no folder" if part.is_file() else f"links to {part.readlink()}, which is gone"
            remedy = "connect the disk that holds it; or remove it for the built-in capture"
            raise InputError("CAP-042", what, str(part), remedy)
    unknown = [name for name in unknown_files(folder, flow) if not name.endswith(SIDECAR)]
    if unknown:
        named_all = ", ".join(named(folder / name, flow) for name in unknown)
        what = f"holds no recording of a known format, only {named_all}"
        known = "tables of motion, CSV or NPZ"
        if flow == "recordings":
            known = f"{UNDERSTOOD}; {known}, where the recipe's [flow] begins at trajectories"
        remedy = f"known: {known}; or empty the folder for the built-in capture"
        raise InputError("CAP-003", what, str(folder), remedy)


def extra_inputs(agent: str, names: Sequence[str], *, artifacts: bool = True) -> list[Path]:
    """Return the existing files and finished artifacts of these names beside an agent's recordings."""
    paths = (Path("captures", agent, name) for name in names)
    return [path for path in paths if path.is_file() or (artifacts and (path / MANIFEST).is_file())]


def sidecars(agent: str, file: str, names: Sequence[str]) -> dict[str, Path]:
    """Return the existing sidecar files of one recording by name."""
    paths = {name: Path("captures", agent, f"{file}.{name}{SIDECAR}") for name in names}
    return {name: path for name, path in paths.items() if path.is_file()}


def remarks(
    folder: Path, names: Sequence[str], overrides: Mapping[str, Any], where: str
) -> dict[str, Remarks]:
    """Return what the user says about each recording; the recipe overrides sidecars."""
    overrides, said = by_file(overrides, names, where), {}
    for name in names:
        data = name.encode(errors="replace")
        if len(data) > LONGEST_NAME_BYTES or data.decode() != name:
            what = f"the name {name[:SHOWN_LETTERS]!r} is longer than {LONGEST_NAME_BYTES} bytes, or no UTF-8"
            raise InputError("CAP-041", what, str(folder), "rename it")
        sidecar = folder / f"{name}{SIDECAR}"
        table = config.read_table(sidecar) if sidecar.is_file() else {}
        config.from_table(Remarks, table, where=str(sidecar))
        table = {**table, **overrides.get(name, {})}
        remark = config.from_table(Remarks, table, where=f"{where}: [videos.{name!r}]")
        if remark.offset_s is not None and not math.isfinite(remark.offset_s):
            raise InputError("CAP-041", f"{name!r} has no finite offset_s", where, "give seconds")
        said[name] = remark
    return said


def by_file(overrides: Mapping[str, Any], names: Sequence[str], where: str) -> dict[str, Any]:
    """Return the recipe's `[videos]` by file name as the disk spells it. Raises REC-001 for other names."""
    found = {spelled(name, names): table for name, table in overrides.items()}
    config.refuse_unknown(found, names, where=f"{where}: [videos]", kind="recording")
    return found


def spelled(name: str, names: Iterable[str]) -> str:
    """Return a name as it stands in ``names``: macOS stores an accent apart from its letter."""
    composed = {unicodedata.normalize("NFC", each): each for each in names}
    return composed.get(unicodedata.normalize("NFC", name), name)


def assign(
    said: Mapping[str, Remarks],
    known_ids: Mapping[str, str],
    hashes: Mapping[str, str | None],
    where: str,
    flow: Flow = "recordings",
) -> tuple[Video, ...]:
    """Give every recording its id, role, split and clock.

    `known_ids`, by file name, are kept and never reused. Raises CAP-040 (a role is missing), CAP-041 (an
    impossible remark), CAP-043 (turnarounds that do not name several animals).
    """
    roles: dict[str, Role] = {name: role_of(name, remark, where) for name, remark in said.items()}
    if missing := [needed for needed in _NEEDED[flow] if needed[0] not in roles.values()]:
        absent, wanted = (" and ".join(each) for each in zip(*missing, strict=True))
        seen = ", ".join(f"{name!r} is a {role}" for name, role in roles.items())
        what = f"there is no {absent} among the recordings: {seen}"
        raise InputError("CAP-040", what, where, f"add {wanted}")
    order = sorted(said, key=lambda name: (ROLES.index(roles[name]), name))
    splits = _splits([name for name in order if roles[name] == "session"], said, where)
    ids = _ids(order, known_ids)
    animals = _animals([name for name in order if roles[name] == "turnaround"], said, where)
    return tuple(
        Video(
            id=ids[name],
            file=name,
            role=roles[name],
            split=splits.get(name, "none"),
            sha256=hashes[name],
            synchronized_with=_partner(name, said, ids, roles, where),
            offset_s=said[name].offset_s or 0.0,
            animal=animals.get(name),
        )
        for name in sorted(said, key=ids.__getitem__)
    )


def role_of(name: str, remark: Remarks, where: str) -> Role:
    """Return a recording's role: as the user says, else by the prefix of its name. Raises CAP-041."""
    for role in ROLES:
        if role == remark.role or (remark.role is None and name.lower().startswith(role)):
            return role
    if remark.role is None:
        return "session"
    what, remedy = f"{name!r} cannot have the role {remark.role!r}", f"roles: {', '.join(ROLES)}, {UNUSED}"
    raise InputError("CAP-041", what, where, remedy)


def builtin(
    session_count: int, heldout_of: int, foreign_sessions: int = 0, companion: str = "none"
) -> dict[str, Remarks]:
    """Return what `synthesize_capture` writes; `heldout_of` counts sessions from 1."""
    sessions = [f"session-{i}.r3d" for i in range(1, session_count + foreign_sessions + 1)]
    two = ("turnaround_cat.r3d", f"turnaround_{companion}.r3d")
    turnarounds = ("turnaround.r3d",) if companion == "none" else two
    plain = dict.fromkeys(("walkthrough.r3d", *turnarounds, *sessions), Remarks())
    if foreign_sessions:  # the test video stays the last one that is filmed at home
        plain |= {name: Remarks(split="train") for name in sessions}
        plain[sessions[session_count - 1]] = Remarks(split="test")
    if not heldout_of:
        return plain
    return {**plain, "heldout.r3d": Remarks(synchronized_with=f"session-{heldout_of}.r3d", offset_s=0.0)}


def builtin_lives(
    homes: int, sessions_per_home: int, test_homes: int, test_sessions: int
) -> dict[str, Remarks]:
    """Return the recordings that `synthesize_capture.lives` writes; those of the last homes are the test."""
    splits = ["train"] * (homes * sessions_per_home) + ["test"] * (test_homes * test_sessions)
    return {f"session-{number:02d}.npz": Remarks(split=split) for number, split in enumerate(splits, start=1)}


def _is_table(path: Path) -> bool:
    return path.suffix.lower() in TABLES or (path / "trajectory.csv").is_file()


def _splits(sessions: Sequence[str], said: Mapping[str, Remarks], where: str) -> dict[str, Split]:
    wanted: dict[str, Split | None] = {}
    for name, remark in said.items():
        wanted[name] = next((split for split in SPLITS if split == remark.split), None)
        allowed = SPLITS if name in sessions else ("none",)
        if remark.split is not None and wanted[name] not in allowed:
            what = f"{name!r} cannot be in the split {remark.split!r}"
            raise InputError("CAP-041", what, where, "sessions: train or test")
    if sessions and all(wanted[name] == "test" for name in sessions):
        raise InputError("CAP-041", "every session is in the split 'test'", where, "leave one for training")
    tested = any(wanted[name] == "test" for name in sessions) or len(sessions) < 2
    if not tested and wanted[sessions[-1]] is None:
        wanted[sessions[-1]] = "test"
    return {name: wanted[name] or "train" for name in sessions}


def _animals(turnarounds: Sequence[str], said: Mapping[str, Remarks], where: str) -> dict[str, str]:
    """Return the animal of each turnaround; empty if there is only one."""
    if len(turnarounds) < 2:
        return {}
    found: dict[str, str] = {}
    for name in turnarounds:
        named = _NAMED.match(unicodedata.normalize("NFC", name.lower()).split(".")[0])
        animal = said[name].animal or (named and named[1])
        if animal is None or not _ANIMAL.match(animal):
            what = f"{name!r} does not say which animal it shows, and there is another turnaround"
        elif animal == PERSON:
            what = f"{name!r} names an animal {PERSON!r}, as the person who films is called"
        elif animal in found.values():
            other = next(file for file, whose in found.items() if whose == animal)
            what = f"{other!r} and {name!r} are both turnarounds of {animal!r}"
        else:
            found[name] = animal
            continue
        remedy = "one animal: keep one turnaround; several: name each turnaround_<name>, a-z, 0-9 and -"
        raise InputError("CAP-043", what, where, remedy)
    return found


def _ids(order: Iterable[str], known: Mapping[str, str]) -> dict[str, str]:
    following = 1 + max((int(id[1:]) for id in known.values()), default=-1)
    ids = {}
    for name in order:
        ids[name] = known.get(name) or f"v{following:03d}"
        following += name not in known
    return ids


def _partner(
    name: str, said: Mapping[str, Remarks], ids: Mapping[str, str], roles: Mapping[str, Role], where: str
) -> str | None:
    partner = said[name].synchronized_with
    if partner is None:
        return None
    partner = spelled(partner, ids)
    if partner not in ids or partner == name:
        what, remedy = f"{name!r} shares no clock with {partner!r}", f"recordings: {', '.join(sorted(ids))}"
        raise InputError("CAP-041", what, where, remedy)
    if (roles[name], roles[partner]) != ("heldout", "session"):
        what = f"{name!r} ({roles[name]}) cannot be synchronized with {partner!r} ({roles[partner]})"
        raise InputError("CAP-041", what, where, "synchronized_with: of a held-out phone, its session")
    return ids[partner]
