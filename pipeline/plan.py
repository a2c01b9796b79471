"""The planner: recipe + recordings + declaration -> `build/<home>/plan/`, which Make, Snakemake and `run` read.

    python -SE -m pipeline.plan plan HOME             HOME is an agent, <agent>/variants/<name>, or <agent>/tables
    python -SE -m pipeline.plan redo HOME ARTIFACT    have one artifact made again
    python -SE -m pipeline.plan new AGENT             a recipe and a capture folder for a new animal

Every check of the user's input happens before anything is written; a file is rewritten only when its content
changes, so that its age tells Make what is to be looked at. Standard library only: it runs at every `make`.
"""

import json
import re
import sys
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from pipeline import artifact, captures, dag, recipes, sources
from pipeline.dag import Flow, Need, Node
from pipeline.errors import InputError
from pipeline.recipes import Trial
from pipeline.videos import Video

NAME = re.compile(r"[a-z0-9][a-z0-9_-]{0,62}\Z")
NAME_RULE = "use a-z, 0-9, _ and -, beginning with a letter or digit, 63 at most"


@dataclass(frozen=True)
class Home:
    """Where artifacts stand: an agent's own folder or one of its variants'."""

    agent: str
    variant: str | None = None
    tables: bool = False
    """A plan of its own, with the trials of `make behavior-tables`, whose artifacts stand among the agent's."""

    @classmethod
    def parse(cls, text: str) -> "Home":
        """Read `agent`, `agent/tables` or `agent/variants/name`; raises REC-004 for names that are no plain names."""
        agent, *rest = text.removesuffix("/tables").split("/variants/", 1)
        for name in (agent, *rest):
            if not NAME.match(name):
                raise InputError("REC-004", f"{name!r} is no name for an agent or a variant", remedy=NAME_RULE)
        return cls(agent, *rest, tables=text.endswith("/tables"))

    def __str__(self) -> str:
        name = self.agent if self.variant is None else f"{self.agent}/variants/{self.variant}"
        return f"{name}/tables" if self.tables else name

    @property
    def folder(self) -> Path:
        """Return where its artifacts stand."""
        return Path("build", str(self).removesuffix("/tables"))

    @property
    def plan(self) -> Path:
        """Return where its plan stands."""
        return Path("build", str(self), "plan")

    @property
    def base(self) -> "Home":
        """Return the agent's own home."""
        return Home(self.agent)


@dataclass(frozen=True)
class Input:
    """One artifact that a job reads."""

    name: str
    path: str
    part: str | None
    """Prefix of the files that count, where it is not the whole artifact."""


@dataclass(frozen=True)
class Job:
    """One artifact to make, with all that `run` needs to know."""

    id: str
    artifact: str
    stage: str
    video: str | None
    trial: str | None
    home: str
    out: str
    inputs: tuple[Input, ...]
    keys: tuple[str, ...]
    """Files that, with the inputs, decide the result."""
    arguments: tuple[str, ...]
    threads: int
    gpu: int
    memory_mb: int
    resumable: bool
    aside: bool

    @property
    def stamp(self) -> str:
        """Return the file that Make looks at."""
        return f"{self.out}/{artifact.STAMP}"


@dataclass(frozen=True)
class Plan:
    """Everything that is known before the first stage runs."""

    home: Home
    videos: tuple[Video, ...]
    builtin: bool
    """Whether there are no recordings and the built-in capture stands in."""
    tables: dict[str, dict[str, Any]]
    """Per artifact: its stage's table, with the variant's changes."""
    touched: frozenset[str]
    """Artifacts that the variant makes anew; all of them for an agent itself."""
    flow: Flow = "recordings"
    trials: tuple[Trial, ...] = ()

    @property
    def nodes(self) -> tuple[Node, ...]:
        """Return what is to be made, in flow order."""
        found = dag.nodes_of(self.flow, trials=self.home.tables)
        return tuple(node for node in found if self.builtin or node.artifact not in dag.BUILTIN.values())

    def home_of(self, name: str) -> Home:
        """Return where the artifact `name` stands."""
        return self.home if name in self.touched else self.home.base


