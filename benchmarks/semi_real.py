"""Evaluate masks and registration on semi-synthetic recordings: the built-in animal rendered into a real RGB-D
sequence, with exact ground truth.

The sequence is a recording with depth in any format that `extract_frames` reads. Poses are those of the recording, else
its depth is aligned from frame to frame. Each drawn recording is a 7-Scenes style folder at 30 Hz, with the ground truth
in a separate folder. The animal enters and leaves the scene; many frames show none.

    python -m benchmarks.semi_real draw RECORDING OUT --seeds 1 2 [--first 500 --step 3]
    python -m benchmarks.semi_real score BUILD OUT/truth

For a whole build, the walk-through is another part of the sequence without the animal, and the turnaround is that of
the built-in capture with the same coat; sessions have no poses, so that registration has no odometry.

    python -m benchmarks.semi_real draw SEQUENCE OUT --empty --last 499
    python -m benchmarks.semi_real draw SEQUENCE OUT --seeds 1 2 --coat 8 --first 500 --no-poses
    cp -r OUT/recordings/* build/toy/synthetic_capture/recordings/turnaround.r3d captures/kitchen/
    cp agents/toy.toml agents/kitchen.toml && make kitchen.registration
    python -m benchmarks.semi_real registration build/kitchen OUT/truth \\
        build/toy/synthetic_capture/truth/turnaround.npz \\
        --structure SEQUENCE

Several species make a home of several animals, with a turnaround of each, `turnaround_<species>`:

    python -m benchmarks.semi_real draw SEQUENCE OUT --seeds 1 2 --species cat dog rabbit --coat 8 --first 500
    python -m benchmarks.semi_real registration BUILD OUT/truth TURNAROUND.npz --animal dog

With `--structure` cameras are also compared with structure from motion on the color pictures of the sequence
(`benchmarks.structure`), aligned to the world of the build by a similarity on the cameras of the walk-through; the
calibration of their confidence is then measured against that, else against the poses of the sequence.
"""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import get_args

import cv2
import numpy as np
from jaxtyping import Bool, Float, Integer

from benchmarks import command_lines, structure
from benchmarks.composited import Actor, Compositor, Sequence, course, measure_noise, resampled, surfaces
from pipeline.core.errors import InputError, exit_code
from pipeline.core.progress import log
from pipeline.core.videos import Video
from pipeline.core.videos import read as read_videos
from pipeline.data import npz
from pipeline.data.clips import Masks, read_source_index
from pipeline.data.poses import RegisteredPoses
from pipeline.data.templates import AgentCameras, SceneCameras
from pipeline.geometry import rigid
from pipeline.metrics.pose_errors import constant_between, joined, pose_errors
from pipeline.recordings.seven_scenes import KINECT_DEPTH, RATE_HZ, SAME_LENS_PX
from stages.evaluate.registration import FLIPPED_DEG, is_right
from stages.evaluate.reliability import BINS, reliability_curve, reliability_metrics
from stages.synthesize_capture import animal, gait
from stages.synthesize_capture.animal import BODIES
from stages.synthesize_capture.config import Species

TRIALS = 20
"""trajectories among which that of a further animal is chosen"""
APART_M = 0.5
"""between the roots of two animals whose bodies do not touch"""
MIN_VISIBLE = 0.001
"""Fraction of a picture above which the animal counts as visible."""
RIGHT_CAMERA, RIGHT_ROOT = (5.0, 0.05), (20.0, 0.1)
"""degrees and meters within which a pose is right, when the calibration of its confidence is measured"""


@dataclass(frozen=True)
class RenderConfig:
    """What is rendered into a sequence, and how it is written."""

    species: tuple[Species, ...] = ("cat",)
    """The animals; none: a walk-through."""
    coat: int | None = None
    """Seed of their appearance; None: that of their trajectories."""
    poses: bool = True
    """Whether the recording has the poses of the sequence."""


