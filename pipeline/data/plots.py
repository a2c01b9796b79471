"""Plots and contact sheets for the quality pages of all stages.

Charts: `panels` makes axes, `floor_plan`, `loss_curves`, `histograms` and `time_series` draw on them,
`pixels` returns the picture; no display, no global state. Pictures: `resized`, `outlined`,
`depth_colors` and `labeled` change one, `grid` lays several out.
"""

from collections.abc import Mapping, Sequence

import cv2
import numpy as np
from jaxtyping import Bool, Float, Num, Shaped, UInt8
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

BLUE, ORANGE, GREEN, RED, GRAY = "#3b6ea5", "#dd8452", "#55a868", "#c44e52", "#bbbbbb"
"""What was recorded of the animal; what was generated; the observer; what is wrong or sampled;
surroundings."""
BACKGROUND = 245
"""Gray value (of 255) of the background."""
DOTS_PER_INCH = 80
SMOOTHED_OVER = 50
"""Smoothing window of a curve: one fiftieth of its length."""
DEPTH_RANGE_M = 4.0
"""End of the depth color scale: the width of a room."""
LABEL_PX = 20
"""Height of a line of text below a picture."""


def panels(
    rows: int, columns: int, *, width_in: float, height_in: float
) -> tuple[Figure, Shaped[np.ndarray, "rows columns"]]:
    """Return a figure and its axes [row, column]; sizes in inches of 80 pixels."""
    figure = Figure(figsize=(width_in, height_in), dpi=DOTS_PER_INCH, layout="constrained")
    return figure, figure.subplots(rows, columns, squeeze=False)


def pixels(figure: Figure) -> UInt8[np.ndarray, "height width 3"]:
    """Draw a figure and return its pixels."""
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()


