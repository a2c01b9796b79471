"""Registration in a real room: one half of a sequence is registered to the template of the other, without odometry.

The halves of a 7-Scenes style folder are converted to recordings without poses: `extract_frames` reads them, the first
is mapped as a walk-through, the second is registered to it as a session. All poses are compared with references, each
aligned to the template by the cameras of the first half: the poses of the folder (KinectFusion), structure from motion
on the color pictures alone, and the published pseudo ground truth of Brachmann et al. 2021 where it is in the data
folder, at `pgt/sfm/7scenes/`. Its files have a line per picture: name, quaternion (wxyz) and translation of
camera-from-world, focal length in pixels.
"""

import json
import re
import shutil
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, Integer

from benchmarks import structure
from benchmarks.behavior_builds import emptied
from benchmarks.real.table import Row
from pipeline.backends.descriptors import Describer
from pipeline.core.errors import InputError
from pipeline.core.progress import log
from pipeline.data import images, npz
from pipeline.data.clips import Clip, Masks, read_source_index
from pipeline.data.templates import SceneCameras
from pipeline.geometry import rigid
from pipeline.localization.localizer import Localizer
from pipeline.metrics.pose_errors import PoseErrors, pose_errors
from stages.build_scene_template import template
from stages.build_scene_template.config import Config as TemplateConfig
from stages.build_scene_template.template import SceneTemplate
from stages.evaluate import localizing
from stages.evaluate.registration import is_right
from stages.extract_frames import stage as extracting
from stages.extract_frames.config import Config as FramesConfig
from stages.register_videos import registration
from stages.register_videos.config import AlignmentConfig, ConfidenceConfig, VoteConfig
from stages.register_videos.config import Config as RegistrationConfig
from stages.register_videos.point_alignment import Walkthrough
from stages.train_localizer import training
from stages.train_localizer.config import Config as LocalizerConfig

BAR_M, BAR_DEG = 0.01, 0.3
CLOSE_M, CLOSE_DEG = 0.05, 5.0
STRUCTURE, PUBLISHED_STRUCTURE = "structure from motion", "the published structure from motion"
PUBLISHED_FILES, PUBLISHED_LINE = Path("pgt", "sfm", "7scenes"), 9
NUMBER = re.compile(r"(.*)/frame-(\d+)")
MIN_PUBLISHED, SAME_SEQUENCE_DEG = 0.8, 5.0
"""minimum share of a folder's frames in the published sequence it shows, and median difference of their rotations"""
DENSE_REGISTRATION = RegistrationConfig(
    animal=False,
    vote=VoteConfig(every_frames=1),
    alignment=AlignmentConfig(flow_every_frames=1, feature_every_frames=0),
    confidence=ConfidenceConfig(every_frames=1),
)
"""For short recordings: every frame votes and is aligned by flow."""
PUBLISHED = {"hloc, all of 7-Scenes": "1.10 / 0.14", "DSAC* RGB-D, all of 7-Scenes": "1.58 / 0.44"}
"""cm / deg against structure from motion, on the official splits, whose queries differ from these"""


@dataclass(frozen=True)
class Half:
    """One half as a recording, with the camera poses of the folder."""

    clip: Clip
    world_from_camera: Float[np.ndarray, "frame 4 4"]
    number: Integer[np.ndarray, "frame"]


def numbers(scene: Path) -> list[int]:
    """Return the frame numbers of a 7-Scenes style folder."""
    return sorted(int(re.findall(r"\d+", path.name)[0]) for path in scene.glob("frame-*.pose.txt"))


def half(scene: Path, chosen: list[int], folder: Path) -> Half:
    """Extract some frames as a recording without poses."""
    recording, frames = emptied(folder / "recording"), emptied(folder / "frames")
    for number in chosen:
        for path in scene.glob(f"frame-{number:06d}.*"):
            if ".pose." not in path.name:
                shutil.copy(path, recording)
    if (scene / "camera-intrinsics.txt").is_file():
        shutil.copy(scene / "camera-intrinsics.txt", recording)
    extracting.run(extracting.Inputs(recording), FramesConfig(), frames)
    kept = read_source_index(frames)
    true = [np.loadtxt(scene / f"frame-{number:06d}.pose.txt") for number in kept]
    return Half(Clip.open(frames), np.stack(true), kept)


def halves(scene: Path, folder: Path) -> tuple[Half, Half]:
    """Extract the first and the second half of the frames."""
    known = numbers(scene)
    middle = len(known) // 2
    return half(scene, known[:middle], folder / "a"), half(scene, known[middle:], folder / "b")


