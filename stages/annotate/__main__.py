"""Serve a page on which the same things are clicked in sessions and in the walk-through; `evaluate` reads the clicks.

make annotate AGENT=luna        or: python -m stages.annotate build/luna --clicks captures/luna/clicks.json
"""

import argparse
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pipeline import artifact, videos
from pipeline.errors import InputError
from pipeline.files import arrays
from pipeline.files.clicks import Recorded
from stages.annotate import choosing, serving


@dataclass(frozen=True)
class Config:
    """What is shown."""

    frames: int = 4
    """Frames per session and held-out phone to click in."""
    references: int = 30
    """Frames of the walk-through to click in."""


def main(arguments: list[str]) -> int:
    """Serve until Ctrl-C; return 2 where the build does not go that far."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("build", type=Path, help="build/<agent>, built up to scene_template")
    parser.add_argument("--clicks", type=Path, required=True, help="file to keep clicks in, captures/<agent>/clicks.json")
    parser.add_argument("--port", type=int, default=8765, help="port on 127.0.0.1 (default: 8765; 0: any)")
    given = parser.parse_args(arguments)
    try:
        server = serving.server(_desk(given.build, given.clicks, Config()), given.port)
    except InputError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    except OSError as error:
        print(
            f"error: {InputError('SYS-002', f'port {given.port}: {error.strerror}', serving.HOST, 'give another with --port')}",
            file=sys.stderr,
        )
        return 2
    print(f"open http://{serving.HOST}:{server.server_address[1]} ; clicks go to {given.clicks}; Ctrl-C ends", flush=True)
    try:
        server.serve_forever()
    except KeyboardInterrupt:
        pass
    return 0


def _desk(build: Path, clicks: Path, settings: Config) -> serving.Desk:
    """Open frames and template of a build. Raises ART-001 where they are not finished."""
    artifact.opened(build / "scene_template", "scene_template")
    wanted = [video for video in videos.read(build / "plan" / "videos.json") if video.role in ("walkthrough", "session", "heldout")]
    for video in wanted:
        artifact.opened(build / "frames" / video.id, f"frames/{video.id}")
    recordings = {video.file: Recorded.open(build / "frames" / video.id) for video in wanted}
    cameras = arrays.load(build / "scene_template" / "cameras.npz", ("world_from_camera", "registered"))
    reference = next(video.file for video in wanted if video.role == "walkthrough")
    shown = {name: choosing.spread(each.clip.quality, settings.frames) for name, each in recordings.items()}
    shown[reference] = choosing.spread(recordings[reference].clip.quality, settings.references, cameras["registered"])
    world_from_reference = np.where(cameras["registered"][:, None, None], cameras["world_from_camera"], np.nan)
    return serving.Desk(recordings, shown, reference, world_from_reference, clicks)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
