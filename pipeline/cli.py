"""The door every stage program enters through: command line -> `Task` -> `run(task)` -> exit code.

A front declares what it reads; `enter` makes the options of that, checks the configuration strictly,
and turns `InputError` into one message and exit code 2. `Task` is all that a front knows of the disk.
"""

import argparse
import ast
import dataclasses
import inspect
import itertools
import os
import signal
import sys
import textwrap
import typing
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from pipeline import artifact, dag, videos
from pipeline import config as configuration
from pipeline.errors import InputError, disk_told
from pipeline.videos import Role, Split, Video


@dataclasses.dataclass(frozen=True)
class Task:
    """One run of one stage: its inputs, its configuration and the artifact it is to make."""

    stage: str
    config: Any
    """The stage's own `Config`."""
    out: Path
    """Where the artifact will stand."""
    video: str | None
    """Id of the recording, for stages that treat one at a time."""
    videos: tuple[Video, ...]
    """All recordings of the agent; empty when run by hand without `--videos`."""
    resume: Path | None
    """Folder for checkpoints; None: a killed run begins again."""
    threads: int
    key: str | None
    paths: dict[str, Path]
    """Inputs as given."""
    requested_device: str
    contents: dict[str, str] = dataclasses.field(default_factory=dict)
    """Hash of every artifact opened so far, for the manifest."""

    @property
    def device(self) -> str:
        """`cpu` or `cuda`; `auto` takes CUDA where there is a usable one. Raises DEP-002 where it is asked for in vain."""
        if self.requested_device == "cpu":
            return "cpu"
        import torch  # late: it costs seconds, and many stages need none

        if torch.cuda.is_available():
            return "cuda"
        if self.requested_device == "cuda":
            raise InputError(
                "DEP-002", "there is no CUDA device that torch can use", "--device cuda", "give --device cpu, or see make doctor"
            )
        return "cpu"

    def has(self, name: str) -> bool:
        """Tell whether the optional input `name` was given."""
        return name in self.paths

    def input(self, name: str) -> Path:
        """Return the folder of the finished artifact `name`, or the plain file or folder where it is none."""
        path = self.paths[name]
        if name in dag.NODES:
            return self._opened(path, name)
        if not path.exists():
            raise InputError("ART-003", f"{name} does not exist", str(path), "give an existing path")
        return path

    def per_video(self, name: str, roles: tuple[Role, ...] | None = None, splits: tuple[Split, ...] | None = None) -> dict[str, Path]:
        """Return the folder of `name` for every recording of `roles` and `splits`, by id, in id order.

        By default: every recording for which the flow makes this artifact.
        """
        if not self.videos:
            raise InputError("ART-004", f"which recordings of {name}?", self.stage, "give --videos build/<agent>/plan/videos.json")
        wanted = dag.NODES[name].roles if roles is None else roles
        chosen = sorted(v.id for v in self.videos if v.role in wanted and (splits is None or v.split in splits))
        return {id: self._opened(self.paths[name] / id, f"{name}/{id}") for id in chosen}

    def per_trial(self, name: str, trials: Sequence[str]) -> dict[str, Path]:
        """Return the folder of `name` for every one of the trials, by id."""
        return {id: self._opened(self.paths[name] / id, f"{name}/{id}") for id in trials}

    def per_variant(self, name: str, variants: Sequence[str]) -> dict[str, Path]:
        """Return the folder of `name` in every one of the agent's variants, by the variant's name."""
        folder = self.input("variants")
        return {variant: self._opened(folder / variant / name, f"{variant}/{name}") for variant in variants}

    @contextmanager
    def create(self) -> Iterator[Path]:
        """Yield the folder to fill; it becomes the artifact if, and only if, the block ends well."""
        settings = dataclasses.asdict(self.config)
        with artifact.create(self.out, stage=self.stage, config=settings, inputs=self.contents, key=self.key) as folder:
            yield folder

    def _opened(self, path: Path, name: str) -> Path:
        made, kind = artifact.opened(path, name), name.partition("/")[0]
        maker = dag.NODES[kind].stage.rpartition(".")[2] if kind in dag.NODES else made.stage
        if made.stage != maker:
            raise InputError("ART-006", f"is no {kind}: {made.stage} wrote it", str(path), f"give what {maker} wrote")
        self.contents[name] = made.content
        return path


