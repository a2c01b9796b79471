"""Upright pictures of a recording without depth, at a fixed rate; `estimate_depth` adds the rest."""

from pathlib import Path

import numpy as np

from pipeline.core.progress import log, track
from pipeline.data import images, qa
from pipeline.data.clips import PICTURES
from pipeline.geometry import cameras
from pipeline.recordings import errors, extraction
from pipeline.recordings.recording import Recording
from stages.extract_frames.config import Config
from stages.extract_frames.writing import MAX_LOST, SHEET_FRAMES, thumbnail


def write(folder: Path, recording: Recording, config: Config) -> None:
    """Write a recording's pictures. Raises CAP-001 if most are damaged, CAP-007 if too few are left."""
    rows = extraction.choose_frames(recording.timestamp_s, config.rate_hz)
    size = extraction.reduced_size(recording.color_size, config.max_side_px)
    chosen, statistics, strip = [], [], []
    shown = set(rows[np.linspace(0, len(rows) - 1, SHEET_FRAMES).astype(int)].tolist())
    (folder / "color").mkdir()
    for row in track(rows.tolist(), "pictures"):
        color = extraction.picture(recording, row, size)
        if color is None:
            continue
        color = cameras.turn_image(color, recording.quarter_turns)
        images.write_color(folder / "color" / f"{len(chosen):06d}.jpg", color, config.jpeg_quality)
        chosen.append(row)
        statistics.append(extraction.picture_statistics(color))
        if row in shown:
            strip.append(thumbnail(color))
    damaged = len(rows) - len(chosen)
    if damaged > MAX_LOST * len(rows):
        raise errors.damaged(recording.where, f"{damaged} of {len(rows)} pictures cannot be decoded")
    if len(chosen) < extraction.MIN_FRAMES:
        what = f"{len(chosen)} pictures, {extraction.MIN_FRAMES} are the least"
        raise errors.no_frames(recording.where, what)
    sharpness, brightness = np.array(statistics, np.float32).T
    time_s = recording.timestamp_s[chosen]
    PICTURES.save(
        folder / "pictures.npz",
        timestamp_s=time_s,
        source_index=recording.index[chosen],
        quarter_turns=np.array(recording.quarter_turns),
        sharpness=sharpness,
        brightness=brightness,
    )
    log(f"{recording.where}: {recording.kind}, {len(chosen)} pictures; cameras and depth come from the map")
    lost = 1 - (1 - recording.incomplete) * len(chosen) / len(rows)
    blurred = float((sharpness < extraction.BLURRED_SHARE * max(float(np.median(sharpness)), 1e-6)).mean())
    qa.write(
        folder,
        good="upright, sharp pictures",
        bad="sideways, dark or blurred pictures",
        checks=[
            qa.Check("duration", float(time_s[-1] - time_s[0]), "s", warn=5.0, better="higher"),
            qa.Check("pictures", float(len(chosen)), "", warn=50, better="higher"),
            qa.Check("dark pictures", 100 * float((brightness < extraction.DARK).mean()), "%", warn=20.0),
            qa.Check("blurred pictures", 100 * blurred, "%", warn=25.0),
            qa.Check("damaged or missing pictures", 100 * lost, "%", warn=0.0),
        ],
        pictures=[qa.Picture("contact_sheet", np.concatenate(strip, axis=1), "frames spread over the video")],
    )