def empty_masks(clip: Clip, folder: Path) -> Masks:
    """Write empty masks for a recording without an animal."""
    folder.mkdir(parents=True, exist_ok=True)
    for frame in range(len(clip)):
        images.write_gray(folder / f"{frame:06d}.png", np.zeros(clip.color_size, np.uint8))
    absent = np.zeros(len(clip))
    npz.save(folder / "masks.npz", visible=absent > 0, confidence=(absent + 1).astype(np.float32))
    return Masks.open(folder)


def register_session(
    scene_template: SceneTemplate, walk: Clip, localizer: Localizer, session: Clip, masks: Masks
) -> Float[np.ndarray, "frame 4 4"]:
    """Register the second half; NaN if it is rejected."""
    found = (
        scene_template.world_from_camera,
        walk.intrinsics,
        scene_template.registered,
        scene_template.keyframe,
    )
    cameras = SceneCameras(walk.timestamp_s, *found).world_from_keyframe
    maps = registration.Maps(
        scene_template.mesh, scene_template.mesh, localizer, localizer, walk=Walkthrough(walk, cameras)
    )
    rng = np.random.default_rng(DENSE_REGISTRATION.seed)
    result = registration.register(session, masks, maps, DENSE_REGISTRATION, rng)
    if isinstance(result, registration.Rejected):
        log(f"rejected: {result.reason}")
        return np.full((len(session), 4, 4), np.nan)
    return result.aligned.world_from_camera


def published_cameras(
    folder: Path, known: dict[int, Float[np.ndarray, "4 4"]]
) -> dict[int, Float[np.ndarray, "4 4"]] | None:
    """Return the published ``world_from_camera`` by frame number, of the sequence that agrees best with the ``known``
    cameras up to a similarity; None with a message where there are no files or none agrees. Raises InputError TRJ-001.
    """
    files = sorted((folder / PUBLISHED_FILES).glob("*.txt"))
    if not files:
        log(f"no {folder / PUBLISHED_FILES}/*.txt: the published pseudo ground truth is left out")
        return None
    best, least_deg = None, SAME_SEQUENCE_DEG
    for sequence in (each for file in files for each in _published_sequences(file)):
        shared = sorted(known.keys() & sequence.keys())
        if len(shared) < max(3, MIN_PUBLISHED * len(known)):
            continue
        ours, other = (np.stack([each[number] for number in shared]) for each in (known, sequence))
        apart_deg = float(np.median(pose_errors(ours, structure.in_world(ours, other, other)).degrees))
        if apart_deg < least_deg:
            best, least_deg = sequence, apart_deg
    if best is None:
        log(f"no sequence in {folder / PUBLISHED_FILES} agrees with the folder's poses: it is left out")
    return best


def _published_sequences(file: Path) -> Iterable[dict[int, Float[np.ndarray, "4 4"]]]:
    """Return the cameras of every sequence in a file of published poses, by frame number."""
    lines = [line.split() for line in file.read_text().splitlines() if line.strip()]
    names = [NUMBER.match(line[0]) for line in lines]
    try:
        values = np.array([line[1:] for line in lines], float).reshape(len(lines), PUBLISHED_LINE - 1)
    except ValueError:
        values = np.full((len(lines), PUBLISHED_LINE - 1), np.nan)
    if not all(names) or not np.isfinite(values).all():
        what = "lines are not: sequence/frame-number, quaternion wxyz, translation, focal length"
        raise InputError("TRJ-001", what, str(file), "copy the file again from its repository")
    cameras = rigid.inverse(rigid.make(rigid.rotation_from_quaternion(values[:, :4]), values[:, 4:7]))
    sequences: dict[str, dict[int, np.ndarray]] = {}
    for name, camera in zip(names, cameras, strict=True):
        if name is not None:
            sequences.setdefault(name[1], {})[int(name[2])] = camera
    return sequences.values()


