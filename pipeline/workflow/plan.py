"""The planner: recipe + recordings + DAG -> `build/<home>/plan/`, which engines and `run` read.

    python -SE -m pipeline.workflow.plan plan HOME...
    python -SE -m pipeline.workflow.plan redo HOME ARTIFACT        have one artifact made again
    python -SE -m pipeline.workflow.plan inputs HOME ARTIFACT...   options that name artifacts to a stage;
        `together` in place of `inputs`: in a home of several animals the folder of all
    python -SE -m pipeline.workflow.plan new AGENT [TAKEN...]      recipe and capture folder of a new animal

HOME is an agent, <agent>/variants/<name>, or <agent>/tables; TAKEN are names that no animal may have.

All user input is checked before anything is written. The stamp of an artifact is removed if its key has
changed, so that an engine runs its job. Standard library only: the planner runs at every `make`.
"""

import functools
import json
import re
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from pipeline.core import videos
from pipeline.core.errors import InputError, exit_code
from pipeline.recordings.formats import has_depth
from pipeline.workflow import artifact, captures, dag, jobs, recipes, sources, stamps
from pipeline.workflow.jobs import Home, Job, Plan, jobs_file

CODE_CACHE = Path("build", "code-cache.json")
"""Cache of the parsed source code, shared by all homes; safe to delete."""


def read(home: Home, cache: sources.Cache) -> Plan:
    """Check recipe and recordings and return the plan, without writing anything."""
    recipe, where = recipes.read(Path("agents", f"{home.agent}.toml"))
    flow = recipes.flow(recipe.get(recipes.FLOW_TABLE, {}), where)
    overlay = {}
    if home.variant:
        overlay, _ = recipes.read(Path("agents", "variants", f"{home.variant}.toml"))
    tables = {n.artifact: {**recipe.get(dag.table_of(n), {}), **n.fixed} for n in dag.FLOW}
    changed = {
        n.artifact: {**recipes.merged(tables[n.artifact], overlay.get(dag.table_of(n), {})), **n.fixed}
        for n in dag.FLOW
    }
    recipes.refuse_homes(home.agent, changed["behavior"], where)
    folder = Path("captures", home.agent)
    names = captures.find(folder, flow)
    if names:
        digest_of = functools.partial(cache.get, read=artifact.digest_of_file)
        said = captures.remarks(folder, names, recipe.get(recipes.VIDEOS_TABLE, {}), where)
        said = {name: remark for name, remark in said.items() if remark.role != captures.UNUSED}
        hashes = {name: sources.recording_digest(folder / name, digest_of) for name in said}
    else:
        captures.refuse_unknown_files(folder, flow)
        _refuse_lost(folder, home.base)
        said = recipes.builtin_remarks(flow, recipe, where)
        hashes = dict.fromkeys(said)
    recordings = captures.assign(said, _known_ids(home.base), hashes, str(folder) if names else where, flow)
    if names and flow == "recordings":
        without_depth = {v for v in recordings if v.role in dag.AGENT and not has_depth(folder / v.file)}
        recordings = tuple(replace(video, mapped=video in without_depth) for video in recordings)
    mapped = any(video.mapped for video in recordings)
    touched = jobs.touched_by(tables, changed, mapped) if home.variant else frozenset(dag.NODES)
    if home.tables:
        touched = frozenset(n.artifact for n in dag.FLOW if n.trials != "none")
    trials = tuple(recipes.trials(recipe.get(recipes.TABLES_STAGE, {}))) if home.tables else ()
    return jobs.with_animals(Plan(home, recordings, not names, changed, touched, flow, trials))


def _refuse_lost(folder: Path, home: Home) -> None:
    """Raise CAP-042 if `folder` is empty, but its build is of recordings, as when their disk is unmounted."""
    try:
        built = [video.file for video in videos.read(home.plan / "videos.json") if video.sha256]
    except InputError:  # never planned, or damaged
        return
    if built:
        what = f"is empty, but {home.folder} was built from {', '.join(built)}"
        remedy = f"connect their disk or copy them back; or remove {home.folder} for the built-in capture"
        raise InputError("CAP-042", what, str(folder), remedy)


