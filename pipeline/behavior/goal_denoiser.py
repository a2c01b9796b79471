"""The denoiser of goals (Eq. 7): a multilayer perceptron that also attends to the scene map.

A global scene code hardly retains where things are. `MapAttention` has heads that attend around the noisy
goal, as far as its noise level allows, and heads that attend where the perception code directs them;
`GoalLikelihood` is the likelihood of the noisy goal if the animal rests, as it mostly does, or joins another.
They were evaluated on held-out homes, see `docs/experiments/behavior.md`.
"""

from itertools import pairwise

import torch
from jaxtyping import Float
from torch import Tensor, nn

from pipeline.behavior.denoisers import TIME_CHANNELS, NoiseFromVelocity, time_embedding
from pipeline.behavior.diffusion import STANDARD, Schedule
from pipeline.behavior.encoders import ATTENDED_CHANNELS, MIN_WEIGHT
from pipeline.behavior.path_encoding import GOAL_LENGTH_POWER, with_powered_length
from pipeline.behavior.perception import GRID_CELL_M, GRID_SHAPE, MAP_KEY_CHANNELS

HORIZON_CHANNELS = 8
REST_STDS, BESIDE_STDS = (0.0, 0.05, 0.2, 0.6), (0.2, 0.5, 1.0)
"""standard deviations of the goals of resting animals and of those beside others, in scaled units"""


class GoalMLP(nn.Module):
    """An ensemble of MLPs, six layers of 128 each (appendix A.2), whose predictions are averaged.

    The condition holds the maps of all members (``map_cells`` squared each, or none), their codes, and more
    that goals do not read. Training may also predict positions at earlier times (``horizon`` below 1, as a
    share of the 5.6 s), which uses the data better. Members are batched in one product per layer, for speed.
    """

    def __init__(
        self, code: int, hidden: int = 128, layers: int = 6, schedule: Schedule = STANDARD, *,
        ensemble_size: int = 1, map_cells: int = 0, attended_channels: int = 0,
        length_power: float = GOAL_LENGTH_POWER,
    ):  # fmt: skip
        """``length_power``: of the lengths of goals."""
        super().__init__()
        code += attended_channels
        self.noise, self.code, self.ensemble_size = NoiseFromVelocity(schedule), code, ensemble_size
        self.others = OthersLikelihood(attended_channels, length_power) if attended_channels else None
        self.map_numbers = 2 * MAP_KEY_CHANNELS * map_cells**2
        code_channels = TIME_CHANNELS + HORIZON_CHANNELS + code
        self.clean, self.staying = CleanGoalEstimate(schedule), GoalLikelihood(REST_STDS)
        self.map = MapAttention(map_cells, code_channels, ensemble_size, length_power) if map_cells else None
        inputs = 3 + code_channels + self.staying.numbers + (self.map.NUMBERS if self.map else 0)
        inputs += self.others.numbers if self.others else 0
        sizes, inner = [inputs] + [hidden] * (layers - 1), []
        for narrow, wide in pairwise(sizes):
            inner += [EnsembleLinear(ensemble_size, narrow, wide), nn.SiLU()]
        self.layers = nn.Sequential(*inner, EnsembleLinear(ensemble_size, sizes[-1], 3))

    def forward(
        self,
        x: Float[Tensor, "draw 3"],
        t: Float[Tensor, "draw"],
        condition: Float[Tensor, "batch condition"],
        horizon: Float[Tensor, "draw"] | None = None,
    ) -> Float[Tensor, "draw 3"]:
        return self.per_member(x, t, condition, torch.ones_like(t) if horizon is None else horizon).mean(0)

    def per_member(
        self,
        x: Float[Tensor, "draw 3"],
        t: Float[Tensor, "draw"],
        condition: Float[Tensor, "batch condition"],
        horizon: Float[Tensor, "draw"],
    ) -> Float[Tensor, "member draw 3"]:
        """Return the noise predicted by each member; the draws of a batch row are consecutive."""
        angle = horizon[:, None] * torch.tensor([1.0, 2.0, 4.0, 8.0], device=x.device)
        step_embedding = torch.cat([time_embedding(t), angle.sin(), angle.cos()], dim=-1)
        each = [self.ensemble_size * self.map_numbers, self.ensemble_size * self.code]
        parts = condition[:, : sum(each)].split(each, dim=1)
        maps, codes = (part.unflatten(1, (self.ensemble_size, -1)) for part in parts)
        draws = 1 if x.shape[0] == condition.shape[0] else x.shape[0] // condition.shape[0]
        code = codes.transpose(0, 1)[:, :, None].expand(-1, -1, draws, -1).flatten(1, 2)
        code_channels = torch.cat([step_embedding.expand(self.ensemble_size, -1, -1), code], dim=-1)
        clean = self.clean(x, t)
        point = torch.cat([x, self.staying(*clean)], dim=-1)
        inputs = [point.expand(self.ensemble_size, -1, -1), code_channels]
        if self.others is not None:
            inputs.append(self.others(*clean, code[..., -self.others.channels :]))
        if self.map is not None:
            inputs.append(self.map(*clean, code_channels, maps, draws))
        return self.noise(x, self.layers(torch.cat(inputs, dim=-1)), t)