def enter(
    doc: str,
    run: Callable[[Task], None],
    *,
    config: type,
    reads: tuple[str, ...] = (),
    optional: tuple[str, ...] = (),
    options: tuple[str, ...] = (),
) -> None:
    """Run a stage program: parse the command line, build its `Task`, run it, and exit.

    `doc` is the front's docstring and becomes `--help`; `reads` and `optional` name its inputs,
    `options` those fields of its configuration that the command line may set as well.
    """
    asked = not {"-h", "--help"}.isdisjoint(sys.argv)
    told = "\n".join(["settings of the stage's table, with their defaults:", *_settings(config())]) if asked else None
    parser = _parser(doc, told, reads, optional)
    for name in options:
        _add_option(parser, name, typing.get_type_hints(config)[name])
    given = parser.parse_args()
    stage = Path(sys.argv[0]).parent.name
    try:
        with disk_told(str(given.out)):
            run(_task(given, stage, config, reads + optional, options))
    except InputError as error:
        print(f"error: {error}", file=sys.stderr, flush=True)
        sys.exit(2)
    except KeyboardInterrupt:
        sys.exit(128 + signal.SIGINT)


def _settings(defaults: Any, table: str = "") -> Iterator[str]:
    """Yield a line per setting, name, default and what the source says beneath it; those of inner tables after their names."""
    said: dict[str, str] = {}
    for cls in (cls for cls in reversed(type(defaults).__mro__) if dataclasses.is_dataclass(cls)):
        body = ast.parse(textwrap.dedent(inspect.getsource(cls))).body[0].body
        for line, beneath in itertools.pairwise(body):
            if isinstance(line, ast.AnnAssign) and isinstance(beneath, ast.Expr) and isinstance(beneath.value, ast.Constant):
                said[line.target.id] = " ".join(str(beneath.value.value).split())
    for name, default in vars(defaults).items():
        if dataclasses.is_dataclass(default):
            yield from _settings(default, f"{table}{name}.")
        else:
            yield f"  {table}{name} = {default!r}  {said.get(name, '')}".rstrip()


def _parser(doc: str, told: str | None, reads: tuple[str, ...], optional: tuple[str, ...]) -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(description=doc, epilog=told, formatter_class=argparse.RawDescriptionHelpFormatter)
    for name in reads + optional:
        option = f"--{name.replace('_', '-')}"
        parser.add_argument(option, dest=name, type=Path, required=name in reads, metavar="PATH", help=_what(name))
    parser.add_argument("--config", type=Path, metavar="FILE", help="this stage's table, JSON or TOML (default: all defaults)")
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="artifact to write; appears when complete")
    parser.add_argument("--video", metavar="ID", help="the recording to treat, for example v002")
    parser.add_argument("--videos", type=Path, metavar="FILE", help="the agent's recordings: build/<agent>/plan/videos.json")
    parser.add_argument("--resume", type=Path, metavar="DIR", help="folder for checkpoints (default: none are kept)")
    parser.add_argument("--device", choices=("auto", "cpu", "cuda"), default="auto", help="where to compute (default: auto)")
    parser.add_argument("--threads", type=int, default=1, metavar="N", help="threads to use (default: 1)")
    parser.add_argument("--key", help=argparse.SUPPRESS)
    return parser


def _add_option(parser: argparse.ArgumentParser, name: str, hint: Any) -> None:
    option, told = f"--{name.replace('_', '-')}", f"the setting `{name}`"
    if hint is bool:
        parser.add_argument(option, dest=name, action="store_true", default=None, help=told)
    elif typing.get_origin(hint) is typing.Literal:
        parser.add_argument(option, dest=name, choices=typing.get_args(hint), help=told)
    else:
        parser.add_argument(option, dest=name, type=hint, metavar=hint.__name__.upper(), help=told)


def _what(name: str) -> str:
    if name not in dag.NODES:
        return f"path of the {name}"
    several = " (or the folder with one per recording)" if dag.NODES[name].roles else ""
    several = " (or the folder with one per trial)" if dag.NODES[name].trials == "each" else several
    return f"finished artifact `{name}`{several}"


def _task(given: argparse.Namespace, stage: str, config: type, names: tuple[str, ...], options: tuple[str, ...]) -> Task:
    _limit_threads(given.threads)
    table = configuration.read_table(given.config) if given.config else {}
    table |= {name: value for name in options if (value := getattr(given, name)) is not None}
    return Task(
        stage=stage,
        config=configuration.from_table(config, table, where=str(given.config or stage)),
        out=given.out,
        video=given.video,
        videos=videos.read(given.videos) if given.videos else (),
        resume=given.resume,
        threads=given.threads,
        key=given.key,
        paths={name: path for name in names if (path := getattr(given, name)) is not None},
        requested_device=given.device,
    )


def _limit_threads(threads: int) -> None:
    """Hold every library that is loaded, or will be, to `threads`."""
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
