"""Measure masks where the truth is known and the sensor is real: the built-in animal drawn into a real RGB-D
sequence.

Each drawn recording is a 7-Scenes style folder that `extract_frames` reads, with the truth beside it. The
animal comes and goes: in a good share of the frames there is none.

    python -m benchmarks.semi_real draw SEQUENCE OUT --seeds 1 2 [--first 500 --step 3] [--registered]
    python -m benchmarks.semi_real score OUT [--masks masks]

A whole build: the walk-through is another part of the sequence without the animal, the turnaround is the
built-in capture's with the same coat; sessions come without their poses, so that registration has no odometry.

    python -m benchmarks.semi_real draw SEQUENCE OUT --empty --last 499 --registered
    python -m benchmarks.semi_real draw SEQUENCE OUT --seeds 1 2 --coat 8 --first 500 --registered --no-poses
    cp -r OUT/recordings/* build/toy/synthetic_capture/recordings/turnaround.r3d captures/kitchen/
    cp agents/toy.toml agents/kitchen.toml && make kitchen.registration
    python -m benchmarks.semi_real registration build/kitchen OUT/truth build/toy/synthetic_capture/truth \\
        --structure SEQUENCE

With `--structure` cameras are also judged by structure from motion on the sequence's colour pictures
(`benchmarks.structure`), brought to the build's world and metres by the walk-through's cameras.
"""

import argparse
import json
import re
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float, Integer

from benchmarks import structure
from benchmarks.composited import Compositor, Sequence, course, measure_noise, surfaces
from pipeline.core.progress import log
from pipeline.core.videos import Video
from pipeline.core.videos import read as read_videos
from pipeline.data import images, npz
from pipeline.data.poses import RegisteredPoses
from pipeline.data.templates import AgentCameras, SceneCameras
from pipeline.geometry import rigid
from pipeline.metrics.pose_errors import constant_between, joined, pose_errors
from stages.evaluate.registration import FLIPPED_DEG
from stages.synthesize_capture import animal, gait

SEEN_SHARE = 0.001
"""Share of a picture above which it shows the animal."""
RATE_HZ = 30.0
"""frames are numbered at this rate in 7-Scenes folders"""


@dataclass(frozen=True)
class Drawing:
    """What is drawn into a sequence, and how it is written."""

    coat: int | None = None
    """Seed of the animal's looks; None: that of its course."""
    empty: bool = False
    """Nothing is drawn: a walk-through."""
    poses: bool = True
    """Whether the recording has the sequence's poses."""


def draw(sequence: Sequence, out: Path, name: str, seed: int, drawing: Drawing = Drawing()) -> None:
    """Draw one recording and its truth."""
    rng = np.random.default_rng([seed, 41])
    poses = sequence.poses()
    timestamp_s = np.abs(np.array(sequence.numbers) - sequence.numbers[0]) / RATE_HZ
    noise = measure_noise(sequence)
    grounds = surfaces(sequence, poses)
    log(f"{name}: noise {noise}, surfaces {[(round(s.height_m, 2), int(s.free.sum())) for s in grounds]}")
    lived, there = course(sequence, poses, timestamp_s, grounds, rng)
    there = there & (not drawing.empty)
    motion = gait.poses(lived, timestamp_s)
    creature = animal.grow(np.random.default_rng([seed if drawing.coat is None else drawing.coat, 2]))
    folder = out / "recordings" / name
    folder.mkdir(parents=True)
    (out / "truth").mkdir(exist_ok=True)
    np.savetxt(folder / "camera-intrinsics.txt", sequence.intrinsics)
    masks = []
    for index, frame in enumerate(Compositor(sequence, creature, noise, rng).frames(poses, motion, there)):
        base = folder / f"frame-{round(timestamp_s[index] * RATE_HZ):06d}"
        cv2.imwrite(f"{base}.color.jpg", frame.color[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 95])
        cv2.imwrite(f"{base}.depth.png", np.round(frame.depth * 1000).astype(np.uint16))
        if drawing.poses:
            np.savetxt(f"{base}.pose.txt", poses[index])
        masks.append(frame.mask)
    packed = np.packbits(np.stack(masks), axis=-1)
    npz.save(
        out / "truth" / f"{name}.npz", compress=True, timestamp_s=timestamp_s, packed=packed,
        source_index=np.round(timestamp_s * RATE_HZ).astype(int),
        shape=np.array([len(masks), *masks[0].shape]), world_from_camera=poses, number=sequence.numbers,
        world_from_agent=motion.world_from_agent, there=there,
    )  # fmt: skip


