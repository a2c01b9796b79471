"""Serve a page on which the same things are clicked in sessions and in the walk-through.

`evaluate` reads the clicks. It has a command line of its own because it makes no artifact: it serves
until it is stopped, and the file of clicks is the user's, beside the recordings.

make annotate AGENT=luna        or: python -m stages.annotate build/luna --clicks captures/luna/clicks.json
"""

import contextlib
import sys
from pathlib import Path

from pipeline.core import loopback, videos
from pipeline.core.errors import CommandLine, exit_code
from pipeline.workflow import artifact, dag
from stages.annotate import serving, stage

ROLES = ("walkthrough", "session", "heldout")
PORT = 8765


def main(arguments: list[str]) -> int:
    """Serve until Ctrl-C; return 2 if the build lacks what the page needs."""
    parser = CommandLine(__doc__, prog="python -m stages.annotate")
    parser.add_argument("build", type=Path, help="build/<agent>, built up to scene_template")
    parser.add_argument(
        "--clicks", type=Path, required=True, help="file to keep clicks in, captures/<agent>/clicks.json"
    )
    parser.add_argument("--port", type=int, default=PORT, help=f"port on 127.0.0.1 (default: {PORT}; 0: any)")

    def program() -> int:
        given = parser.parse_args(arguments)
        server = serving.ClickServer(_session(given.build, given.clicks), given.port)
        address = f"http://{loopback.HOST}:{server.server_address[1]}"
        print(f"open {address} ; clicks go to {given.clicks}; Ctrl-C ends", flush=True)
        with contextlib.suppress(KeyboardInterrupt):
            server.serve_forever()
        return 0

    return exit_code(program)


def _session(build: Path, clicks: Path) -> serving.ClickSession:
    """Find frames and template of a build. Raises ART-001 if they are not finished."""
    artifact.opened(build / "scene_template", "scene_template")
    shown = [video for video in videos.read(build / "plan" / "videos.json") if video.role in ROLES]
    frames = {video.file: build / dag.folder_of("frames", video) / video.id for video in shown}
    for folder in frames.values():
        artifact.opened(folder, f"{folder.parent.name}/{folder.name}")
    walkthrough = next(video.file for video in shown if video.role == "walkthrough")
    return stage.run(frames, build / "scene_template", walkthrough, clicks)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
