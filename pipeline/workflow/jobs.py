"""The jobs of a build: the DAG expanded for one agent's recordings.

Standard library only, without side effects: `plan` writes the jobs, `run` runs them.
"""

import functools
import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from pipeline.core.errors import InputError
from pipeline.core.videos import SPLITS, Video
from pipeline.recordings import formats
from pipeline.workflow import artifact, captures, dag
from pipeline.workflow.dag import Flow, Need, Node
from pipeline.workflow.recipes import HOMES, NAME, NAME_RULE, Trial


@dataclass(frozen=True)
class Home:
    """Where artifacts are stored: the folder of an agent, a variant, or one of several animals."""

    agent: str
    variant: str | None = None
    tables: bool = False
    """A separate plan for `make behavior-tables`, whose artifacts are in the agent's folder."""
    animal: str | None = None

    @classmethod
    def parse(cls, text: str) -> "Home":
        """Read `agent`, `agent/tables`, `agent/variants/name` or `agent/animals/name`. Raises REC-004."""
        kind = "animals" if "/animals/" in text else "variants"
        agent, *rest = text.removesuffix("/tables").split(f"/{kind}/", 1)
        for name in (agent, *rest):
            if not NAME.match(name):
                what = f"{name!r} is no name for an agent or a variant"
                raise InputError("REC-004", what, remedy=NAME_RULE)
        if kind == "animals":
            return cls(agent, animal=rest[0])
        return cls(agent, *rest, tables=text.endswith("/tables"))

    def __str__(self) -> str:
        name = self.agent if self.variant is None else f"{self.agent}/variants/{self.variant}"
        name = name if self.animal is None else f"{name}/animals/{self.animal}"
        return f"{name}/tables" if self.tables else name

    @functools.cached_property
    def folder(self) -> Path:
        """Return the folder of its artifacts."""
        return Path("build", str(self).removesuffix("/tables"))

    @property
    def plan(self) -> Path:
        """Return the folder of its plan."""
        return Path("build", str(self), "plan")

    @property
    def command(self) -> str:
        """Return the command that plans and builds it."""
        command = f"make behavior-tables AGENT={self.agent}" if self.tables else f"make {self.agent}"
        return command + (f" VARIANT={self.variant}" if self.variant else "")

    @functools.cached_property
    def base(self) -> "Home":
        """Return the agent's own home."""
        return Home(self.agent)


@dataclass(frozen=True)
class Input:
    """One artifact that a job reads."""

    name: str
    path: str
    part: str | None
    """Subfolder that is read; None: the whole artifact."""


@dataclass(frozen=True)
class Job:
    """One artifact to make, with everything that `run` needs."""

    id: str
    artifact: str
    stage: str
    video: str | None
    trial: str | None
    home: str
    out: str
    inputs: tuple[Input, ...]
    keys: tuple[str, ...]
    """Files that determine the result together with the inputs."""
    arguments: tuple[str, ...]
    threads: int
    resumable: bool
    distributed: bool
    on_demand: bool

    @property
    def stamp(self) -> str:
        """Return the stamp file, Make's target."""
        return f"{self.out}/{artifact.STAMP}"


@dataclass(frozen=True)
class Plan:
    """Everything that is known before the first stage runs."""

    home: Home
    videos: tuple[Video, ...]
    builtin: bool
    """Whether the built-in capture replaces missing recordings."""
    tables: dict[str, dict[str, Any]]
    """Per artifact: its stage's table, with the variant's changes."""
    touched: frozenset[str]
    """Artifacts that the variant makes itself; for an agent, all."""
    flow: Flow = "recordings"
    trials: tuple[Trial, ...] = ()
    animals: tuple["Plan", ...] = ()
    """Plan of each animal in a home of several, each with its own turnaround only."""
    others: tuple[str, ...] = ()
    """Names of the other animals in an animal's plan, of all animals in the plan of a home of several."""

    @property
    def nodes(self) -> tuple[Node, ...]:
        """Return the nodes to make, in flow order; in a home of several animals the shared ones."""
        several = bool(self.animals or self.home.animal)
        found = dag.nodes_of(self.flow, trials=self.home.tables, several=several)
        found = tuple(node for node in found if self.builtin or node.artifact not in dag.BUILTIN.values())
        if self.animals:
            return tuple(node for node in found if node.artifact not in of_animal())
        if self.home.animal:
            return tuple(node for node in found if not any(need.variants for need in dag.needs_of(node)))
        return found

    def home_of(self, name: str) -> Home:
        """Return the home of the artifact `name`."""
        return self.home if name in self.touched else self.home.base


