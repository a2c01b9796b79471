"""A real dog (DAVIS): masks from one box without weights or depth, and flow compared with OpenCV."""

import json
import os
from pathlib import Path

import cv2
import numpy as np
import pytest

from pipeline.data import images, npz
from pipeline.data.clips import Clip
from pipeline.data.flow import GAPS
from stages.estimate_flow.config import Config as FlowConfig
from stages.estimate_flow.estimation import STRIDE_PX, Estimator, flows
from stages.segment_agent.config import Config
from stages.segment_agent.follow import follow
from stages.segment_agent.footage import Footage
from stages.segment_agent.prompts import Prompt

DOG = Path(os.environ.get("ATS_REALDATA", Path(__file__).parents[3] / "shared" / "realdata")) / "davis_dog"
FRAMES, MASKED = 60, 30


@pytest.fixture(scope="module")
def dog(tmp_path_factory):
    """The frames as an artifact without depth, true masks, and our flow of all gaps."""
    if not DOG.exists():
        pytest.skip(f"no real recordings at {DOG.parent} (set ATS_REALDATA)")
    cv2.setNumThreads(1)  # the result of the search depends on the number of threads
    clip = _written(tmp_path_factory.mktemp("dog"), FRAMES)
    estimator = Estimator(clip.color_size, FlowConfig().working_side_px)
    gray = [estimator.reduce(clip.color(frame)) for frame in range(FRAMES)]
    found = {(gap, way): [] for gap in GAPS for way in ("fw", "bw")}
    for gap, *both in flows(gray.__getitem__, FRAMES, GAPS, estimator):
        for way, part in zip(("fw", "bw"), both, strict=True):
            found[gap, way].append(part)
    masks = np.stack(
        [
            cv2.imread(str(DOG / "mask" / f"{frame:05d}.png"), cv2.IMREAD_GRAYSCALE) > 127
            for frame in range(FRAMES)
        ]
    )
    return clip, masks, found


def _written(folder: Path, frames: int) -> Clip:
    """Write the first frames as an artifact without depth."""
    for name in ("color", "depth", "confidence"):
        (folder / name).mkdir()
    for frame in range(frames):
        (folder / "color" / f"{frame:06d}.jpg").write_bytes((DOG / "rgb" / f"{frame:05d}.jpg").read_bytes())
    images.write_depth(folder / "depth" / "000000.exr", np.zeros((60, 107)))
    eye = np.tile(np.eye(3), (frames, 1, 1))
    table = dict(
        timestamp_s=np.arange(frames) / 24,
        intrinsics=eye,
        depth_intrinsics=eye,
        quality=np.ones(frames, np.float32),
    )
    npz.save(folder / "frames.npz", gravity_known=np.array(False), **table)
    return Clip.open(folder)


@pytest.mark.slow
def test_masks_from_one_box(dog, tmp_path):
    """On the first half of the frames."""
    _, truth, found = dog
    clip = _written(tmp_path, MASKED)
    for (gap, way), parts in found.items():
        flow, confidence = (
            np.stack([getattr(part, name) for part in parts[: MASKED - gap]])
            for name in ("flow", "confidence")
        )
        npz.save(tmp_path / f"flow_{gap}_{way}.npz", flow=flow, confidence=confidence)
    rows, columns = np.nonzero(truth[0])
    prompt = Prompt(0, (columns.min(), rows.min(), columns.max() + 1.0, rows.max() + 1.0))
    footage = Footage(clip, tmp_path, Config().height_px)
    masks = list(follow(footage, prompt, Config().learning, np.random.default_rng(0)))
    iou = [
        ((m.labels == 255) & t).sum() / ((m.labels == 255) | t).sum()
        for m, t in zip(masks, truth[:MASKED], strict=True)
    ]
    print(f"DAVIS dog: mean IoU {np.mean(iou):.3f}, worst {np.min(iou):.3f}")
    assert np.mean(iou) >= 0.80


def _opencv_medium(clip, first, second):
    gray = [cv2.cvtColor(clip.color(frame), cv2.COLOR_RGB2GRAY) for frame in (first, second)]
    return cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM).calc(*gray, None)


def _dense(flow, size):
    """Our flow at every pixel."""
    return cv2.resize(flow.astype(np.float32), size[::-1], interpolation=cv2.INTER_LINEAR)


def _joint_hits(move, joints, masks, pairs):
    """Fraction of BADJA joints propagated to within 0.2 sqrt(area) of their annotation."""
    hits = []
    for first, second in pairs:
        both = joints[first][1] & joints[second][1]
        start, end = joints[first][0][both], joints[second][0][both]
        at = np.clip(start.astype(int), 0, np.array(masks.shape[:0:-1]) - 1)
        error = np.linalg.norm(start + move(first, second)[at[:, 1], at[:, 0]] - end, axis=-1)
        hits.append(error < 0.2 * np.sqrt(masks[second].sum()))
    return float(np.concatenate(hits).mean())


@pytest.mark.slow
def test_flow_is_at_least_as_good_as_opencv(dog):
    """On joints, and on masks propagated over five frames."""
    clip, masks, found = dog
    size = masks.shape[1:]
    joints = {}
    for entry in json.loads((DOG / "dog.json").read_text()):
        position = np.array(entry["joints"], float)[:, ::-1] * [size[1] / 1920, size[0] / 1080]
        joints[int(Path(entry["image_path"]).stem)] = position, np.array(entry["visibility"], bool)

    def chained(step):
        def move(first, second):
            whole = np.zeros((*size, 2), np.float32)
            pixel = np.stack(np.meshgrid(*map(np.arange, size[::-1])), -1).astype(np.float32)
            for frame in range(first, second):
                at = pixel + whole
                whole = whole + cv2.remap(
                    step(frame), at[..., 0], at[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
                )
            return whole

        return move

    baselines = {
        "ours": chained(lambda frame: _dense(found[1, "fw"][frame].flow, size)),
        "opencv": chained(lambda frame: _opencv_medium(clip, frame, frame + 1)),
        "zero": lambda first, second: np.zeros((*size, 2), np.float32),
    }

    def warped_iou(move):
        pixel = np.stack(np.meshgrid(*map(np.arange, size[::-1])), -1).astype(np.float32)
        scores = []
        for first in range(0, FRAMES - 5, 9):
            inside = (pixel + move(first, first + 5))[masks[first]].round().astype(int)
            inside = inside[((inside >= 0) & (inside < size[::-1])).all(1)]
            landed = np.zeros(size, np.uint8)
            landed[inside[:, 1], inside[:, 0]] = 1
            landed = cv2.morphologyEx(landed, cv2.MORPH_CLOSE, np.ones((5, 5), np.uint8)) > 0
            scores.append((landed & masks[first + 5]).sum() / (landed | masks[first + 5]).sum())
        return float(np.mean(scores))

    known = sorted(joints)
    pairs = list(zip(known[:-1:2], known[1::2], strict=False))
    hits = {name: _joint_hits(move, joints, masks, pairs) for name, move in baselines.items()}
    print(
        "DAVIS dog: PCK@0.2",
        {name: round(value, 3) for name, value in hits.items()},
        f"{len(pairs)} pairs, stride {STRIDE_PX}",
    )
    warps = {name: warped_iou(move) for name, move in baselines.items()}
    print("DAVIS dog: 5-frame mask-warp IoU", {name: round(value, 3) for name, value in warps.items()})
    assert warps["ours"] > warps["zero"] + 0.1
    assert warps["ours"] >= warps["opencv"]
    assert hits["ours"] >= hits["opencv"]
    assert hits["ours"] > hits["zero"] + 0.1
