"""What the command lines of benchmarks share: help, the build of an agent, and a process per measurement."""

import argparse
import multiprocessing
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

from pipeline.core import videos

Result = TypeVar("Result")


def described(docstring: str | None) -> argparse.ArgumentParser:
    """Return a parser whose help is the docstring of a module as it stands."""
    return argparse.ArgumentParser(
        description=docstring, formatter_class=argparse.RawDescriptionHelpFormatter
    )


def for_agent(docstring: str | None) -> argparse.ArgumentParser:
    """Return a parser for one agent of a folder of builds; `build_of` reads both."""
    parser = described(docstring)
    parser.add_argument("agent", help="agent of the build, for example cat")
    parser.add_argument("--build", type=Path, default=Path("build"), help="folder of builds")
    return parser


def build_of(arguments: argparse.Namespace) -> Path:
    """Return the build that the arguments of `for_agent` name."""
    return arguments.build / arguments.agent


def recordings(build: Path, role: videos.Role) -> list[str]:
    """Return the ids of the recordings of a build with a role, in order."""
    return [video.id for video in videos.read(build / "plan" / "videos.json") if video.role == role]


def in_own_process(function: Callable[..., Result], *arguments: object) -> Result:
    """Return the result of a call in a new process, so that its memory and time are its own."""
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        return pool.apply(function, arguments)