def of_animal() -> frozenset[str]:
    """Return the artifacts made per animal in a home of several: the first such node and all downstream."""
    found: set[str] = set()
    for node in dag.FLOW:
        needs = [need.artifact for need in dag.needs_of(node) if not (need.others or need.alone)]
        if node.begins_animal or not found.isdisjoint(needs):
            found.add(node.artifact)
    return frozenset(found)


def touched_by(tables: Mapping[str, Any], changed: Mapping[str, Any], mapped: bool) -> frozenset[str]:
    """Return the artifacts that an overlay changes: those with another table, and everything downstream.

    With ``mapped`` recordings also the artifacts that these replace, so that both are in one home.
    """
    found: set[str] = set()
    for _ in range(2 if mapped else 1):
        for node in dag.FLOW:
            from_touched = any(need.artifact in found for need in dag.needs_of(node))
            if tables[node.artifact] != changed[node.artifact] or from_touched:
                found.add(node.artifact)
                if mapped and node.stands_in_for:
                    found.add(node.stands_in_for)
    return frozenset(found)


def with_animals(plan: Plan) -> Plan:
    """Add a plan per animal if there are several."""
    names = [video.animal for video in plan.videos if video.animal]
    if names and plan.home != plan.home.base:
        what = f"{plan.home.agent} is a home of several animals, of which there are no variants and tables"
        raise InputError("REC-008", what, str(plan.home), f"make {plan.home.agent}")
    reading = [node.artifact for node in dag.FLOW if any(need.others for need in dag.needs_of(node))]

    def tables(others: Sequence[str]) -> dict[str, dict[str, Any]]:
        return plan.tables | {each: {**plan.tables[each], "others": list(others)} for each in reading}

    def own(name: str) -> Plan:
        others = tuple(other for other in names if other != name)
        videos = tuple(video for video in plan.videos if video.animal in (None, name))
        home, touched = replace(plan.home, animal=name), of_animal()
        return replace(plan, home=home, videos=videos, tables=tables(others), touched=touched, others=others)

    return replace(plan, animals=tuple(map(own, names)), others=tuple(names), tables=tables(names))


def expand(plan: Plan) -> list[Job]:
    """Expand the DAG for the plan's recordings and trials, in flow order."""

    def parts(node: Node) -> list[Video | Trial | None]:
        if node.trials == "each":
            return list(plan.trials)
        if not node.roles:
            return [None]
        shown = [video for video in plan.videos if video.role in node.roles]
        if node.mapped:
            return [video for video in shown if video.mapped]
        return [video for video in shown if dag.folder_of(node.artifact, video) == node.artifact]

    shared = [_job(plan, node, part) for node in plan.nodes for part in parts(node)]
    return shared + [job for each in plan.animals for job in expand(each) if job.home == str(each.home)]


def direct_dependencies(all_jobs: Sequence[Job]) -> dict[str, list[str]]:
    """Return the dependencies of each stamp that no other one implies (tens of thousands of edges fewer)."""
    inputs = {job.stamp: dict.fromkeys(f"{i.path}/{artifact.STAMP}" for i in job.inputs) for job in all_jobs}
    found = {}
    for stamp, mine in inputs.items():
        implied: set[str] = set()
        for theirs in (inputs.get(each, {}) for each in mine):
            implied |= mine.keys() & theirs.keys()  # linear in the smaller of the two
        found[stamp] = [each for each in mine if each not in implied]
    return found