def write(plan: Plan, cache: sources.Cache, code: sources.Cache) -> None:
    """Write the plan's files that have changed."""
    all_jobs = jobs.expand(plan)
    base = plan.home.base.plan
    ids = _known_ids(plan.home.base) | {video.file: video.id for video in plan.videos}
    _write(base / "ids.json", _json(ids))
    _write(base / "videos.json", _json([asdict(video) for video in plan.videos]))
    for video in plan.videos:
        _write(base / f"keys/video.{video.id}.json", _json({"role": video.role, "sha256": video.sha256}))
    for name, file in _extra_files(plan):
        hashed = file / artifact.MANIFEST if file.is_dir() else file
        digest = cache.get(hashed, artifact.digest_of_file)
        _write(base / "keys" / name, _json({"sha256": digest}))
    for each in (plan, *plan.animals):
        for name, trial in {(job.artifact, job.trial) for job in all_jobs if job.home == str(each.home)}:
            _write_key(each, code, name, trial)
    after, lines = jobs.direct_dependencies(all_jobs), []
    file_of = {video.id: f": {video.file!r}" for video in plan.videos}
    for number, job in enumerate(all_jobs, start=1):
        place = f"{number} of {len(all_jobs)}{file_of.get(job.video or '', '')}"
        plain = {**vars(job), "inputs": [vars(each) for each in job.inputs], "stamp": job.stamp}
        lines.append((job.home, json.dumps(plain | {"place": place, "after": after[job.stamp]})))
    for each in (plan, *plan.animals):
        homes = {home for home, _ in lines} if each is plan else {str(plan.home), str(each.home)}
        own_lines = ",\n".join(line for home, line in lines if home in homes)
        _write(jobs_file(each.home), f"[\n{own_lines}\n]\n")
    for each in plan.animals:
        _write(each.home.plan / "videos.json", _json([asdict(video) for video in each.videos]))
    _write(plan.home.plan / "rules.mk", _rules(plan, all_jobs, after))
    stamps.remove_outdated(all_jobs)


def _extra_files(plan: Plan) -> Iterator[tuple[str, Path]]:
    """Yield the user's other files that affect results, each with the name of its key file."""
    agent = plan.home.agent
    for node in dag.FLOW:
        for file in captures.extra_inputs(agent, node.extra_inputs):
            yield f"extra.{file.name}", file
        for video in plan.videos:
            for name, file in captures.sidecars(agent, video.file, node.sidecars).items():
                yield f"{name}.{video.id}.json", file


def _write(path: Path, text: str) -> None:
    """Write a file of the plan if it changed; the disk is flushed once, after all of them."""
    artifact.write_if_changed(path, text, sync=False)


def _write_key(plan: Plan, code: sources.Cache, name: str, trial: str | None) -> None:
    """Write the configuration and the key file of an artifact, or of one trial of it."""
    node, table = dag.NODES[name], plan.tables[name]
    overlay = next((each.overlay for each in plan.trials if each.id == trial), {})
    if trial and dag.table_of(node) == recipes.TRIED_TABLE:
        table = recipes.merged(table, overlay)
    name = f"{name}.{trial}" if trial else name
    _write(plan.home.plan / f"configs/{name}.json", _json(table))
    key = {
        "stage": node.stage,
        "version": node.version,
        "code": sources.digest(node.stage, code),
        "table": table,
        "videos": [
            [v.id, v.role, v.split, v.synchronized_with, v.offset_s, *([v.animal] if v.animal else [])]
            for v in jobs.deciding_videos(plan, node)
        ],
    }
    if files := sources.named_files(table):
        key["files"] = files
    if plan.home.animal:
        key["animal"] = plan.home.animal
    _write(plan.home.plan / f"keys/{name}.json", _json(key))


def mark_redo(home: Home, name: str) -> None:
    """Mark the artifact `name` of `home` to be made again by the next build."""
    known = jobs.read_jobs(home)
    marked = [job for job in known if job["artifact"] == name]
    if not marked:
        remedy = f"artifacts: {', '.join(dict.fromkeys(job['artifact'] for job in known))}"
        raise InputError("REC-007", f"no artifact {name!r}", str(home), remedy)
    for job in marked:
        artifact.write_if_changed(jobs.redo_mark(job["home"], job["id"]), "made again by the next build\n")
        Path(job["stamp"]).unlink(missing_ok=True)


def inputs(home: Home, names: Sequence[str], *, together: bool = False) -> str:
    """Return `--name path` of finished artifacts, from the variant or its agent.

    In a home of several animals ``together`` gives `--animals` in place of what is theirs. Raises REC-007,
    REC-008.
    """
    animals = [str(each.animal) for each in _animal_homes(home.base)]
    if home.animal and home.animal not in animals:
        remedy = f"animals: {', '.join(animals)}" if animals else "a home of one animal: leave out NAME="
        raise InputError("REC-007", "no such animal", str(home), remedy)
    known = {job["artifact"]: Path(job["out"]) for job in jobs.read_jobs(home)}
    unknown = [name for name in names if name not in known]
    if unknown:
        remedy = f"artifacts: {', '.join(known)}"
        raise InputError("REC-007", f"no artifact {unknown[0]!r}", str(home), remedy)
    own = home.folder / "animals"
    theirs = [name for name in names if not home.animal and known[name].is_relative_to(own)]
    if theirs and not together:
        what, each = f"{home} is a home of several animals", f"one of them: NAME={animals[0]}"
        raise InputError("REC-008", what, ", ".join(names), each)
    several = {name for name in names if dag.NODES[name].roles}
    options = [f"--animals {own}"] if theirs else []
    for name in (name for name in names if name not in theirs):
        path = known[name].parent if name in several else known[name]
        options.append(f"--{name.replace('_', '-')} {path}")
    return " ".join(options)