class EnsembleLinear(nn.Module):
    """A linear layer for each member, evaluated as one batched product."""

    def __init__(self, ensemble_size: int, inner: int, outer: int):
        super().__init__()
        each = [nn.Linear(inner, outer) for _ in range(ensemble_size)]
        self.weight = nn.Parameter(torch.stack([layer.weight.detach() for layer in each]))
        self.bias = nn.Parameter(torch.stack([layer.bias.detach() for layer in each])[:, None])

    def forward(self, rows: Float[Tensor, "member row inner"]) -> Float[Tensor, "member row outer"]:
        return torch.baddbmm(self.bias, rows, self.weight.transpose(-1, -2))


class CleanGoalEstimate(nn.Module):
    """Mean and variance of the clean goal given only the noisy one, in scaled units."""

    sqrt_alpha_bar: Tensor
    variance: Tensor

    def __init__(self, schedule: Schedule):
        super().__init__()
        alpha_bar = torch.from_numpy(schedule.alpha_bar).float()
        self.register_buffer("sqrt_alpha_bar", alpha_bar.sqrt(), persistent=False)
        self.register_buffer("variance", (1 - alpha_bar) / alpha_bar, persistent=False)

    def forward(
        self, x: Float[Tensor, "batch 3"], t: Float[Tensor, "batch"]
    ) -> tuple[Float[Tensor, "batch 3"], Float[Tensor, "batch 1"]]:
        step = t.long()[:, None]
        return x / self.sqrt_alpha_bar[step], self.variance[step]


class GoalLikelihood(nn.Module):
    """Likelihood of a noisy goal under Gaussian priors of several deviations about a position."""

    MIN, MAX = -4.0, 5.0
    """bounds of its outputs"""
    prior_variance: Tensor

    def __init__(self, stds: tuple[float, ...]):
        super().__init__()
        self.numbers = 5 * len(stds)
        self.register_buffer("prior_variance", torch.tensor(stds).square(), persistent=False)

    def forward(
        self, offset: Float[Tensor, "*batch 3"], variance: Float[Tensor, "*#batch 1"]
    ) -> Float[Tensor, "*batch number"]:
        """Return unnormalized likelihoods, their logarithms, and likelihood-weighted posterior means.

        ``offset`` and ``variance`` are those of the clean goal given the noisy one, from the position.
        """
        total = variance + self.prior_variance
        log_likelihood = -offset.square().sum(-1, keepdim=True) / (2 * total)
        likelihood = log_likelihood.exp()
        shrunk = offset[..., None, :] * (likelihood * self.prior_variance / total)[..., None]
        logarithm = (log_likelihood / 5).clamp_min(self.MIN)
        return torch.cat([likelihood, logarithm, shrunk.flatten(-2).clamp(-self.MAX, self.MAX)], dim=-1)


class OthersLikelihood(nn.Module):
    """Positions of the others that each head attends to, and `GoalLikelihood` about them.

    A code hardly retains positions: without these, four times more steps bring goals no nearer to others.
    """

    goal_std: Tensor

    def __init__(self, channels: int, length_power: float = GOAL_LENGTH_POWER):
        super().__init__()
        self.length_power = length_power
        self.channels, self.likelihood = channels, GoalLikelihood(BESIDE_STDS)
        self.numbers = channels // ATTENDED_CHANNELS * (ATTENDED_CHANNELS + self.likelihood.numbers)
        self.register_buffer("goal_std", torch.ones(3))

    def forward(
        self,
        mean: Float[Tensor, "draw 3"],
        variance: Float[Tensor, "draw 1"],
        attended: Float[Tensor, "member draw attended"],
    ) -> Float[Tensor, "member draw number"]:
        """Return presence, and weighted by it the scaled position and the likelihoods, of each head."""
        presence, x, z = attended.unflatten(-1, (-1, ATTENDED_CHANNELS)).split(1, dim=-1)
        position = torch.cat([x, 0 * x, z], dim=-1) / (presence + MIN_WEIGHT)
        position = with_powered_length(position, self.length_power) / self.goal_std
        read = [position[..., ::2], self.likelihood(mean[:, None] - position, variance[:, None])]
        return torch.cat([presence, *(presence * each for each in read)], dim=-1).flatten(-2)