def read(home: Home, cache: sources.Cache) -> Plan:
    """Check recipe and recordings and return the plan; changes nothing on disk."""
    recipe, where = recipes.read(Path("agents", f"{home.agent}.toml"), cache)
    flow = recipes.flow(recipe.get(recipes.FLOW_TABLE, {}), where)
    overlay = {}
    if home.variant:
        overlay, _ = recipes.read(Path("agents", "variants", f"{home.variant}.toml"), cache)
    tables = {n.artifact: {**recipe.get(dag.table_of(n), {}), **n.fixed} for n in dag.FLOW}
    changed = {n.artifact: {**recipes.merged(tables[n.artifact], overlay.get(dag.table_of(n), {})), **n.fixed} for n in dag.FLOW}
    folder = Path("captures", home.agent)
    names = captures.find(folder, flow)
    if names:
        said = captures.remarks(folder, names, recipe.get(recipes.VIDEOS_TABLE, {}), where)
        hashes = {name: _digest_of_recording(folder / name, cache) for name in names}
    else:
        said = recipes.builtin_remarks(flow, recipe, cache, where)
        hashes = dict.fromkeys(said)
    videos = captures.assign(said, _known_ids(home.base), hashes, str(folder) if names else where, flow)
    touched = _touched(tables, changed) if home.variant else frozenset(dag.NODES)
    if home.tables:
        touched = frozenset(n.artifact for n in dag.FLOW if n.trials != "none")
    trials = tuple(recipes.trials(recipe.get(recipes.TABLES_STAGE, {}), cache)) if home.tables else ()
    return Plan(home, videos, not names, changed, touched, flow, trials)


def jobs(plan: Plan) -> list[Job]:
    """Expand the declaration for the plan's recordings and trials, in flow order."""

    def parts(node: Node) -> list[Video | Trial | None]:
        if node.trials == "each":
            return list(plan.trials)
        return [video for video in plan.videos if video.role in node.roles] if node.roles else [None]

    return [_job(plan, node, part) for node in plan.nodes for part in parts(node)]


def write(plan: Plan, cache: sources.Cache) -> None:
    """Write the plan's files, each only if it changed."""
    all_jobs = jobs(plan)
    base = plan.home.base.plan
    artifact.write_if_changed(base / "ids.json", _json(_known_ids(plan.home.base) | {video.file: video.id for video in plan.videos}))
    artifact.write_if_changed(base / "videos.json", _json([asdict(video) for video in plan.videos]))
    for video in plan.videos:
        artifact.write_if_changed(base / f"keys/video.{video.id}.json", _json({"role": video.role, "sha256": video.sha256}))
    for file in (file for node in dag.FLOW for file in captures.beside(plan.home.agent, node.beside)):
        artifact.write_if_changed(base / f"keys/beside.{file.name}", _json({"sha256": cache.get(file, artifact.digest_of_file)}))
    for name, trial in {(job.artifact, job.trial) for job in all_jobs if job.home == str(plan.home)}:
        node, table = dag.NODES[name], plan.tables[name]
        overlay = next((each.overlay for each in plan.trials if each.id == trial), {})
        if trial and dag.table_of(node) == recipes.TRIED_TABLE:
            table = recipes.merged(table, overlay)
        name = f"{name}.{trial}" if trial else name
        artifact.write_if_changed(plan.home.plan / f"configs/{name}.json", _json(table))
        key = {
            "stage": node.stage,
            "version": node.version,
            "code": sources.digest(node.stage, cache),
            "table": table,
            "videos": [[v.id, v.role, v.split, v.synchronized_with, v.offset_s] for v in _seen(plan, node)],
        }
        artifact.write_if_changed(plan.home.plan / f"keys/{name}.json", _json(key))
    for job in all_jobs:  # there from the start, so that a job that fails leaves no trace
        lock_file(job.home, job.id).parent.mkdir(parents=True, exist_ok=True)
        lock_file(job.home, job.id).touch()
    lines = [json.dumps(asdict(job) | {"stamp": job.stamp}, sort_keys=True) for job in all_jobs]
    artifact.write_if_changed(plan.home.plan / "dag.json", "[\n" + ",\n".join(lines) + "\n]\n")
    artifact.write_if_changed(plan.home.plan / "rules.mk", _rules(plan, all_jobs))


def mark_redo(home: Home, name: str) -> None:
    """Have the artifact `name` of `home` made again by the next build, although nothing changed."""
    known = json.loads((home.plan / "dag.json").read_text())
    marked = [job for job in known if job["artifact"] == name]
    if not marked:
        raise InputError("REC-007", f"no artifact {name!r}", str(home), f"artifacts: {', '.join(dag.NODES)}")
    for job in marked:
        artifact.write_if_changed(redo_mark(job["home"], job["id"]), "made again by the next build\n")
        Path(job["stamp"]).unlink(missing_ok=True)


def redo_mark(home: str, job_id: str) -> Path:
    """Return the file whose presence has `run` do a job although its key is unchanged."""
    return Path("build", home, "plan", "redo", job_id)