def deciding_videos(plan: Plan, node: Node) -> list[Video]:
    """Return the recordings whose set and split affect the result of a node with a single job."""
    if node.roles:
        return []
    deciding = {(role, split) for role in node.role_dependencies for split in SPLITS}
    for need in dag.needs_of(node, plan.flow):
        roles = need.roles or dag.NODES[need.artifact].roles
        deciding |= {(role, split) for role in roles for split in need.splits}
    return [video for video in plan.videos if (video.role, video.split) in deciding]


def jobs_file(home: Home) -> Path:
    """Return the file with the jobs of a plan, one per line."""
    return home.plan / "dag.json"


def read_jobs(home: Home) -> list[dict[str, Any]]:
    """Read all planned jobs. Raises RUN-001."""
    return json.loads(_planned(home))


def read_job(home: Home, job_id: str) -> dict[str, Any]:
    """Read a planned job, parsing only its line of thousands. Raises RUN-001."""
    text = _planned(home)
    if not (start := text.find(f'\n{{"id": {json.dumps(job_id)},'.encode()) + 1):
        raise InputError("RUN-001", f"has no job {job_id!r}", str(home), f"see {jobs_file(home)}")
    try:
        return json.loads(text[start : text.find(b"\n", start)].rstrip(b","))
    except (ValueError, RecursionError) as error:
        remedy = f"delete {jobs_file(home)}, and run `{home.command}`"
        raise InputError("RUN-001", "holds no planned jobs", str(jobs_file(home)), remedy) from error


def _planned(home: Home) -> bytes:
    try:
        return jobs_file(home).read_bytes()
    except FileNotFoundError:
        raise InputError("RUN-001", "is not planned yet", str(home), f"run `{home.command}`") from None


def redo_mark(home: str, job_id: str) -> Path:
    """Return the marker file that makes `run` repeat a job although its key is unchanged."""
    return Path("build", home, "plan", "redo", job_id)


def _job(plan: Plan, node: Node, part: Video | Trial | None) -> Job:
    home = plan.home_of(node.artifact)
    video = part if isinstance(part, Video) else None
    trial = part if isinstance(part, Trial) else None
    out = home.folder / node.artifact / (part.id if part else "")
    inputs, arguments, deciding = _read_by(plan, node, part)
    named = f"{node.artifact}.{trial.id}" if trial else node.artifact
    arguments += ["--config", str(home.plan / f"configs/{named}.json"), "--out", str(out)]
    listed = (home if home.animal else home.base).plan / "videos.json"
    arguments += ["--videos", str(listed), *(["--video", video.id] if video else [])]
    keys_folder = home.base.plan / "keys"
    keys = [str(home.plan / f"keys/{named}.json")]
    for each in deciding:
        keys.append(str(keys_folder / f"video.{each.id}.json"))
        for name, file in captures.sidecars(plan.home.agent, each.file, node.sidecars).items():
            keys.append(str(keys_folder / f"{name}.{each.id}.json"))
            arguments += [f"--{name}", str(file)] if each is video else []
    own = home.variant is None and home.animal is None
    for file in captures.extra_inputs(plan.home.agent, node.extra_inputs, artifacts=own):
        keys.append(str(keys_folder / f"extra.{file.name}"))
        arguments += [f"--{file.stem}", str(file)]
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
        resumable=node.resumable,
        distributed=node.distributed,
        on_demand=node.on_demand,
    )