def evaluate(scene: Path, folder: Path) -> dict[str, dict[str, dict[str, float]]]:
    """Return the errors (`summary`) of all methods on the second half, for all references."""
    walk, session = halves(scene, folder)
    workspace = emptied(folder / "workspace")
    none = np.zeros((len(walk.clip), 4, 4, 2), np.float16)
    scene_template, _ = template.build(walk.clip, none, TemplateConfig(), workspace)
    config, rng = LocalizerConfig(), np.random.default_rng(0)
    views = training.scene_views(
        scene_template.mesh,
        scene_template.world_from_camera,
        scene_template.floor_m,
        walk.clip,
        config.scene,
        rng,
    )
    localizer, _ = training.train(views, config, Describer(), "cpu", rng)
    frames, clip = range(len(session.clip)), session.clip
    no_animal = [np.zeros(clip.color_size, bool)] * len(clip)
    points = localizing.sift_map(walk.clip, scene_template.world_from_camera, range(len(walk.clip)))
    poses = {
        "ours": register_session(
            scene_template, walk.clip, localizer, clip, empty_masks(clip, folder / "masks")
        ),
        "ours, single frames": localizing.placed_by_localizer(localizer, clip, frames, no_animal)[0],
        "SIFT, PnP on the template's walk": localizing.placed_by_sift(points, clip, frames),
    }
    known = structure.cameras(scene, [*walk.number.tolist(), *session.number.tolist()], folder / "structure")
    kinect_fusion = dict(
        zip(
            [*walk.number, *session.number],
            [*walk.world_from_camera, *session.world_from_camera],
            strict=True,
        )
    )
    published = published_cameras(scene.parent, kinect_fusion)
    references = {STRUCTURE: known} | ({} if published is None else {PUBLISHED_STRUCTURE: published})
    return {
        name: summaries(scene_template.world_from_camera, walk, session, poses, reference, resize=resize)
        for name, reference, resize in (
            *((name, reference, True) for name, reference in references.items()),
            ("KinectFusion", kinect_fusion, False),
        )
    }


def summaries(
    template_cameras: Float[np.ndarray, "frame 4 4"],
    walk: Half,
    session: Half,
    poses: dict[str, Float[np.ndarray, "frame 4 4"]],
    reference: dict[int, Float[np.ndarray, "4 4"]],
    *,
    resize: bool,
) -> dict[str, dict[str, float]]:
    """Return the `summary` of all methods in the frames of the reference, which is aligned to the template by the
    cameras of the walk-through, including its scale with ``resize``.
    """
    walk_rows, session_rows = (
        [row for row, number in enumerate(half.number) if number in reference] for half in (walk, session)
    )
    fitted = template_cameras[walk_rows], np.stack([reference[walk.number[row]] for row in walk_rows])
    truth = structure.in_world(
        *fitted, np.stack([reference[session.number[row]] for row in session_rows]), resize=resize
    )
    found = {name: summary(pose_errors(each[session_rows], truth)) for name, each in poses.items()}
    walk_truth = structure.in_world(*fitted, fitted[1], resize=resize)
    return found | {"the template's own cameras": summary(pose_errors(fitted[0], walk_truth))}


def summary(errors: PoseErrors) -> dict[str, float]:
    """Return medians (meters, degrees) and the share within 5 cm / 5 deg; failures count as infinite errors."""
    close = is_right(errors, (CLOSE_DEG, CLOSE_M))
    return {
        "m": float(np.median(errors.meters)),
        "deg": float(np.median(errors.degrees)),
        "close": float(close.mean()),
    }


def is_met(errors: dict[str, float]) -> bool:
    """Return whether a `summary` meets the bar: both medians, and every frame within 5 cm / 5 deg."""
    return errors["m"] <= BAR_M and errors["deg"] <= BAR_DEG and errors["close"] == 1


def row(scene: Path, out: Path) -> Row:
    """Evaluate on one folder of frames."""
    folder = out / "rooms" / scene.name
    done = folder / "summaries.json"
    if not done.is_file():
        found = evaluate(scene, folder)
        done.write_text(json.dumps(found, indent=1) + "\n")
    found = json.loads(done.read_text())
    cells = {
        f"{name}, by {reference}": f"{100 * errors['m']:.1f} / {errors['deg']:.2f} ({100 * errors['close']:.0f} %)"
        for reference, methods in found.items()
        for name, errors in methods.items()
    }
    for name, cell in cells.items():
        log(f"{scene.name}, {name}: {cell} cm / deg (within 5 cm / 5 deg)")
    return Row(
        "registration",
        f"7-Scenes, {scene.name}: second half of the frames in the first, no odometry",
        "median, cm / deg (within 5 cm / 5 deg)",
        cells.pop(f"ours, by {STRUCTURE}"),
        cells,
        PUBLISHED,
        f"<= {100 * BAR_M:.0f} / {BAR_DEG} (100 %) against structure from motion, ours and published",
        all(is_met(found[name]["ours"]) for name in (STRUCTURE, PUBLISHED_STRUCTURE) if name in found),
        {"summaries": found},
    )
