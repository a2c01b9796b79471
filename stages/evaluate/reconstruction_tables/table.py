"""Measure several reconstructions from the same held-out phone, and compare them picture by picture."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt8

from pipeline.core import devices
from pipeline.core.videos import Video
from pipeline.data import plots, ply
from pipeline.data.qa import Check
from pipeline.geometry import views
from pipeline.metrics.intervals import aligned, bootstrapped, episodes, formatted_interval
from pipeline.metrics.lpips import Lpips
from pipeline.metrics.metrics import Metrics, formatted
from stages.evaluate import heldout, reading, reconstruction, surfaces
from stages.evaluate.heldout import PARTS
from stages.evaluate.reading import Reconstructed

PAPER = {
    "ours": (0.708, 0.695, 0.703),
    "totalrecon": (0.099, 0.647, 0.053),
    "totalrecon_single": (0.533, 0.685, 0.518),
}
"""DepthAcc of all, agent and scene on the paper's own cat (Table 3)"""
NAMES = {
    "ours": "ours",
    "no_localizer": "without localizer",
    "mlp_fields": "MLPs, no fused depth",
    "paper_small": "the paper's form, few steps",
    "no_feature_loss": "the paper's form without feature-metric loss",
    "no_annealing": "the paper's form without scene annealing",
    "totalrecon": "TotalRecon, all videos",
    "totalrecon_single": "TotalRecon, one video",
}
REFERENCES = {"no_feature_loss": "paper_small", "no_annealing": "paper_small"}
"""What an ablation is compared with where that is not ours."""
COLUMNS = {
    "depth_acc": "DepthAcc@0.1m",
    "rendered_depth_acc": "of rendered depth",
    "psnr": "PSNR, dB",
    "ssim": "SSIM",
    "lpips": "LPIPS",
}
TITLE = (
    "Table 3: seen by the held-out phone (all / agent / scene); roots and followed points in the sessions it "
    "filmed too"
)
FOOTNOTE = (
    "reference: ours, or the paper's form for its ablations; paper: DepthAcc on its own cat; tracks: median /"
    " 90th percentile; '-': nothing could be measured; what was refused counts as wrong. Same seed for all;"
    " the paper's form has its own steps, the others ours."
)
NO_TRUTH = "what the held-out phone truly saw is not known for this capture"
FLOOR_QUANTILE = 0.02
"""of the heights of vertices: the floor, whatever few lie beneath it"""
ROOM_PX = 320
"""Width of a room in the comparison."""
EPISODE_FRAMES = 3
"""Rendered frames that are resampled together: neighbors look alike."""


def metrics(
    folders: Mapping[str, Path],
    places: Reconstructed,
    videos: Sequence[Video],
    heldout_frames: int,
    rng: np.random.Generator,
    device: devices.Device,
    lpips: Lpips | None = None,
) -> Metrics:
    """Return ``<variant>/<figure>`` of every variant, and DepthAcc below its reference, with intervals."""
    found = Metrics()
    if places.truth is None:
        names = [f"{variant}/{kind}_{part}" for variant in folders for kind in COLUMNS for part in PARTS]
        found.skip(names, NO_TRUTH)
        return found
    known = reading.recorded(places, tuple(videos))
    frames = reading.frames_of_truth(places, known)
    turnaround = reading.of_role(known, "turnaround")[0]
    pairs = reconstruction.phones_with_sessions(known)
    sessions = [session for _, session in pairs]
    shots = [
        (session.video.id, reconstruction.shots_of(places, phone, session, frames, heldout_frames))
        for phone, session in pairs
    ]
    pixels = heldout.RENDERED_PIXELS // max(len(shots), 1)
    few = [heldout.thinned(seen, pixels) for _, seen in shots]
    right: dict[str, Float[np.ndarray, "view part"]] = {}
    for variant, folder in folders.items():
        here = replace(places, reconstruction=folder)
        motions = {each.video.id: reading.read_motion(folder, each.video.id) for each in sessions}
        views, rendered = [], []
        for (session, seen), integrated in zip(shots, few, strict=True):
            drawn = reconstruction.drawn_by_fields(
                here, session, motions.get(session), seen, integrated, device
            )
            views, rendered = views + drawn[0], rendered + drawn[1]
        one = Metrics()
        if views:
            one.add(heldout.view_metrics(views, lpips))
            one.add(heldout.depth_metrics("reconstruction/rendered_depth_acc", rendered))
        else:
            drawn = [name for name in heldout.NAMES if name.startswith("reconstruction/")]
            one.skip(drawn, heldout.UNSEEN)
        one.add(reconstruction.agent_roots(sessions, motions, frames))
        followed = reconstruction.track_distances(here, sessions, motions, turnaround, frames)
        one.add(surfaces.track_metrics(followed))
        found.add_as(variant, one, "reconstruction")
        shares = [heldout.depth_metrics(variant, [view]).values for view in views]
        right[variant] = np.array([list(each.values()) for each in shares], float)  # NaN: not in view
        if views:
            found.pictures[variant] = heldout.side_by_side(views)
    for variant in folders:
        reference = REFERENCES.get(variant, "ours")
        if variant != "ours" and reference in right and len(right["ours"]):
            _compare(found, variant, right[reference] - right[variant], rng)
    return found