def figures(labels: np.ndarray, truth: np.ndarray, seen_share: float = SEEN_SHARE) -> dict[str, float]:
    """Return the bars' figures of ``[frame height width]`` labels (255 animal, 128 unknown) and truth (bool).

    Unknown pixels count neither way. A frame shows the animal if more than ``seen_share`` of its pixels do;
    frames with fewer, but some, are judged by no presence figure.
    """
    found, sure = labels == 255, labels != 128
    true_px = (truth & sure).sum((1, 2))
    both, found_px = (found & truth).sum((1, 2)), found.sum((1, 2))
    seen, empty = truth.mean((1, 2)) > seen_share, ~truth.any((1, 2))
    iou = both / np.maximum(found_px + true_px - both, 1)
    return {
        "frames": len(labels), "frames_with": int(seen.sum()), "frames_without": int(empty.sum()),
        "false_frames": float((found_px[empty] > 0).mean()) if empty.any() else np.nan,
        "found_frames": float((found_px[seen] > 0).mean()), "iou_mean": float(iou[seen].mean()),
        "iou_pooled": float(both.sum() / (found_px + true_px - both).sum()),
        "precision": float(both.sum() / max(found_px.sum(), 1)), "recall": float(both.sum() / true_px.sum()),
    }  # fmt: skip


def read_truth(path: Path, index: np.ndarray) -> np.ndarray:
    """Read truth masks of the extracted frames, by their index in the recording."""
    table = npz.load(path)
    row = np.searchsorted(table["source_index"], index)
    return np.unpackbits(table["packed"][row], axis=-1, count=int(table["shape"][2])).astype(bool)


def registered(build: Path, truth: Path, turnaround: Path, sequence: Path | None = None) -> dict[str, float]:
    """Return medians and percentiles of camera and root errors over all frames of all sessions.

    Roots are judged where more than 0.1 % of the picture shows the animal, relative to the camera: the poses
    of the sequence, by which the animal was drawn, are no truth of the room (KinectFusion's scale may differ
    from the sensor's by several percent), but what a picture shows relative to its camera is exact. `placed`
    is the share of these frames that have a root, `root_where_empty` that of frames without the animal.
    With ``sequence`` cameras are judged by structure from motion on its pictures as well.
    Metres and degrees.
    """
    videos = {Path(v.file).stem: v for v in read_videos(build / "plan" / "videos.json")}
    walk = _rows(build, videos["walkthrough"], npz.load(truth / "walkthrough.npz"))
    ours = SceneCameras.open(build / "scene_template").world_from_registered
    world_from_true = constant_between(ours, walk["world_from_camera"])
    index = npz.load(build / "frames" / videos["turnaround"].id / "frames.npz")["source_index"]
    around = {key: value[index] for key, value in npz.load(turnaround / "turnaround.npz").items()
              if key in ("world_from_agent", "world_from_camera")}  # fmt: skip
    true_agent_from_camera = rigid.inverse(around["world_from_agent"]) @ around["world_from_camera"]
    agent_from_true = constant_between(
        AgentCameras.open(build / "agent_template").agent_from_registered, true_agent_from_camera
    )
    cameras, roots, empty, shown = [], [], [], {}
    for name, video in videos.items():
        if video.role != "session":
            continue
        table = _rows(build, video, npz.load(truth / f"{name}.npz"))
        poses = RegisteredPoses.open(build / "registration" / video.id) or RegisteredPoses.unknown(
            table["timestamp_s"]
        )
        shown[name] = Shown(poses.world_from_camera, table["number"])
        cameras.append(pose_errors(poses.world_from_camera, world_from_true @ table["world_from_camera"]))
        true_roots = rigid.inverse(table["world_from_camera"]) @ table["world_from_agent"]
        true_roots = true_roots @ rigid.inverse(agent_from_true)
        own_roots = rigid.inverse(poses.world_from_camera) @ poses.world_from_agent
        share = np.unpackbits(table["packed"], axis=-1, count=int(table["shape"][2])).mean((1, 2))
        roots.append(pose_errors(own_roots, true_roots)[share > SEEN_SHARE])
        empty.append(np.isfinite(poses.world_from_agent[share == 0, 0, 3]))
    camera, root = joined(cameras), joined(roots)
    placed = np.isfinite(root.meters)
    by_structure = (
        {} if sequence is None else _by_structure(Shown(ours, walk["number"]), shown, sequence, truth)
    )
    return by_structure | {
        "frames": len(camera.meters), "camera_deg_median": float(np.median(camera.degrees)),
        "camera_m_median": float(np.median(camera.meters)), "camera_deg_p95": _p95(camera.degrees),
        "camera_m_p95": _p95(camera.meters), "root_frames": len(placed), "root_placed": float(placed.mean()),
        "root_m_median": float(np.median(root.meters[placed])), "root_m_p95": _p95(root.meters[placed]),
        "root_deg_median": float(np.median(root.degrees[placed])),
        "root_flips": float((root.degrees[placed] > FLIPPED_DEG).mean()),
        "root_where_empty": float(np.concatenate(empty).mean()),
    }  # fmt: skip