def new_agent(name: str, taken: Sequence[str] = ()) -> None:
    """Create the recipe and the capture folder of a new animal; an existing recipe is kept."""
    home = Home.parse(name)
    if name in taken:
        raise InputError("REC-004", f"`make {name}` means something else already", remedy="take another name")
    recipe = Path("agents", f"{home.agent}.toml")
    if not recipe.exists():
        template = Path("agents", "cat.toml").read_text()
        renamed = template.replace("captures/cat/", f"captures/{home.agent}/").replace(
            'name = "cat"', f'name = "{home.agent}"'
        )
        artifact.write_if_changed(recipe, renamed)
    Path("captures", home.agent).mkdir(parents=True, exist_ok=True)
    print(f"recipe {recipe}; put recordings into captures/{home.agent}/, then: make {home.agent}")


def _known_ids(base: Home) -> dict[str, str]:
    """Return the ids assigned so far by file name; none if the file is missing or invalid."""
    known = artifact.read_json(base.plan / "ids.json")
    ids = list(known.values())
    sound = all(isinstance(id, str) and re.fullmatch(r"v[0-9]{3,}", id) for id in ids)
    return known if sound and len(set(ids)) == len(ids) else {}


def _rules(plan: Plan, all_jobs: list[Job], after: Mapping[str, Sequence[str]]) -> str:
    """Return the Make rules: a stamp per job, a target per artifact, and one for the agent."""
    name, home = plan.home.agent, plan.home
    lines = ["# written by pipeline/workflow/plan.py"]
    stamped: dict[str, list[str]] = {}
    for job in all_jobs:
        stamped.setdefault(job.artifact, []).append(job.stamp)
        lines += [f"{job.stamp}: {' '.join(after[job.stamp])}", f"\t@$(RUN) {job.home} {job.id}"]
    for node, made in stamped.items():
        target = f"{name}.{node}"
        lines += [f".PHONY: {target} {target}.redo", f"{target}: {' '.join(made)}"]
        lines += [f"{target}.redo:", f"\t@$(PLAN) redo {home} {node}", f"\t@$(MAKE) $(NESTING) {target}"]
    if not home.tables:
        wanted = [job.stamp for job in _start_order(plan, all_jobs) if not dag.NODES[job.artifact].on_demand]
        pages = dict.fromkeys(
            f"{each.home_of(node).folder}/{node}/index.html"
            for each in plan.animals or (plan,)
            for node in ("home_simulator", "report", "simulator")
            if node in stamped
        )
        variant = "" if plan.animals else f" make {name} VARIANT=no_scene,"
        lines += [f".PHONY: {name}", f"{name}: {' '.join(wanted)}"]
        lines += [f"\t@echo '[{home}] done.{' Open:' if pages else ''}'"]
        lines += [f"\t@echo '  {page}'" for page in pages]
        following = f"make {name}.<artifact>[.redo],{variant} make new AGENT=<name>, make help"
        lines += [f"\t@echo 'Next: {following}'"]
    return "\n".join(lines) + "\n"


def _start_order(plan: Plan, all_jobs: Sequence[Job]) -> list[Job]:
    """Return the jobs in the order in which Make starts those that are ready.

    Make goes through its targets, waits for a free core at the first one that is ready, and starts over only
    at the end. What the templates are made from precedes the sessions, which wait for them. Flow of sessions
    comes after masks, as whose dependency Make starts it. Long recordings precede short ones; of the built-in
    sessions, which have no files yet, the test session is the longest.
    """
    place = {node.artifact: i for i, node in enumerate(dag.FLOW)}
    folder = Path("captures", plan.home.agent)
    sizes = {video.id: sources.recording_size(folder / video.file) for video in plan.videos}
    tests = {video.id for video in plan.videos if video.split == "test"}
    sessions = {video.id for video in plan.videos if video.role == "session"}

    def key(job: Job) -> tuple[int, int, int, bool]:
        phase = 2
        if place[job.artifact] < place["feature_basis"]:
            phase = 0
        elif job.artifact in ("masks", "flow"):
            phase = {"masks": 3, "flow": 4}[job.artifact] if job.video in sessions else 1
        elif place[job.artifact] >= place["video_poses"]:
            phase = 5
        return phase, place[job.artifact], -sizes.get(job.video or "", 0), job.video not in tests

    return sorted(all_jobs, key=key)


def _json(value: Any) -> str:
    return json.dumps(value, indent=1, sort_keys=True) + "\n"