def running_mean(values: Num[np.ndarray, "step"]) -> Float[np.ndarray, "mean"]:
    """Return the moving average over a fiftieth of the curve, complete windows only."""
    width = max(len(values) // SMOOTHED_OVER, 1)
    return np.convolve(values, np.ones(width) / width, "valid")


def loss_curves(
    curves: Mapping[str, Mapping[str, Num[np.ndarray, "curve step"] | Num[np.ndarray, "step"]]],
    *,
    width_in: float = 9.0,
    log: bool = True,
) -> UInt8[np.ndarray, "height width 3"]:
    """Draw smoothed losses, one panel per name and one color per label."""
    figure, axes = panels(1, max(len(curves), 1), width_in=width_in, height_in=3.0)
    for axis, (title, labeled_curves) in zip(axes[0], curves.items(), strict=False):
        for number, (label, values) in enumerate(labeled_curves.items()):
            for row, curve in enumerate(np.atleast_2d(values)):
                means = running_mean(curve)
                steps = np.arange(len(means)) + len(curve) - len(means) + 1
                shown = label if row == 0 else None
                axis.plot(steps, means, color=f"C{number % 10}", linewidth=0.8, label=shown)
        axis.set(title=title, xlabel="step", ylabel="loss", yscale="log" if log else "linear")
        if len(labeled_curves) > 1:
            axis.legend(fontsize=7)
    return pixels(figure)


def histograms(
    values: Mapping[str, Num[np.ndarray, "..."]], *, log: bool = False, good_below: float | None = None
) -> UInt8[np.ndarray, "height width 3"]:
    """Draw one histogram per axis label; a logarithmic axis omits values that are not positive.

    Bins below ``good_below`` are green, the others orange.
    """
    figure, axes = panels(1, len(values), width_in=max(3 * len(values), 5), height_in=2.6)
    for axis, (label, array) in zip(axes[0], values.items(), strict=True):
        known = array[np.isfinite(array) & ((array > 0) | (not log))]
        bins = np.geomspace(known.min() / 1.01, known.max() * 1.01, 41) if log and len(known) else 40
        _, edges, bars = axis.hist(known, bins=bins, color=BLUE)
        if good_below is not None:
            for edge, bar in zip(edges, bars, strict=False):
                bar.set_facecolor(GREEN if edge < good_below else ORANGE)
        axis.set(xlabel=label, ylabel="count", xscale="log" if log else "linear")
    return pixels(figure)


def time_series(
    label: str,
    values: Num[np.ndarray, "frame"],
    time_s: Num[np.ndarray, "frame"],
    absent: Bool[np.ndarray, "frame"],
) -> UInt8[np.ndarray, "height width 3"]:
    """Draw values over seconds; ``absent`` frames are red."""
    figure, ((axis,),) = panels(1, 1, width_in=9.0, height_in=1.6)
    axis.fill_between(time_s, values, color=GREEN, step="mid", linewidth=0)
    frame = axis.get_xaxis_transform()
    axis.fill_between(time_s, 0, 1, where=absent, color=RED, alpha=0.3, step="mid", transform=frame)
    axis.set(xlabel="time [s]", ylabel=label, ylim=(0, None))
    axis.margins(x=0)
    return pixels(figure)


def floor_plan(
    axis: Axes,
    solid: Num[np.ndarray, "column row"],
    low_m: Float[np.ndarray, "2"],
    cell_m: float,
    *,
    cmap: str = "Greys",
    vmax: float | None = 1.5,
    alpha: float = 1.0,
) -> None:
    """Draw values of columns of the room (x, z) from above, +x right, +z down.

    ``low_m`` is the world's (x, z) of the first column's outer corner. A single column draws nothing: nothing
    is known.
    """
    if solid.size > 1:
        high_m = low_m + np.array(solid.shape) * cell_m
        extent = (low_m[0], high_m[0], high_m[1], low_m[1])
        axis.imshow(solid.T, extent=extent, cmap=cmap, vmax=vmax, alpha=alpha)


def resized(
    image: UInt8[np.ndarray, "height width *channel"], size: tuple[int, int]
) -> UInt8[np.ndarray, "resized_height resized_width *channel"]:
    """Return a picture of ``size`` (height, width) in pixels, averaged where it shrinks."""
    shrinks = size[0] < image.shape[0]
    return cv2.resize(image, size[::-1], interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_NEAREST)


def labeled(image: UInt8[np.ndarray, "height width 3"], text: str) -> UInt8[np.ndarray, "labeled width 3"]:
    """Return a picture with a line of text below it."""
    strip = np.full((LABEL_PX, image.shape[1], 3), BACKGROUND, np.uint8)
    place = (4, LABEL_PX - 6)
    cv2.putText(strip, text, place, cv2.FONT_HERSHEY_SIMPLEX, 0.45, (20, 20, 20), 1, cv2.LINE_AA)
    return np.concatenate([image, strip])


def grid(images: Sequence[UInt8[np.ndarray, "_ _ 3"]], columns: int) -> UInt8[np.ndarray, "height width 3"]:
    """Arrange pictures in a grid, row by row; smaller ones are padded to the largest."""
    height, width = np.max([image.shape[:2] for image in images], axis=0)
    sheet = np.full((-(-len(images) // columns), columns, height, width, 3), BACKGROUND, np.uint8)
    for place, image in enumerate(images):
        sheet[place // columns, place % columns, : image.shape[0], : image.shape[1]] = image
    return np.concatenate(np.concatenate(sheet, axis=1), axis=1)


def outlined(
    image: UInt8[np.ndarray, "height width 3"],
    mask: Bool[np.ndarray, "height width"],
    color: tuple[int, int, int] = (60, 255, 90),
) -> UInt8[np.ndarray, "height width 3"]:
    """Return a picture with a one pixel outline around a mask, green by default."""
    inside = mask.astype(np.uint8)
    drawn = image.copy()
    drawn[cv2.dilate(inside, np.ones((3, 3), np.uint8)) > inside] = color
    return drawn


def depth_colors(depth: Float[np.ndarray, "height width"]) -> UInt8[np.ndarray, "height width 3"]:
    """Color z depth in meters from near (yellow) to far (violet); unknown (0) is black."""
    nearness = np.clip(255 * (1 - depth / DEPTH_RANGE_M), 0, 255).astype(np.uint8)
    colors = cv2.applyColorMap(nearness, cv2.COLORMAP_VIRIDIS)[..., ::-1]
    return colors * (depth > 0)[..., None].astype(np.uint8)