def lock_file(home: str, job_id: str) -> Path:
    """Return the file whose kernel lock a runner holds while it does a job."""
    return Path("build", home, "plan", "locks", job_id)


def new_agent(name: str) -> None:
    """Write the recipe and the capture folder of a new animal; an existing recipe stays as it is."""
    home = Home.parse(name)
    recipe = Path("agents", f"{home.agent}.toml")
    if not recipe.exists():
        template = Path("agents", "cat.toml").read_text()
        renamed = template.replace("captures/cat/", f"captures/{home.agent}/").replace('name = "cat"', f'name = "{home.agent}"')
        artifact.write_if_changed(recipe, renamed)
    Path("captures", home.agent).mkdir(parents=True, exist_ok=True)
    print(f"recipe {recipe}; put recordings into captures/{home.agent}/, then: make {home.agent}")


def _digest_of_recording(path: Path, cache: sources.Cache) -> str:
    if path.is_file():
        return cache.get(path, artifact.digest_of_file)
    files = sorted(file for file in path.rglob("*") if file.is_file())
    return artifact.digest_of({file.relative_to(path).as_posix(): cache.get(file, artifact.digest_of_file) for file in files})


def _known_ids(base: Home) -> dict[str, str]:
    try:
        return json.loads((base.plan / "ids.json").read_text())
    except (FileNotFoundError, ValueError):
        return {}


def _touched(tables: Mapping[str, Any], changed: Mapping[str, Any]) -> frozenset[str]:
    """Return what an overlay changes: the artifacts with another table, and all that is made from them."""
    touched: set[str] = set()
    for node in dag.FLOW:
        from_touched = any(need.artifact in touched for need in dag.needs_of(node))
        if tables[node.artifact] != changed[node.artifact] or from_touched:
            touched.add(node.artifact)
    return frozenset(touched)


def _job(plan: Plan, node: Node, part: Video | Trial | None) -> Job:
    home, video, trial = plan.home_of(node.artifact), part if isinstance(part, Video) else None, part if isinstance(part, Trial) else None
    out = home.folder / node.artifact / (part.id if part else "")
    inputs: list[Input] = []
    arguments: list[str] = []
    for need in dag.needs_of(node, plan.flow):
        if need.artifact in dag.BUILTIN.values() and not plan.builtin:
            if video:
                arguments += [f"--{need.option}", f"captures/{plan.home.agent}/{video.file}"]
            continue
        found = list(_inputs(plan, need, node, part))
        inputs += found
        source = dag.NODES[need.artifact]
        several = (source.roles and not node.roles) or (source.trials == "each" and not trial)
        path = plan.home_of(need.artifact).folder / need.artifact if several else Path(found[0].path, found[0].part or "")
        arguments += [f"--{need.option or need.artifact.replace('_', '-')}", str(path)]
        arguments += ["--variants", str(plan.home.base.folder / "variants")] if need.variants else []
    named = f"{node.artifact}.{trial.id}" if trial else node.artifact
    arguments += ["--config", str(home.plan / f"configs/{named}.json"), "--out", str(out)]
    arguments += ["--videos", str(home.base.plan / "videos.json"), *(["--video", video.id] if video else [])]
    keys = [str(home.plan / f"keys/{named}.json"), *([str(home.base.plan / f"keys/video.{video.id}.json")] if video else [])]
    for file in captures.beside(plan.home.agent, node.beside):
        keys, arguments = [*keys, str(home.base.plan / f"keys/beside.{file.name}")], [*arguments, f"--{file.stem}", str(file)]
    return Job(
        id=f"{node.artifact}.{part.id}" if part else node.artifact,
        artifact=node.artifact,
        stage=node.stage,
        video=video.id if video else None,
        trial=trial.id if trial else None,
        home=str(home),
        out=str(out),
        inputs=tuple(inputs),
        keys=tuple(keys),
        arguments=tuple(arguments),
        threads=node.threads,
        gpu=node.gpu,
        memory_mb=node.memory_mb,
        resumable=node.resumable,
        aside=node.aside,
    )