def _input_fingerprint(home: Home, code: sources.Cache) -> str:
    """Hash names, sizes and times of all files that a plan depends on."""
    paths = Path("agents", f"{home.agent}.toml"), Path("agents", "variants", f"{home.variant}.toml")
    read = [path for path in paths if path.is_file()]
    own = [[sources.stat_fingerprint(path), sources.named_files(recipes.read(path)[0])] for path in read]
    folders = ("agents/variants", f"captures/{home.agent}")
    return artifact.digest_of([code.fingerprint, own, *map(sources.folder_fingerprint, folders)])


def _output_fingerprint(home: Home) -> str:
    """Hash the modification times of a plan's files, and of its folders with a file per job or key."""
    found = []
    animals = (each.plan for each in _animal_homes(home.base))
    for plan in dict.fromkeys((home.base.plan, home.plan, *animals)):
        names = "dag.json rules.mk videos.json ids.json cache.json keys configs redo".split()
        paths = [plan / name for name in names]
        found += [[str(path), path.stat().st_mtime_ns] for path in paths if path.exists()]
    return artifact.digest_of(found)


def _animal_homes(base: Home) -> list[Home]:
    """Return the homes of the animals planned before."""
    found = sorted((base.folder / "animals").glob("*/plan"))
    return [replace(base, animal=path.parent.name) for path in found]


def _plan(home: Home, code: sources.Cache) -> None:
    """Plan `home` and its agent, unless nothing that a plan depends on has changed."""
    home = home.base if home.animal else home
    for each in dict.fromkeys((home.base, home, *_animal_homes(home.base))):
        stamps.remove_impossible(each)
    fingerprint, state = _input_fingerprint(home, code), home.plan / "state.json"
    match artifact.read_json(state):
        case {"read": inputs_before, "written": outputs_before, "messages": list(messages)}:
            if inputs_before == fingerprint and outputs_before == _output_fingerprint(home):
                print(*messages, sep="\n", end="\n" if messages else "")
                return
    code.known = code.known or artifact.read_json(CODE_CACHE)
    cache = sources.Cache(artifact.read_json(home.plan / "cache.json"))
    planned = [read(each, cache) for each in dict.fromkeys((home.base, home))]
    with artifact.locked(home.base.folder / "plan.lock"):
        for plan in planned:
            write(plan, cache, code)
        _write(home.plan / "cache.json", json.dumps(cache.fresh, sort_keys=True))
        artifact.sync_disk(home.plan)
        messages = _messages(planned[0], home)
        print(*messages, sep="\n", end="\n" if messages else "", flush=True)
        done = {"read": fingerprint, "written": _output_fingerprint(home), "messages": messages}
        artifact.write_if_changed(state, _json(done))


def _messages(plan: Plan, home: Home) -> list[str]:
    """Return messages to the user about the recordings."""
    folder = Path("captures", home.agent)
    if plan.builtin:
        return [f"[{home}] nothing in {folder}/: building from the built-in synthetic capture"]
    unknown = captures.unknown_files(folder, plan.flow)
    unused = [v.file for v in plan.videos if v.role == "heldout" and v.synchronized_with is None]
    named = (captures.named(folder / name, plan.flow) for name in unknown)
    clock = "measures nothing until the recipe's [videos] sets its synchronized_with"
    first = {video.sha256: video.file for video in reversed(plan.videos)}
    again = [(video.file, first[video.sha256]) for video in plan.videos if first[video.sha256] != video.file]
    return [
        *(f"[{home}] {copy!r} is a copy of {file!r}: keep only one" for copy, file in again),
        *(f"[{home}] not a recording, left alone: {name}" for name in named),
        *(f"[{home}] {file!r} {clock}" for file in unused),
    ]


def main(arguments: list[str]) -> int:
    """Run the command line of the planner; returns its exit code."""
    match arguments:
        case ["plan", *homes] if homes:
            folders = (f"{sources.CODE}/{name}" for name in ("pipeline", "stages"))
            fingerprint = artifact.digest_of([sources.folder_fingerprint(folder) for folder in folders])
            code = sources.Cache(fingerprint=fingerprint)
            for home in map(Home.parse, homes):
                _plan(home, code)
            if code.fresh:
                with artifact.locked(CODE_CACHE.with_suffix(".lock")):
                    _write(CODE_CACHE, json.dumps(code.fresh, sort_keys=True))
        case ["redo", home, name]:
            mark_redo(Home.parse(home), name)
        case ["inputs" | "together" as kind, home, *names]:
            print(inputs(Home.parse(home), names, together=kind == "together"))
        case ["new", name, *taken]:
            new_agent(name, taken)
        case _:
            print(__doc__, file=sys.stderr)
            return 2
    return 0


if __name__ == "__main__":
    sys.exit(exit_code(lambda: main(sys.argv[1:])))
