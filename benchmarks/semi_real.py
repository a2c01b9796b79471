"""Measure masks where the truth is known and the sensor is real: the built-in animal drawn into a real RGB-D
sequence.

Each drawn recording is a 7-Scenes style folder that `extract_frames` reads, with the truth beside it. The
animal comes and goes: in a good share of the frames there is none.

    python -m benchmarks.semi_real draw SEQUENCE OUT --seeds 1 2 [--first 500 --step 3] [--registered]
    python -m benchmarks.semi_real score OUT [--masks masks]
"""

import argparse
import json
import re
from pathlib import Path

import cv2
import numpy as np

from benchmarks.composited import Compositor, Sequence, course, measure_noise, surfaces
from pipeline.core.progress import log
from pipeline.data import images, npz
from stages.synthesize_capture import animal, gait

RATE_HZ = 30.0
"""frames are numbered at this rate in 7-Scenes folders"""


def draw(sequence: Sequence, out: Path, name: str, seed: int) -> None:
    """Draw one recording and its truth."""
    rng = np.random.default_rng([seed, 41])
    poses = sequence.poses()
    timestamp_s = np.abs(np.array(sequence.numbers) - sequence.numbers[0]) / RATE_HZ
    noise = measure_noise(sequence)
    grounds = surfaces(sequence, poses)
    log(f"{name}: noise {noise}, surfaces {[(round(s.height_m, 2), int(s.free.sum())) for s in grounds]}")
    lived, there = course(sequence, poses, timestamp_s, grounds, rng)
    motion = gait.poses(lived, timestamp_s)
    creature = animal.grow(np.random.default_rng([seed, 2]))
    folder = out / "recordings" / name
    folder.mkdir(parents=True)
    (out / "truth").mkdir(exist_ok=True)
    np.savetxt(folder / "camera-intrinsics.txt", sequence.intrinsics)
    masks = []
    for index, frame in enumerate(Compositor(sequence, creature, noise, rng).frames(poses, motion, there)):
        base = folder / f"frame-{round(timestamp_s[index] * RATE_HZ):06d}"
        cv2.imwrite(f"{base}.color.jpg", frame.color[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 95])
        cv2.imwrite(f"{base}.depth.png", np.round(frame.depth * 1000).astype(np.uint16))
        np.savetxt(f"{base}.pose.txt", poses[index])
        masks.append(frame.mask)
    packed = np.packbits(np.stack(masks), axis=-1)
    npz.save(
        out / "truth" / f"{name}.npz", compress=True, timestamp_s=timestamp_s, packed=packed,
        source_index=np.round(timestamp_s * RATE_HZ).astype(int),
        shape=np.array([len(masks), *masks[0].shape]), world_from_camera=poses,
        world_from_agent=motion.world_from_agent, there=there,
    )  # fmt: skip


def figures(labels: np.ndarray, truth: np.ndarray, seen_share: float = 0.001) -> dict[str, float]:
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
    two = commands.add_parser("score", help="score masks/<name> by truth/<name>")
    two.add_argument("out", type=Path)
    two.add_argument("--masks", default="masks")
    task = parser.parse_args()
    if task.command == "draw":
        known = sorted(int(re.findall(r"\d+", p.name)[0]) for p in task.sequence.glob("frame-*.depth.png"))
        numbers = [n for n in known if task.first <= n <= task.last][:: task.step]
        for seed in task.seeds:
            draw(Sequence(task.sequence, tuple(numbers), task.registered), task.out, f"session-{seed}", seed)
    else:
        for folder in sorted((task.out / task.masks).iterdir()):
            index = npz.load(task.out / "frames" / folder.name / "frames.npz")["source_index"]
            truth = read_truth(task.out / "truth" / f"{folder.name}.npz", index)
            labels = np.stack([images.read_gray(p) for p in sorted(folder.glob("*.png"))])
            print(folder.name, json.dumps({k: round(v, 4) for k, v in figures(labels, truth).items()}))


if __name__ == "__main__":
    main()
