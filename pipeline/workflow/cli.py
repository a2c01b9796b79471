"""The command line of every stage program: options -> `Inputs` and `Config` -> `run` -> exit code.

`main` derives the options from the fields of the stage's `Inputs`, checks the configuration strictly, opens
the inputs as finished artifacts, has `run` fill the new artifact, and turns `InputError` into one message and
exit code 2.
"""

import argparse
import ast
import dataclasses
import inspect
import itertools
import os
import sys
import tempfile
import textwrap
import types
import typing
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from pipeline.core import config as configuration
from pipeline.core import devices, videos
from pipeline.core.errors import CommandLine, InputError, coded_disk_errors, exit_code
from pipeline.core.videos import Video
from pipeline.workflow import artifact, dag, recipes
from pipeline.workflow.dag import Need


@dataclasses.dataclass(frozen=True)
class InputField:
    """One field of a stage's `Inputs`, as the command line sees it."""

    name: str
    required: bool
    several: bool
    """One folder per recording, trial or variant instead of one path."""


@dataclasses.dataclass(frozen=True)
class Task:
    """What one run of a stage is given, and the artifacts that it has opened."""

    stage: str
    config: Any
    """The stage's own `Config`."""
    videos: tuple[Video, ...]
    """All recordings of the agent; empty when run by hand without `--videos`."""
    paths: dict[str, Path]
    """Inputs as given."""
    contents: dict[str, str] = dataclasses.field(default_factory=dict)
    """Hash of every artifact opened so far, for the manifest."""

    def input(self, name: str) -> Path:
        """Return the folder of the finished artifact `name`, or a plain file or folder as it is."""
        path = self.paths[name]
        if name in dag.NODES:
            return self._opened(path, name)
        if not path.exists():
            raise InputError("ART-003", f"{name} does not exist", str(path), "give an existing path")
        return path

    def field(self, field: InputField) -> Path | dict[str, Path] | None:
        """Return the value of a field of the stage's `Inputs`; None for an optional one not given."""
        if field.name not in self.paths:
            return None
        if not field.several:
            return self.input(field.name)
        folder, nodes = self.paths[field.name], [node for node in dag.FLOW if node.stage == self.stage]
        needs = [need for node in nodes for need in dag.needs_of(node)]
        named = [need for need in needs if field.name == (need.option or need.artifact)]
        if field.name == "variants":
            need = next(need for need in needs if need.variants)
            return self._below(self.input("variants"), need.variants, need.artifact)
        if others := [need.artifact for need in named if need.others]:
            return self._below(folder, self.config.others, others[0])
        if of_homes := [need.artifact for need in named if need.homes == "other"]:
            for artifact_name in of_homes:
                self._below(folder, self.config.homes, artifact_name)
            return {name: folder / name for name in self.config.homes}
        need = named[0] if named else Need(field.name)
        if dag.NODES[need.artifact].trials == "each":
            trials = recipes.trial_ids(self.config.methods, self.config.seeds)
            return {id: self._opened(folder / id, f"{field.name}/{id}") for id in trials}
        return self._per_video(need)

    def recording(self, id: str | None) -> Video | None:
        """Return the recording to process; None if the stage was run by hand without `--video`."""
        if id is None:
            return None
        for video in self.videos:
            if video.id == id:
                return video
        remedy = "give --videos build/<agent>/plan/videos.json that lists it"
        raise InputError("ART-004", f"which recording is {id!r}?", self.stage, remedy)

    def _per_video(self, need: Need) -> dict[str, Path]:
        """Return an artifact's folder by recording, for the need's roles (default: the artifact's own)."""
        if not self.videos:
            remedy = "give --videos build/<agent>/plan/videos.json"
            raise InputError("ART-004", f"which recordings of {need.artifact}?", self.stage, remedy)
        found, folder = {}, self.paths[need.option or need.artifact]
        for video in sorted(self.videos, key=lambda video: video.id):
            if need.wants(video, dag.NODES[need.artifact].roles):
                made = dag.folder_of(need.artifact, video)
                holding = folder if made == need.artifact else folder.parent / made
                found[video.id] = self._opened(holding / video.id, f"{made}/{video.id}")
        return found

    def _below(self, folder: Path, names: Sequence[str], artifact: str) -> dict[str, Path]:
        """Return the folder of `artifact` in every one of these variants or animals, by its name."""
        return {name: self._opened(folder / name / artifact, f"{name}/{artifact}") for name in names}

    def _opened(self, path: Path, name: str) -> Path:
        made, kind = artifact.opened(path, name), name.partition("/")[0]
        nodes = [node for node in dag.FLOW if kind in (node.artifact, node.stands_in_for)]
        makers = [node.stage.rpartition(".")[2] for node in nodes]
        if makers and made.stage not in makers:
            what = f"is no {kind}: {made.stage} wrote it"
            raise InputError("ART-006", what, str(path), f"give what {makers[0]} wrote")
        self.contents[name] = made.content
        return path


