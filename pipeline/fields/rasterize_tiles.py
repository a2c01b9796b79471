"""The Gaussian rasterizer for a CPU: numba over tiles of 8 x 8 pixels, with an analytic backward pass.

Gradients are gathered in a fixed number of buffers, each filled in a fixed order, so that the result does not
depend on the number of threads.
"""

import math

import numba
import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from pipeline.fields.footprints import ALPHA_MAX, ALPHA_MIN, CUTOFF, NEAREST_M, Footprints

TILE = 8
BUFFERS = 4
"""gradient buffers; tiles are assigned to them round-robin"""
MIN_TRANSMITTANCE = np.float32(1e-4)
_MIN, _MAX, _MAX_POWER = np.float32(ALPHA_MIN), np.float32(ALPHA_MAX), np.float32(0.5 * CUTOFF**2)
_HALF, _ONE = np.float32(0.5), np.float32(1.0)


@numba.njit(cache=True)
def _bin(pixel, radius, order, height, width):
    """List, tile by tile, the Gaussians that may touch it, near to far."""
    across, down = (width + TILE - 1) // TILE, (height + TILE - 1) // TILE
    start = np.zeros(across * down + 1, np.int64)
    box = np.empty((len(order), 4), np.int64)
    for k in range(len(order)):
        i = order[k]
        box[k, 0] = max(0, int((pixel[i, 0] - radius[i]) // TILE))
        box[k, 1] = min(across - 1, int((pixel[i, 0] + radius[i]) // TILE))
        box[k, 2] = max(0, int((pixel[i, 1] - radius[i]) // TILE))
        box[k, 3] = min(down - 1, int((pixel[i, 1] + radius[i]) // TILE))
        for y in range(box[k, 2], box[k, 3] + 1):
            for x in range(box[k, 0], box[k, 1] + 1):
                start[y * across + x + 1] += 1
    for tile in range(across * down):
        start[tile + 1] += start[tile]
    ids, filled = np.empty(start[-1], np.int64), start[:-1].copy()
    for k in range(len(order)):
        for y in range(box[k, 2], box[k, 3] + 1):
            for x in range(box[k, 0], box[k, 1] + 1):
                ids[filled[y * across + x]] = order[k]
                filled[y * across + x] += 1
    return start, ids


@numba.njit(cache=True, inline="always")
def _alpha(pixel, conic, opacity, i, x, y):
    """Return (alpha, unclamped alpha, dx, dy); alpha is 0 where the Gaussian is negligible."""
    dx, dy = x - pixel[i, 0], y - pixel[i, 1]
    power = _HALF * (conic[i, 0] * dx * dx + conic[i, 2] * dy * dy) + conic[i, 1] * dx * dy
    if power > _MAX_POWER or power < 0:
        return np.float32(0), np.float32(0), dx, dy
    raw = opacity[i] * np.float32(math.exp(-power))
    if raw < _MIN:
        return np.float32(0), raw, dx, dy
    return min(_MAX, raw), raw, dx, dy


@numba.njit(cache=True, parallel=True)
def _forward(pixel, conic, opacity, values, start, ids, height, width):
    across, channels = (width + TILE - 1) // TILE, values.shape[1]
    image = np.zeros((height, width, channels), np.float32)
    final_t = np.ones((height, width), np.float32)
    last = np.zeros((height, width), np.int64)
    for tile in numba.prange(len(start) - 1):
        top, left = (tile // across) * TILE, (tile % across) * TILE
        for row in range(top, min(height, top + TILE)):
            for column in range(left, min(width, left + TILE)):
                transmittance, end = _ONE, start[tile]
                for k in range(start[tile], start[tile + 1]):
                    i = ids[k]
                    alpha, _, _, _ = _alpha(
                        pixel, conic, opacity, i, np.float32(column + 0.5), np.float32(row + 0.5)
                    )
                    if alpha == 0:
                        continue
                    for channel in range(channels):
                        image[row, column, channel] += alpha * transmittance * values[i, channel]
                    transmittance *= _ONE - alpha
                    end = k + 1
                    if transmittance < MIN_TRANSMITTANCE:
                        break
                final_t[row, column] = transmittance
                last[row, column] = end
    return image, final_t, last


@numba.njit(cache=True, parallel=True)
def _backward(pixel, conic, opacity, values, start, ids, final_t, last, grad_image, grad_coverage):
    """Walk each pixel's Gaussians far to near, undoing the blending, and gather gradients per Gaussian.

    Columns: pixel x y, conic a b c, opacity, then the values.
    """
    height, width, channels = grad_image.shape
    across = (width + TILE - 1) // TILE
    grads = np.zeros((BUFFERS, len(pixel), 6 + channels), np.float32)
    for buffer in numba.prange(BUFFERS):
        behind = np.zeros(channels, np.float32)
        for tile in range(buffer, len(start) - 1, BUFFERS):
            top, left = (tile // across) * TILE, (tile % across) * TILE
            for row in range(top, min(height, top + TILE)):
                for column in range(left, min(width, left + TILE)):
                    transmittance = final_t[row, column]
                    behind[:] = 0
                    for k in range(last[row, column] - 1, start[tile] - 1, -1):
                        i = ids[k]
                        alpha, raw, dx, dy = _alpha(
                            pixel, conic, opacity, i, np.float32(column + 0.5), np.float32(row + 0.5)
                        )
                        if alpha == 0:
                            continue
                        transmittance /= _ONE - alpha
                        weight = alpha * transmittance
                        grad_alpha = final_t[row, column] / (_ONE - alpha) * grad_coverage[row, column]
                        for channel in range(channels):
                            upstream = grad_image[row, column, channel]
                            grads[buffer, i, 6 + channel] += weight * upstream
                            grad_alpha += (
                                transmittance * values[i, channel] - behind[channel] / (_ONE - alpha)
                            ) * upstream
                            behind[channel] += weight * values[i, channel]
                        if raw < _MAX:
                            grads[buffer, i, 5] += grad_alpha * raw / opacity[i]
                            grad_power = -grad_alpha * raw
                            grads[buffer, i, 0] -= grad_power * (conic[i, 0] * dx + conic[i, 1] * dy)
                            grads[buffer, i, 1] -= grad_power * (conic[i, 2] * dy + conic[i, 1] * dx)
                            grads[buffer, i, 2] += grad_power * _HALF * dx * dx
                            grads[buffer, i, 3] += grad_power * dx * dy
                            grads[buffer, i, 4] += grad_power * _HALF * dy * dy
    return grads


class _Blend(torch.autograd.Function):
    """The kernels as one differentiable operation."""

    @staticmethod
    def forward(context, pixel, conic, opacity, values, radius, depth, height, width):
        pixel, conic, opacity, values = (
            tensor.detach().contiguous().numpy() for tensor in (pixel, conic, opacity, values)
        )
        reach, depths = radius.detach().numpy(), depth.detach().numpy()
        x, y = pixel.T
        seen = (
            (depths > NEAREST_M)
            & (x + reach > 0)
            & (x - reach < width)
            & (y + reach > 0)
            & (y - reach < height)
        )
        order = np.flatnonzero(seen)
        order = order[np.argsort(depths[order], kind="stable")]
        start, ids = _bin(pixel, reach, order, height, width)
        image, final_t, last = _forward(pixel, conic, opacity, values, start, ids, height, width)
        context.state = (pixel, conic, opacity, values, start, ids, final_t, last)
        return torch.from_numpy(image), torch.from_numpy(1 - final_t)

    @staticmethod
    def backward(context, grad_image, grad_coverage):
        pixel, conic, opacity, values, start, ids, final_t, last = context.state
        upstream = grad_image.contiguous().numpy(), grad_coverage.contiguous().numpy()
        grads = _backward(pixel, conic, opacity, values, start, ids, final_t, last, upstream[0], upstream[1])
        total = torch.from_numpy(grads.sum(0))
        return total[:, :2], total[:, 2:5], total[:, 5], total[:, 6:], None, None, None, None


def blend_tiles(
    footprints: Footprints,
    opacity: Float[Tensor, "point"],
    values: Float[Tensor, "point channel"],
    height: int,
    width: int,
) -> tuple[Float[Tensor, "height width channel"], Float[Tensor, "height width"]]:
    """Blend Gaussians near to far, in tiles of pixels: return blended values and coverage."""
    f = footprints
    return _Blend.apply(f.pixel, f.conic, opacity, values, f.radius_px, f.depth, height, width)