@dataclass(frozen=True)
class Shown:
    """A recording's cameras in our world, and the number of the sequence's frame that each shows."""

    world_from_camera: Float[np.ndarray, "frame 4 4"]
    number: Integer[np.ndarray, "frame"]

    def where(self, known: dict[int, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
        """Return the cameras that the reference has too, ours and its own."""
        rows = [row for row, number in enumerate(self.number.tolist()) if number in known]
        return self.world_from_camera[rows], np.stack([known[int(self.number[row])] for row in rows])


def _by_structure(walk: Shown, sessions: dict[str, Shown], sequence: Path, out: Path) -> dict[str, float]:
    """Compare cameras with structure from motion, computed once for ``out``."""
    frames = np.unique(np.concatenate([walk.number, *(each.number for each in sessions.values())])).tolist()
    known = structure.cameras(sequence, frames, out / "structure")
    pairs = {name: each.where(known) for name, each in {"walk": walk, **sessions}.items()}
    errors = {name: pose_errors(ours, structure.in_world(*pairs["walk"], other))
              for name, (ours, other) in pairs.items()}  # fmt: skip
    found = {"walk": errors.pop("walk"), "camera": joined(list(errors.values()))}
    return {f"structure_{name}_{key}": value for name, each in found.items()
            for key, value in (("frames", len(each.meters)), ("deg_median", float(np.median(each.degrees))),
                               ("m_median", float(np.median(each.meters))), ("deg_p95", _p95(each.degrees)),
                               ("m_p95", _p95(each.meters)))}  # fmt: skip


def _rows(build: Path, video: Video, table: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return the rows of a truth table at the extracted frames of a recording."""
    index = npz.load(build / "frames" / video.id / "frames.npz")["source_index"]
    row = np.searchsorted(table["source_index"], index)
    return {key: value if key == "shape" else value[row] for key, value in table.items()}


def _p95(values: np.ndarray) -> float:
    return float(np.percentile(np.nan_to_num(values, nan=np.inf), 95))


def main() -> None:
    """Parse the command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    commands = parser.add_subparsers(dest="command", required=True)
    one = commands.add_parser("draw")
    one.add_argument("sequence", type=Path)
    one.add_argument("out", type=Path)
    one.add_argument("--seeds", type=int, nargs="+", default=[1])
    one.add_argument("--first", type=int, default=0)
    one.add_argument("--last", type=int, default=10**6)
    one.add_argument("--step", type=int, default=3, help="negative: played backwards")
    one.add_argument("--registered", action="store_true", help="bring depth into the colour camera first")
    one.add_argument("--coat", type=int, help="seed of the animal's looks; otherwise each recording's own")
    one.add_argument("--empty", action="store_true", help="draw nothing: a walk-through")
    one.add_argument("--no-poses", action="store_true", help="leave the sequence's poses out")
    two = commands.add_parser("score", help="score masks/<name> by truth/<name>")
    two.add_argument("out", type=Path)
    two.add_argument("--masks", default="masks")
    three = commands.add_parser("registration", help="cameras and roots of a build, against the truth")
    three.add_argument("build", type=Path)
    three.add_argument("truth", type=Path, help="OUT/truth")
    three.add_argument("turnaround", type=Path, help="truth folder of the turnaround")
    three.add_argument(
        "--structure", type=Path, metavar="SEQUENCE", help="judge cameras by its pictures, too"
    )
    task = parser.parse_args()
    if task.command == "draw":
        known = sorted(int(re.findall(r"\d+", p.name)[0]) for p in task.sequence.glob("frame-*.depth.png"))
        numbers = [n for n in known if task.first <= n <= task.last][:: task.step]
        drawing = Drawing(task.coat, task.empty, not task.no_poses)
        sequence = Sequence(task.sequence, tuple(numbers), task.registered)
        for seed in task.seeds:
            draw(sequence, task.out, "walkthrough" if task.empty else f"session-{seed}", seed, drawing)
    elif task.command == "registration":
        for name, value in registered(task.build, task.truth, task.turnaround, task.structure).items():
            print(f"{name:50s} {value:.4g}")
    else:
        for folder in sorted((task.out / task.masks).iterdir()):
            index = npz.load(task.out / "frames" / folder.name / "frames.npz")["source_index"]
            truth = read_truth(task.out / "truth" / f"{folder.name}.npz", index)
            labels = np.stack([images.read_gray(p) for p in sorted(folder.glob("*.png"))])
            print(folder.name, json.dumps({k: round(v, 4) for k, v in figures(labels, truth).items()}))


if __name__ == "__main__":
    main()