def _read_by(
    plan: Plan, node: Node, part: Video | Trial | None
) -> tuple[list[Input], list[str], list[Video]]:
    """Return a job's inputs, the options for them, and the recordings that affect its result."""
    folder, video = Path("captures", plan.home.agent), part if isinstance(part, Video) else None
    inputs: list[Input] = []
    arguments: list[str] = []
    deciding = [video] if video else []
    for need in (each for each in dag.needs_of(node, plan.flow) if _is_read(plan, node, each, video)):
        if need.artifact in dag.BUILTIN.values() and not plan.builtin:
            if video:
                scale_from = formats.scale_sources(folder, video, plan.videos)
                arguments += [f"--{need.option}", f"{folder}/{video.file}"]
                arguments += ["--captures", str(folder)] if scale_from else []
                deciding += scale_from
            continue
        inputs += _inputs(plan, need, node, part)
        option = f"--{need.option or need.artifact.replace('_', '-')}"
        arguments += [] if option in arguments else [option, str(_path_read(plan, node, need, part))]
        arguments += ["--variants", str(plan.home.base.folder / "variants")] if need.variants else []
    return inputs, arguments, deciding


def _is_read(plan: Plan, node: Node, need: Need, video: Video | None) -> bool:
    """Return whether a job of this home, and of its recording if it has one, reads what its node may need."""
    source = dag.NODES[need.artifact]
    in_home = not need.alone if plan.others else not (source.of_several or need.others)
    in_recipe = need.homes == "any" or bool(plan.tables[node.artifact].get(HOMES))
    if video is None:
        readers = [each for each in plan.videos if each.mapped and each.role in (need.readers or dag.AGENT)]
        return in_home and in_recipe and bool(readers or not need.mapped)
    roles_of_several = source.roles if source.of_several else ()
    by_role = all(video.role in roles for roles in (need.readers, roles_of_several) if roles)
    return in_home and in_recipe and by_role and (video.mapped or not need.mapped)


def _path_read(plan: Plan, node: Node, need: Need, part: Video | Trial | None) -> Path:
    """Return where a job reads a need: its only input, or the folder that holds several."""
    if need.homes == "other":
        return Path("build")
    if need.others:
        return plan.home.base.folder / "animals"
    source = dag.NODES[need.artifact]
    by_recording = source.roles and (need.roles or not node.roles)
    if by_recording or (source.trials == "each" and not isinstance(part, Trial)):
        return plan.home_of(need.artifact).folder / need.artifact
    only = next(_inputs(plan, need, node, part))
    return Path(only.path, only.part or "")


def _inputs(plan: Plan, need: Need, node: Node, part: Video | Trial | None) -> Iterator[Input]:
    """Yield the artifacts that satisfy one need of a job."""
    source = dag.NODES[need.artifact]
    folder = plan.home_of(need.artifact).folder / need.artifact
    if need.others:
        for name in plan.others:
            path = replace(plan.home, animal=name).folder / need.artifact
            yield Input(f"{name}/{need.artifact}", str(path), need.part)
        return
    if need.homes == "other":
        for name in plan.tables[node.artifact][HOMES]:
            yield Input(f"{name}/{need.artifact}", str(Path("build", name, need.artifact)), need.part)
        return
    if need.per_animal and plan.home.animal:
        need = replace(need, part=f"{need.part}/{plan.home.animal}")
    if source.trials == "each":
        for trial in [part] if isinstance(part, Trial) else plan.trials:
            yield Input(f"{need.artifact}/{trial.id}", str(folder / trial.id), need.part)
        return
    if not source.roles:
        inner = f"{need.part}/{part.file}" if need.part and isinstance(part, Video) else need.part
        yield Input(need.artifact, str(folder), inner)
        for other in (Home(plan.home.agent, variant) for variant in need.variants):
            yield Input(f"{other}/{need.artifact}", str(other.folder / need.artifact), inner)
        return
    own = [part] if isinstance(part, Video) and not need.roles else None
    for video in own or [each for each in plan.videos if need.wants(each, source.roles)]:
        made = dag.folder_of(need.artifact, video)
        yield Input(f"{made}/{video.id}", f"{plan.home_of(made).folder}/{made}/{video.id}", need.part)