class MapAttention(nn.Module):
    """Attention over the cells of a map, whose channels are keys and values.

    Two local heads have the log-likelihood of the clean goal given the noisy one as a bias; two are global.
    """

    LOCAL, HEADS = 2, 4
    PLACE = 5
    """position channels of a cell: x and z relative to the map, x and z in goal units, squared norm of the
    latter"""
    NUMBERS = HEADS * (MAP_KEY_CHANNELS + 2) + LOCAL * 2
    FAR = 8.0
    """bound of the noisy goal, in scaled units"""
    FIRST_LOG_VARIANCE = (0.0, -3.0)
    """initial logarithms of the factor on the noise variance, and of the added variance, of local heads"""
    place: Tensor
    power: Tensor
    goal_std: Tensor

    def __init__(
        self, cells: int, code_channels: int, ensemble_size: int, length_power: float = GOAL_LENGTH_POWER
    ):
        super().__init__()
        half_m = GRID_SHAPE[0] * GRID_CELL_M / 2
        axis = (torch.arange(cells) + 0.5) * (2 * half_m / cells) - half_m
        z, x = torch.meshgrid(axis, axis, indexing="ij")
        place = torch.stack([x, torch.zeros_like(x), z], dim=-1).flatten(0, 1)
        self.register_buffer("place", place[:, ::2] / half_m, persistent=False)
        self.register_buffer("power", with_powered_length(place, length_power)[:, ::2], persistent=False)
        self.register_buffer("goal_std", torch.ones(3))
        self.query = EnsembleLinear(
            ensemble_size, code_channels, self.HEADS * (MAP_KEY_CHANNELS + self.PLACE)
        )
        self.log_variance = nn.Parameter(
            torch.tensor(self.FIRST_LOG_VARIANCE).expand(ensemble_size, 1, self.LOCAL, 2).clone()
        )

    def forward(
        self,
        mean: Float[Tensor, "draw 3"],
        variance: Float[Tensor, "draw 1"],
        code_channels: Float[Tensor, "member draw code"],
        maps: Float[Tensor, "batch member map"],
        draws: int,  # noisy goals per batch row
    ) -> Float[Tensor, "member draw 44"]:
        """Return each head's values and mean attended position, of local heads also relative to ``mean``."""
        key, value = maps.transpose(0, 1).unflatten(-1, (2, MAP_KEY_CHANNELS, -1)).unbind(2)
        scaled = self.power / self.goal_std[::2]
        cells = torch.cat([self.place, scaled, scaled.square().sum(-1, keepdim=True)], dim=-1)
        mean = mean[:, None, ::2].clamp(-self.FAR, self.FAR)
        factor = self.log_variance.exp()
        precision = 1 / (variance * factor[..., 0] + factor[..., 1])[..., None]
        query = self.query(code_channels).unflatten(-1, (self.HEADS, -1))
        bias = torch.cat([torch.zeros_like(mean * precision), mean * precision, -precision / 2], dim=-1)
        position = query[..., MAP_KEY_CHANNELS:] + nn.functional.pad(bias, (0, 0, 0, self.HEADS - self.LOCAL))
        content = query[..., :MAP_KEY_CHANNELS] * MAP_KEY_CHANNELS**-0.5
        query = torch.cat([content, position], dim=-1)
        query = query.reshape(len(query), -1, draws * self.HEADS, query.shape[-1])
        key, value = key.transpose(-1, -2), value.transpose(-1, -2)
        zero = 0 * key[..., :1]  # broadcasts; exported to ONNX, `expand` keeps the example's batch
        keys, values = torch.cat([key, cells + zero], dim=-1), torch.cat([value, scaled + zero], dim=-1)
        width = values.shape[-1]  # fused attention wants values as wide as keys
        values = nn.functional.pad(values, (0, keys.shape[-1] - width))
        read = nn.functional.scaled_dot_product_attention(query, keys, values, scale=1.0)[..., :width]
        read, attended = read.flatten(1, 2).unflatten(1, (-1, self.HEADS)).split([width - 2, 2], dim=-1)
        offset = attended[:, :, : self.LOCAL] - mean
        return torch.cat([read.flatten(2), attended.flatten(2), offset.flatten(2)], dim=-1)