def draw(sequence: Sequence, out: Path, name: str, seed: int, render: RenderConfig = RenderConfig()) -> None:
    """Render one recording and write its ground truth."""
    rng = np.random.default_rng([seed, 41])
    poses = sequence.poses()
    ticks = np.round(sequence.timestamp_s * RATE_HZ).astype(int)
    if (np.diff(ticks) < 1).any():
        what = f"frames follow each other faster than the {RATE_HZ:g} Hz of the drawn recording"
        raise InputError("CAP-007", what, sequence.recording.where, "take every second one, with --step 2")
    timestamp_s = ticks / RATE_HZ
    noise = measure_noise(sequence)
    log(f"{name}: noise {noise}")
    actors = _cast(sequence, poses, timestamp_s, rng, seed, render)
    folder = out / "recordings" / name
    folder.mkdir(parents=True)
    np.savetxt(folder / "camera-intrinsics.txt", sequence.intrinsics)
    given = sequence.intrinsics[[0, 1, 0, 1], [0, 1, 2, 2]]
    if np.abs(given - KINECT_DEPTH).max() < SAME_LENS_PX:
        np.savetxt(folder / "depth_from_color.txt", np.eye(4))  # else its reader may take depth for raw
    depth_size = sequence.depth_size if max(sequence.depth_size) < max(sequence.size) else sequence.size
    masks = []
    for index, frame in enumerate(Compositor(sequence, actors, noise, rng).frames(poses)):
        base = folder / f"frame-{ticks[index]:06d}"
        cv2.imwrite(f"{base}.color.jpg", frame.color[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 95])
        cv2.imwrite(
            f"{base}.depth.png", np.round(resampled(frame.depth, depth_size) * 1000).astype(np.uint16)
        )
        if render.poses:
            np.savetxt(f"{base}.pose.txt", poses[index])
        masks.append(frame.masks)
    packed = np.packbits(np.stack(masks), axis=-1)
    truth = dict(
        timestamp_s=timestamp_s, source_index=ticks, shape=np.array([len(masks), *sequence.size]),
        world_from_camera=poses, number=sequence.numbers,
    )  # fmt: skip
    several = len(render.species) > 1
    for row, (species, actor) in enumerate(zip(render.species, actors, strict=True)):
        path = out / "truth" / (species if several else "") / f"{name}.npz"
        path.parent.mkdir(parents=True, exist_ok=True)
        own = dict(world_from_agent=actor.motion.world_from_agent, there=actor.present, packed=packed[:, row])
        npz.save(path, compress=True, **truth, **own)
    if not actors:
        (out / "truth").mkdir(exist_ok=True)
        npz.save(out / "truth" / f"{name}.npz", compress=True, **truth)


def _cast(
    sequence: Sequence,
    poses: np.ndarray,
    timestamp_s: np.ndarray,
    rng: np.random.Generator,
    seed: int,
    render: RenderConfig,
) -> list[Actor]:
    """Sample what each animal does. Of several trajectories of a further animal the longest is chosen that keeps clear
    of the others' bodies.
    """
    walkable = surfaces(sequence, poses)
    log(f"surfaces {[(round(s.height_m, 2), int(s.free.sum())) for s in walkable]}")
    actors: list[Actor] = []
    for row, species in enumerate(render.species):
        stream = np.random.default_rng([seed, 41, row]) if row else rng
        coat = seed if render.coat is None else render.coat
        creature = animal.grow(
            np.random.default_rng([coat, 2]), species=species
        )  # as in the built-in capture
        trials = [course(sequence, poses, timestamp_s, walkable, stream) for _ in range(TRIALS if row else 1)]
        made = [Actor(creature, gait.poses(trajectory, timestamp_s, BODIES[species]), present)
                for trajectory, present in trials if present.any()]  # fmt: skip
        if not made:
            what = f"the {species} is in no frame: it needs level ground in view, 0.7 to 3.5 m away, for some seconds"
            remedy = "choose other --seeds or frames (--first, --last), or a recording that shows the floor"
            raise InputError("CAP-007", what, sequence.recording.where, remedy)
        clear_m = [min([APART_M, *(_apart_m(actor, other) for other in actors)]) for actor in made]
        actors.append(max(zip(clear_m, made, strict=True), key=lambda row: (row[0], row[1].present.sum()))[1])
    return actors


def _apart_m(first: Actor, second: Actor) -> float:
    """Return the least distance of both animals while both are there, meters."""
    there = first.present & second.present
    way = first.motion.world_from_agent[there, :3, 3] - second.motion.world_from_agent[there, :3, 3]
    return float(np.linalg.norm(way, axis=1).min(initial=np.inf))