def main(
    doc: str | None, run: Callable[..., object], inputs: type, config: type, *, options: tuple[str, ...] = ()
) -> None:
    """Run a stage program: parse the command line, open its inputs, have `run` fill the artifact, and exit.

    `doc` is the front's docstring and becomes `--help`. `inputs` is a dataclass of paths: `Path` is a
    required option, `Path | None` an optional one, `Mapping[str, Path]` one folder per recording, trial or
    variant, as the flow declares. `run(inputs, config, out, ...)` gets by keyword what its signature names
    among `device`, `threads`, `resume` (folder for checkpoints or None), `videos` (all recordings) and
    `video` (the one to treat, or None). `options` are fields of the configuration that the command line may
    set as well.
    """
    fields = input_fields(inputs)
    helping = not {"-h", "--help"}.isdisjoint(sys.argv)
    settings = ["settings of the stage's table, with their defaults:"] if helping else []
    settings += _settings(config()) if helping else []
    parser = _parser(_program(run), doc, "\n".join(settings) or None, fields)
    for name in options:
        _add_option(parser, name, typing.get_type_hints(config)[name])

    def program() -> int:
        given = parser.parse_args()
        _limit_threads(given.threads)
        with coded_disk_errors(str(given.out)):
            task = _task(given, _program(run), config, fields, options)
            _run(run, inputs(**{field.name: task.field(field) for field in fields}), task, given)
        return 0

    if code := exit_code(program):
        sys.exit(code)


def input_fields(inputs: type) -> tuple[InputField, ...]:
    """Return the fields of a stage's `Inputs`; an unsupported type is a programming error."""
    kinds = {Path: False, Mapping[str, Path]: True}
    found = []
    for name, hint in typing.get_type_hints(inputs).items():
        choices = typing.get_args(hint) if isinstance(hint, types.UnionType) else (hint,)
        known = [kind for kind in choices if kind is not types.NoneType]
        assert len(known) == 1 and known[0] in kinds, f"{inputs.__qualname__}.{name}: {hint}"
        found.append(InputField(name, required=types.NoneType not in choices, several=kinds[known[0]]))
    return tuple(found)


def _program(run: Callable[..., object]) -> str:
    """Return the name of the stage program that defines `run`, as declared in the flow."""
    parts = run.__module__.split(".")
    return ".".join(parts[1:-1]) if parts[0] == "stages" else Path(sys.argv[0]).parent.name


def _run(run: Callable[..., object], inputs: object, task: Task, given: argparse.Namespace) -> None:
    offered: dict[str, Callable[[], object]] = {
        "device": lambda: devices.choose(given.device),
        "threads": lambda: given.threads,
        "resume": lambda: given.resume,
        "videos": lambda: task.videos,
        "video": lambda: task.recording(given.video),
    }
    accepted = inspect.signature(run).parameters
    known = {name: offer() for name, offer in offered.items() if name in accepted}
    stage, settings = task.stage.rpartition(".")[2], dataclasses.asdict(task.config)
    made = artifact.create(given.out, stage=stage, config=settings, inputs=task.contents, key=given.key)
    # of the processes that torchrun started, only rank 0 publishes the artifact
    leads = os.environ.get("RANK", "0") == "0" or "TORCHELASTIC_RUN_ID" not in os.environ
    with made if leads else tempfile.TemporaryDirectory() as folder:
        run(inputs, task.config, Path(folder), **known)