def _compare(
    found: Metrics, variant: str, lacking: Float[np.ndarray, "view part"], rng: np.random.Generator
) -> None:
    """Put the mean difference of pictures to the reference; neighboring pictures are resampled together."""
    number = np.arange(len(lacking))
    episode = episodes(number, np.zeros_like(number), EPISODE_FRAMES)
    for part, values in zip(PARTS, lacking.T, strict=True):
        if np.isfinite(values).any():
            interval = bootstrapped(values, episode, rng)
            found.put_mean(f"{variant}/depth_acc_{part}_less_than_reference", interval)


def text(values: Mapping[str, float | None], variants: Sequence[str]) -> str:
    """Lay the metrics out as Table 3, the paper's beside ours."""
    rows = [["", *COLUMNS.values(), "all, less than reference", "root, m / deg", "tracks, m", "paper"]]
    for variant in variants:

        def several(*names: str, form: str = ".3f", variant: str = variant) -> str:
            return " / ".join(formatted(values.get(f"{variant}/{name}"), form) for name in names)

        seen = [
            several(*(f"{kind}_{part}" for part in PARTS), form=".1f" if kind == "psnr" else ".3f")
            for kind in COLUMNS
        ]
        lacking = formatted_interval(values, f"{variant}/depth_acc_all_less_than_reference", ".3f")
        root = f"{several('agent_root_m_median')} / {several('agent_root_deg_median', form='.1f')}"
        tracks = several("agent_track_m_median", "agent_track_m_p90")
        paper = " / ".join(f"{value:g}" for value in PAPER.get(variant, ()))
        lacking = "" if variant == "ours" else lacking
        rows.append([NAMES.get(variant, variant), *seen, lacking, root, tracks, paper])
    return f"{aligned(TITLE, rows)}\n{FOOTNOTE}\n"


def pictures(found: Metrics) -> dict[str, tuple[UInt8[np.ndarray, "height width 3"], str]]:
    """Return the drawn views of every variant with a caption."""
    return {
        variant: (image, f"{NAMES.get(variant, variant)}: truth, drawn, true depth, drawn depth")
        for variant, image in found.pictures.items()
    }


def rooms(folders: Mapping[str, Path]) -> dict[str, tuple[UInt8[np.ndarray, "height width 3"], str]]:
    """Return the rooms of all variants from above, beside each other (Fig. 4), with a caption."""
    drawn = []
    for variant, folder in folders.items():
        mesh = ply.read_ply(folder / "scene.ply")
        floor_m = float(np.quantile(mesh.vertices[:, 1], FLOOR_QUANTILE))
        image = views.bird_view(mesh, floor_m=floor_m, width_px=ROOM_PX).image
        drawn.append(plots.labeled(image, NAMES.get(variant, variant)))
    caption = "the reconstructed room from above, by method (Fig. 4)"
    return {"rooms": (plots.grid(drawn, min(len(drawn), 3)), caption)}


def checks(values: Mapping[str, float | None], variants: Sequence[str]) -> list[Check]:
    """Judge whether ours, or the paper's form, is ahead of its baselines and ablations over all pixels."""
    share = values.get("ours/depth_acc_all")
    found = [Check("DepthAcc of all pixels, ours", share, "share", 0.85, 0.7, "higher")]
    for variant in (each for each in variants if each != "ours"):
        name = f"DepthAcc that is lacking: {NAMES.get(variant, variant)}"
        less = values.get(f"{variant}/depth_acc_all_less_than_reference")
        found.append(Check(name, less, "share", 0.0, None, "higher"))
    return found