def _inputs(plan: Plan, need: Need, node: Node, part: Video | Trial | None) -> Iterator[Input]:
    """Yield the artifacts that one need of one job means."""
    source = dag.NODES[need.artifact]
    folder = plan.home_of(need.artifact).folder / need.artifact
    if source.trials == "each":
        for trial in [part] if isinstance(part, Trial) else plan.trials:
            yield Input(f"{need.artifact}/{trial.id}", str(folder / trial.id), need.part)
        return
    if not source.roles:
        inner = f"{need.part}/{part.file}" if need.part and isinstance(part, Video) else need.part
        yield Input(need.artifact, str(folder), inner)
        others = [Home(plan.home.agent, variant) for variant in need.variants]
        yield from (Input(f"{other}/{need.artifact}", str(other.folder / need.artifact), inner) for other in others)
        return
    for other in [part] if node.roles else plan.videos:
        if node.roles or (other.role in (need.roles or source.roles) and other.role in source.roles and other.split in need.splits):
            yield Input(f"{need.artifact}/{other.id}", str(folder / other.id), need.part)


def _seen(plan: Plan, node: Node) -> list[Video]:
    """Return the recordings whose set and split decide the result of a node that is one job for all."""
    if node.roles:
        return []
    roles, splits = set(node.sees), {role: {"train", "test", "none"} for role in node.sees}
    for need in dag.needs_of(node, plan.flow):
        for role in need.roles or dag.NODES[need.artifact].roles:
            roles.add(role)
            splits.setdefault(role, set()).update(need.splits)
    return [video for video in plan.videos if video.role in roles and video.split in splits[video.role]]


def _rules(plan: Plan, all_jobs: list[Job]) -> str:
    """Return the Make rules: one stamp per job, one target per artifact, and the agent's own."""
    name, home = plan.home.agent, plan.home
    lines = ["# written by pipeline/plan.py"]
    stamps: dict[str, list[str]] = {}
    for job in all_jobs:
        stamps.setdefault(job.artifact, []).append(job.stamp)
        needed = dict.fromkeys([*(f"{i.path}/{artifact.STAMP}" for i in job.inputs), *job.keys])
        lines += [f"{job.stamp}: {' '.join(needed)}", f"\t@$(RUN) {home} {job.id}"]
    for node, made in stamps.items():
        lines += [f".PHONY: {name}.{node} {name}.{node}.redo", f"{name}.{node}: {' '.join(made)}"]
        lines += [f"{name}.{node}.redo:", f"\t@$(PLAN) redo {home} {node}", f"\t@$(MAKE) $(NESTING) {name}.{node}"]
    if not home.tables:
        pages = [f"{plan.home_of(node).folder}/{node}/index.html" for node in ("report", "simulator") if node in stamps]
        lines += [f".PHONY: {name}", f"{name}: {' '.join(job.stamp for job in all_jobs if not dag.NODES[job.artifact].aside)}"]
        lines += [f"\t@echo '[{home}] done.{' Open:' if pages else ''}'", *(f"\t@echo '  {page}'" for page in pages)]
        lines += [f"\t@echo 'Next: make {name}.<artifact>[.redo], make {name} VARIANT=no_scene, make new AGENT=<name>, make help'"]
    return "\n".join(lines) + "\n"


def _json(value: Any) -> str:
    return json.dumps(value, indent=1, sort_keys=True) + "\n"


def _cache(home: Home) -> sources.Cache:
    """Return what earlier runs of the planner read, by size and time of the files; lost, it only costs time."""
    try:
        return sources.Cache(json.loads((home.plan / "cache.json").read_text()))
    except (FileNotFoundError, ValueError):
        return sources.Cache()


def _plan(home: Home) -> None:
    """Plan `home`; a variant stands on an up-to-date plan of its agent."""
    cache = _cache(home)
    planned = [read(each, cache) for each in dict.fromkeys((home.base, home))]
    with artifact.held(home.base.folder / "plan.lock"):
        for plan in planned:
            write(plan, cache)
        artifact.write_if_changed((home.plan / "cache.json"), json.dumps(cache.fresh))
    folder = Path("captures", home.agent)
    if planned[0].builtin:
        print(f"[{home}] nothing in {folder}/: building from the built-in synthetic capture")
    else:
        for name in captures.not_understood(folder, planned[0].flow):
            print(f"[{home}] not a recording, left alone: {name!r}")
        for video in planned[0].videos:
            if video.role == "heldout" and video.synchronized_with is None:
                print(f"[{home}] {video.file!r} measures nothing until the recipe's [videos] says what it is synchronized_with")


def main(arguments: list[str]) -> int:
    """Run the command line of the planner; returns its exit code."""
    try:
        match arguments:
            case ["plan", home]:
                _plan(Home.parse(home))
            case ["redo", home, name]:
                mark_redo(Home.parse(home), name)
            case ["new", name]:
                new_agent(name)
            case _:
                print(__doc__, file=sys.stderr)
                return 2
    except InputError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