def _settings(defaults: Any, table: str = "") -> Iterator[str]:
    """Yield a line per setting, inner tables' too: name, default and what the source says beneath it."""
    documented: dict[str, str] = {}
    for cls in (cls for cls in reversed(type(defaults).__mro__) if dataclasses.is_dataclass(cls)):
        definition = ast.parse(textwrap.dedent(inspect.getsource(cls))).body[0]
        assert isinstance(definition, ast.ClassDef), cls
        for pair in itertools.pairwise(definition.body):
            match pair:
                case ast.AnnAssign(target=ast.Name(id=name)), ast.Expr(value=ast.Constant(value=text)):
                    documented[name] = " ".join(str(text).split())
    for name, default in vars(defaults).items():
        if dataclasses.is_dataclass(default):
            yield from _settings(default, f"{table}{name}.")
        else:
            yield f"  {table}{name} = {default!r}  {documented.get(name, '')}".rstrip()


def _parser(
    stage: str, doc: str | None, epilog: str | None, fields: Sequence[InputField]
) -> argparse.ArgumentParser:
    parser = CommandLine(doc, prog=f"python -m stages.{stage}", epilog=epilog)

    def path(name: str, metavar: str, text: str, *, required: bool = False) -> None:
        option = f"--{name.replace('_', '-')}"
        parser.add_argument(option, dest=name, type=Path, required=required, metavar=metavar, help=text)

    for field in fields:
        path(field.name, "PATH", _what(field.name), required=field.required)
    path("config", "FILE", "this stage's table, JSON or TOML (default: all defaults)")
    path("out", "DIR", "artifact to write; appears when complete", required=True)
    parser.add_argument("--video", metavar="ID", help="the recording to treat, for example v002")
    path("videos", "FILE", "the agent's recordings: build/<agent>/plan/videos.json")
    path("resume", "DIR", "folder for checkpoints (default: none are kept)")
    devices_known, where = ("auto", "cpu", "cuda"), "where to compute (default: auto)"
    parser.add_argument("--device", choices=devices_known, default="auto", help=where)
    parser.add_argument("--threads", type=int, default=1, metavar="N", help="threads to use (default: 1)")
    parser.add_argument("--key", help=argparse.SUPPRESS)
    return parser


def _add_option(parser: argparse.ArgumentParser, name: str, hint: Any) -> None:
    option, text = f"--{name.replace('_', '-')}", f"the setting `{name}`"
    if hint is bool:
        parser.add_argument(option, dest=name, action="store_true", default=None, help=text)
    elif typing.get_origin(hint) is tuple:
        parser.add_argument(option, dest=name, nargs="+", metavar="NAME", help=text)
    elif typing.get_origin(hint) is typing.Literal:
        parser.add_argument(option, dest=name, choices=typing.get_args(hint), help=text)
    else:
        parser.add_argument(option, dest=name, type=hint, metavar=hint.__name__.upper(), help=text)


def _what(name: str) -> str:
    if name not in dag.NODES:
        return f"path of the {name}"
    several = " (or the folder with one per recording)" if dag.NODES[name].roles else ""
    several = " (or the folder with one per trial)" if dag.NODES[name].trials == "each" else several
    return f"finished artifact `{name}`{several}"


def _task(
    given: argparse.Namespace, stage: str, config: type, fields: Sequence[InputField], options: Sequence[str]
) -> Task:
    table = configuration.read_table(given.config) if given.config else {}
    table |= {name: value for name in options if (value := getattr(given, name)) is not None}
    checked = configuration.from_table(config, table, where=str(given.config or stage))
    recordings = videos.read(given.videos) if given.videos else ()
    paths = {field.name: getattr(given, field.name) for field in fields}
    return Task(stage, checked, recordings, {name: path for name, path in paths.items() if path is not None})


def _limit_threads(threads: int) -> None:
    """Limit every library, loaded now or later, to `threads`."""
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ[name] = str(threads)
    if "torch" in sys.modules:
        sys.modules["torch"].set_num_threads(threads)
    if "cv2" in sys.modules:
        sys.modules["cv2"].setNumThreads(threads)
    if "numba" in sys.modules:
        sys.modules["numba"].set_num_threads(min(threads, sys.modules["numba"].config.NUMBA_NUM_THREADS))
    else:
        os.environ["NUMBA_NUM_THREADS"] = str(threads)
