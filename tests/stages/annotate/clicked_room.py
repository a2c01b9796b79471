"""The parts of a build of a textured room that annotation needs: frames of a walk-through and a session, a
template.
"""

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pipeline.data import images, npz
from pipeline.data.clicks import ClickedPair, ClickedPixel
from pipeline.data.templates import SceneCameras
from pipeline.geometry import cameras, rigid
from pipeline.geometry.meshes import RayCaster
from pipeline.workflow import artifact
from tests.stages.textured_room import INTRINSICS, SIZE, MemoryClip, textured_room, walk

WALKTHROUGH, SESSION = "walkthrough.r3d", "session.r3d"


@dataclass(frozen=True)
class Room:
    """The folder of the build and its ground truth."""

    build: Path
    walkthrough: MemoryClip
    session: MemoryClip

    def pairs(self, frame: int, count: int, rng: np.random.Generator) -> list[ClickedPair]:
        """Return exact clicks in one session frame."""
        found = []
        while len(found) < count:
            pixel = rng.uniform(0.15, 0.85, 2) * SIZE[::-1]
            depth = self.session.depth(frame)[int(pixel[1]), int(pixel[0])]
            world = rigid.apply(self.session.truth[frame], cameras.unproject(pixel, INTRINSICS)[None] * depth)
            for other in range(len(self.walkthrough)):
                there, z = cameras.project(
                    rigid.apply(rigid.inverse(self.walkthrough.truth[other]), world), INTRINSICS
                )
                share = there[0] / SIZE[::-1]
                if z[0] < 0.3 or (share < 0.1).any() or (share > 0.9).any():
                    continue
                if abs(self.walkthrough.depth(other)[int(there[0, 1]), int(there[0, 0])] - z[0]) < 0.02:
                    seen = ClickedPixel(SESSION, 3 * frame, tuple((pixel / SIZE[::-1]).tolist()))
                    found.append(
                        ClickedPair(seen, ClickedPixel(WALKTHROUGH, 3 * other, tuple(share.tolist())))
                    )
                    break
        return found


def build(folder: Path) -> Room:
    """Write `frames` of both recordings (every third recorded frame), `scene_template` and the list of
    recordings.
    """
    caster = RayCaster(textured_room(0, edge_m=0.08))
    walkthrough, session = (
        MemoryClip(caster, walk(count, seed), walk(count, seed), noise_m=0.002)
        for count, seed in ((8, 0), (4, 1))
    )
    for id, clip in (("v000", walkthrough), ("v001", session)):
        with artifact.create(folder / "frames" / id, stage="extract_frames", config={}, inputs={}) as out:
            _write_frames(out, clip)
    with artifact.create(
        folder / "scene_template", stage="build_scene_template", config={}, inputs={}
    ) as out:
        registered = np.ones(len(walkthrough), bool)
        SceneCameras(
            walkthrough.timestamp_s, walkthrough.truth, walkthrough.intrinsics, registered, registered
        ).write(out)
    rest = {"sha256": None, "synchronized_with": None, "offset_s": 0.0}
    videos = [
        {"id": "v000", "file": WALKTHROUGH, "role": "walkthrough", "split": "none", **rest},
        {"id": "v001", "file": SESSION, "role": "session", "split": "train", **rest},
    ]
    (folder / "plan").mkdir()
    (folder / "plan" / "videos.json").write_text(json.dumps(videos))
    return Room(folder, walkthrough, session)


def _write_frames(out: Path, clip: MemoryClip) -> None:
    clip.write_color(out)
    (out / "depth").mkdir()
    for frame in range(len(clip)):
        images.write_depth(out / "depth" / f"{frame:06d}.exr", clip.depth(frame))
    npz.save(
        out / "frames.npz",
        timestamp_s=clip.timestamp_s,
        intrinsics=clip.intrinsics,
        depth_intrinsics=clip.intrinsics,
        odometry_from_camera=clip.truth,
        gravity_known=np.array(True),
        source_index=3 * np.arange(len(clip)),
        quality=clip.quality,
    )