def mask_metrics(labels: np.ndarray, truth: np.ndarray, min_visible: float = MIN_VISIBLE) -> dict[str, float]:
    """Return metrics of ``[frame height width]`` labels (255 animal, 128 unknown) against the truth (bool).

    Unknown pixels are ignored. The animal counts as visible in a frame if it covers more than ``min_visible`` of it;
    frames in which it covers less, but not nothing, are ignored by the metrics of presence.
    """
    found, known = labels == 255, labels != 128
    true_px = (truth & known).sum((1, 2))
    both, found_px = (found & truth).sum((1, 2)), found.sum((1, 2))
    seen, empty = truth.mean((1, 2)) > min_visible, ~truth.any((1, 2))
    iou = both / np.maximum(found_px + true_px - both, 1)
    return {
        "frames": len(labels), "frames_with": int(seen.sum()), "frames_without": int(empty.sum()),
        "false_frames": float((found_px[empty] > 0).mean()) if empty.any() else np.nan,
        "found_frames": float((found_px[seen] > 0).mean()), "iou_mean": float(iou[seen].mean()),
        "iou_pooled": float(both.sum() / (found_px + true_px - both).sum()),
        "precision": float(both.sum() / max(found_px.sum(), 1)), "recall": float(both.sum() / true_px.sum()),
    }  # fmt: skip


def read_truth(path: Path, index: np.ndarray) -> np.ndarray:
    """Read the true masks of the extracted frames, by their index in the recording."""
    table = npz.load(path)
    row = np.searchsorted(table["source_index"], index)
    return np.unpackbits(table["packed"][row], axis=-1, count=int(table["shape"][2])).astype(bool)


def scores(build: Path, truth: Path) -> dict[str, dict[str, float]]:
    """Return `mask_metrics` of every session of a build, by its name, in a home of several animals also by theirs.

    There, `swaps` is the share of frames whose mask covers more of the other animals than of its own.
    """
    animals = sorted(
        path.name for path in truth.iterdir() if path.is_dir() and any(path.glob("session*.npz"))
    )
    found = {}
    for video in read_videos(build / "plan" / "videos.json"):
        if video.role != "session":
            continue
        session, index = Path(video.file).stem, read_source_index(build / "frames" / video.id)
        true = np.stack([read_truth(truth / name / f"{session}.npz", index) for name in animals or ("",)])
        for row, name in enumerate(animals or ("",)):
            own = build / "home_masks" / video.id / name if animals else build / "masks" / video.id
            masks = Masks.open(own)
            labels = np.stack([masks[frame] for frame in range(len(masks))])
            metrics = mask_metrics(labels, true[row])
            if animals:
                others = np.delete(true, row, axis=0).any(0) & (labels == 255)
                mine = true[row] & (labels == 255)
                metrics["swaps"] = float((others.sum((1, 2)) > mine.sum((1, 2))).mean())
            found[f"{session} {name}".strip()] = metrics
    return found


def registration_metrics(
    build: Path, truth: Path, turnaround: Path, sequence: Path | None = None, name: str | None = None
) -> dict[str, float]:
    """Return medians and percentiles of camera and root errors over all frames of all sessions.

    Roots are evaluated relative to the camera, in frames where the animal covers more than 0.1 % of the picture: the
    poses of the sequence, with which it was rendered, are no ground truth of the room (the scale of KinectFusion may
    differ from that of the sensor by several percent), but its pose relative to the camera is exact. `root_placed`
    is the fraction of these frames with a root, `root_where_empty` that of frames without the animal. With
    ``sequence`` cameras are also compared with structure from motion on its pictures. Meters and degrees. `calibration`
    of cameras is measured against structure from motion if given, of roots where there are any. In a home of several
    animals ``name`` is the one that is measured.
    """
    videos = {Path(v.file).stem: v for v in read_videos(build / "plan" / "videos.json")}
    own, sessions = (build, truth) if name is None else (build / "animals" / name, truth / name)
    walk = _rows(build, videos["walkthrough"], npz.load(truth / "walkthrough.npz"))
    ours = SceneCameras.open(build / "scene_template").world_from_registered
    world_from_true = constant_between(ours, walk["world_from_camera"])
    index = npz.load(
        build / "frames" / videos["turnaround" if name is None else f"turnaround_{name}"].id / "frames.npz"
    )["source_index"]
    around = {key: value[index] for key, value in npz.load(turnaround).items()
              if key in ("world_from_agent", "world_from_camera")}  # fmt: skip
    true_agent_from_camera = rigid.inverse(around["world_from_agent"]) @ around["world_from_camera"]
    agent_from_true = constant_between(
        AgentCameras.open(own / "agent_template").agent_from_registered, true_agent_from_camera
    )
    cameras, roots, empty, cameras_by_session = [], [], [], {}
    camera_sure, root_sure = [], []
    for session, video in videos.items():
        if video.role != "session":
            continue
        table = _rows(build, video, npz.load(sessions / f"{session}.npz"))
        poses = RegisteredPoses.open(own / "registration" / video.id) or RegisteredPoses.unknown(
            table["timestamp_s"]
        )
        cameras_by_session[session] = NumberedCameras(poses.world_from_camera, table["number"])
        cameras.append(pose_errors(poses.world_from_camera, world_from_true @ table["world_from_camera"]))
        true_roots = rigid.inverse(table["world_from_camera"]) @ table["world_from_agent"]
        true_roots = true_roots @ rigid.inverse(agent_from_true)
        own_roots = rigid.inverse(poses.world_from_camera) @ poses.world_from_agent
        share = np.unpackbits(table["packed"], axis=-1, count=int(table["shape"][2])).mean((1, 2))
        roots.append(pose_errors(own_roots, true_roots)[share > MIN_VISIBLE])
        camera_sure.append(poses.confidence)
        root_sure.append(poses.agent_confidence[share > MIN_VISIBLE])
        empty.append(np.isfinite(poses.world_from_agent[share == 0, 0, 3]))
    camera, root = joined(cameras), joined(roots)
    placed = np.isfinite(root.meters)
    found = calibration("root", np.concatenate(root_sure)[placed], is_right(root[placed], RIGHT_ROOT))
    if sequence is not None:
        walked = NumberedCameras(ours, walk["number"])
        found |= _structure_metrics(walked, cameras_by_session, sequence, truth, camera_sure)
    else:
        found |= calibration("camera", np.concatenate(camera_sure), is_right(camera, RIGHT_CAMERA))
    return found | {
        "frames": len(camera.meters), "camera_deg_median": float(np.median(camera.degrees)),
        "camera_m_median": float(np.median(camera.meters)), "camera_deg_p95": _p95(camera.degrees),
        "camera_m_p95": _p95(camera.meters), "root_frames": len(placed), "root_placed": float(placed.mean()),
        "root_m_median": float(np.median(root.meters[placed])), "root_m_p95": _p95(root.meters[placed]),
        "root_deg_median": float(np.median(root.degrees[placed])),
        "root_flips": float((root.degrees[placed] > FLIPPED_DEG).mean()),
        "root_where_empty": float(np.concatenate(empty).mean()),
    }  # fmt: skip


@dataclass(frozen=True)
class NumberedCameras:
    """The registered cameras of a recording, and their frame numbers in the sequence."""

    world_from_camera: Float[np.ndarray, "frame 4 4"]
    number: Integer[np.ndarray, "frame"]

    def rows(self, known: dict[int, np.ndarray]) -> list[int]:
        """Return the frames that the reference contains."""
        return [row for row, number in enumerate(self.number.tolist()) if number in known]

    def matched(self, known: dict[int, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
        """Return the cameras that the reference contains, and those of the reference."""
        rows = self.rows(known)
        return self.world_from_camera[rows], np.stack([known[int(self.number[row])] for row in rows])


def calibration(
    name: str, confidence: Float[np.ndarray, "frame"], right: Bool[np.ndarray, "frame"]
) -> dict[str, float]:
    """Return the share that was right, mean confidence, expected calibration error, and the reliability curve: frames,
    mean confidence and share right of every bin of confidence that has frames (0..1).
    """
    values = reliability_metrics(name, confidence, right).values
    found = {key.replace("/", "_"): np.nan if value is None else value for key, value in values.items()}
    found[f"{name}_right"] = float(right.mean()) if len(right) else np.nan
    curve = np.stack(reliability_curve(confidence, right), axis=1)
    for row, (sure, share, count) in enumerate(curve.tolist()):
        key = f"{name}_confidence_from_{row / BINS:.1f}"
        found |= {f"{key}_frames": count, f"{key}_mean": sure, f"{key}_right": share} if count else {}
    return found


def _structure_metrics(
    walk: NumberedCameras,
    sessions: dict[str, NumberedCameras],
    sequence: Path,
    out: Path,
    confidence: list[Float[np.ndarray, "frame"]],
) -> dict[str, float]:
    """Compare cameras and their ``confidence`` by session with structure from motion, which is cached in ``out``."""
    frames = np.unique(np.concatenate([walk.number, *(each.number for each in sessions.values())])).tolist()
    known = structure.cameras(sequence, frames, out / "structure")
    pairs = {name: each.matched(known) for name, each in {"walk": walk, **sessions}.items()}
    errors = {name: pose_errors(ours, structure.in_world(*pairs["walk"], other))
              for name, (ours, other) in pairs.items()}  # fmt: skip
    found = {"walk": errors.pop("walk"), "camera": joined(list(errors.values()))}
    sure = np.concatenate(
        [c[each.rows(known)] for c, each in zip(confidence, sessions.values(), strict=True)]
    )
    calibrated = calibration("camera", sure, is_right(found["camera"], RIGHT_CAMERA))
    return calibrated | {f"structure_{name}_{key}": value for name, each in found.items()
            for key, value in (("frames", len(each.meters)), ("deg_median", float(np.median(each.degrees))),
                               ("m_median", float(np.median(each.meters))), ("deg_p95", _p95(each.degrees)),
                               ("m_p95", _p95(each.meters)))}  # fmt: skip


def _rows(build: Path, video: Video, table: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return the rows of a truth table for the extracted frames of a recording."""
    index = npz.load(build / "frames" / video.id / "frames.npz")["source_index"]
    row = np.searchsorted(table["source_index"], index)
    return {key: value if key == "shape" else value[row] for key, value in table.items()}


def _p95(values: np.ndarray) -> float:
    return float(np.percentile(np.nan_to_num(values, nan=np.inf), 95))


def main() -> int:
    """Parse the command line and run; return the exit code."""
    parser = command_lines.described(__doc__)
    commands = parser.add_subparsers(dest="command", required=True)
    draw_parser = commands.add_parser("draw")
    draw_parser.add_argument("sequence", type=Path, help="a recording with depth")
    draw_parser.add_argument("out", type=Path)
    draw_parser.add_argument("--seeds", type=int, nargs="+", default=[1])
    draw_parser.add_argument("--first", type=int, default=0, help="frame number")
    draw_parser.add_argument("--last", type=int, default=10**9, help="frame number")
    draw_parser.add_argument(
        "--step", type=int, default=3, help="stride of frames; negative: in reverse order"
    )
    draw_parser.add_argument("--species", nargs="+", default=["cat"], choices=get_args(Species))
    draw_parser.add_argument(
        "--coat", type=int, help="seed of the animal's appearance; default: the seed of the recording"
    )
    draw_parser.add_argument("--empty", action="store_true", help="render no animal: a walk-through")
    draw_parser.add_argument("--no-poses", action="store_true", help="omit the poses of the sequence")
    score_parser = commands.add_parser("score", help="evaluate the masks of a build")
    score_parser.add_argument("build", type=Path)
    score_parser.add_argument("truth", type=Path, help="OUT/truth")
    registration_parser = commands.add_parser("registration", help="evaluate cameras and roots of a build")
    registration_parser.add_argument("build", type=Path)
    registration_parser.add_argument("truth", type=Path, help="OUT/truth")
    registration_parser.add_argument("turnaround", type=Path, help="truth of the turnaround, an NPZ file")
    registration_parser.add_argument("--animal", help="which one, in a home of several")
    registration_parser.add_argument(
        "--structure",
        type=Path,
        metavar="SEQUENCE",
        help="also compare cameras with structure from motion on its pictures",
    )
    arguments = parser.parse_args()
    if arguments.command == "draw":
        species = () if arguments.empty else tuple(arguments.species)
        render = RenderConfig(species, arguments.coat, not arguments.no_poses)
        sequence = Sequence.open(
            arguments.sequence, first=arguments.first, last=arguments.last, step=arguments.step
        )
        for seed in arguments.seeds:
            draw(
                sequence, arguments.out, "walkthrough" if arguments.empty else f"session-{seed}", seed, render
            )
    elif arguments.command == "registration":
        found = registration_metrics(
            arguments.build, arguments.truth, arguments.turnaround, arguments.structure, arguments.animal
        )
        print("\n".join(f"{name:50s} {value:.4g}" for name, value in found.items()))
    else:
        for name, found in scores(arguments.build, arguments.truth).items():
            print(name, json.dumps({key: round(value, 4) for key, value in found.items()}))
    return 0


if __name__ == "__main__":
    raise SystemExit(exit_code(main))
