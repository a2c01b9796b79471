"""The denoiser of goals (Eq. 7): a multilayer perceptron that also reads the map where a goal may yet come to
lie.

A code of the whole scene hardly holds where things stand. `MapAttention` looks up the map around the noisy
goal, as far off as the noise lets it be, and elsewhere wherever the perception code asks it to look;
`RestLikelihood` measures how well the noisy goal agrees with none, for animals mostly stay. Both on two kept
homes of the behaviour benchmark, see `docs/behavior.md`.
"""

from itertools import pairwise

import torch
from jaxtyping import Float
from torch import Tensor, nn

from pipeline.behavior.config import MapLookup
from pipeline.behavior.denoisers import TIME_CHANNELS, NoiseFromVelocity, time_embedding
from pipeline.behavior.diffusion import STANDARD, Schedule
from pipeline.behavior.path_encoding import GOAL_LENGTH_POWER, with_powered_length
from pipeline.behavior.perception import GRID_CELL_M, GRID_SHAPE, MAP_KEY_CHANNELS
from pipeline.behavior.pointwise import MapAtGoal

HORIZON_CHANNELS = 8


class GoalMLP(nn.Module):
    """Six layers of 128 (appendix A.2) per member, whose answers are averaged.

    The condition holds the maps of all members (of ``map_cells`` squared each, or none), their codes, and
    more that goals do not read. Training may ask where the animal is at another part of the 5.6 s
    (``horizon`` below 1), which teaches it more from as many minutes. All members are asked in one product
    per layer: a plan for one animal is made of small products.
    """

    def __init__(
        self, code: int, hidden: int = 128, layers: int = 6, schedule: Schedule = STANDARD, *,
        ensemble_size: int = 1,
        map_cells: int = 0, map_lookup: MapLookup = "attention",
    ):  # fmt: skip
        super().__init__()
        self.noise, self.code, self.ensemble_size = NoiseFromVelocity(schedule), code, ensemble_size
        self.map_numbers = 2 * MAP_KEY_CHANNELS * map_cells**2
        code_channels = TIME_CHANNELS + HORIZON_CHANNELS + code
        self.clean, self.staying = CleanGoalEstimate(schedule), RestLikelihood()
        self.map: MapAtGoal | MapAttention | None = None
        if map_cells and map_lookup == "pointwise":
            self.map = MapAtGoal()
        elif map_cells:
            self.map = MapAttention(map_cells, code_channels, ensemble_size)
        inputs = 3 + code_channels + RestLikelihood.NUMBERS + (self.map.NUMBERS if self.map else 0)
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
        """Return what each member makes of it. A batch has its draws together."""
        angle = horizon[:, None] * torch.tensor([1.0, 2.0, 4.0, 8.0], device=x.device)
        asked = torch.cat([time_embedding(t), angle.sin(), angle.cos()], dim=-1)
        each = [self.ensemble_size * self.map_numbers, self.ensemble_size * self.code]
        parts = condition[:, : sum(each)].split(each, dim=1)
        maps, codes = (part.unflatten(1, (self.ensemble_size, -1)) for part in parts)
        draws = 1 if x.shape[0] == condition.shape[0] else x.shape[0] // condition.shape[0]
        code = codes.transpose(0, 1)[:, :, None].expand(-1, -1, draws, -1).flatten(1, 2)
        code_channels = torch.cat([asked.expand(self.ensemble_size, -1, -1), code], dim=-1)
        clean = self.clean(x, t)
        point = torch.cat([x, self.staying(*clean)], dim=-1)
        seen = [point.expand(self.ensemble_size, -1, -1), code_channels]
        if self.map is not None:
            seen.append(self.map(*clean, code_channels, maps, draws))
        return self.noise(x, self.layers(torch.cat(seen, dim=-1)), t)


class EnsembleLinear(nn.Module):
    """A linear layer per member."""

    def __init__(self, ensemble_size: int, inner: int, outer: int):
        super().__init__()
        each = [nn.Linear(inner, outer) for _ in range(ensemble_size)]
        self.weight = nn.Parameter(torch.stack([layer.weight.detach() for layer in each]))
        self.bias = nn.Parameter(torch.stack([layer.bias.detach() for layer in each])[:, None])

    def forward(self, rows: Float[Tensor, "member row inner"]) -> Float[Tensor, "member row outer"]:
        return torch.baddbmm(self.bias, rows, self.weight.transpose(-1, -2))


class CleanGoalEstimate(nn.Module):
    """Where the clean goal lies if nothing is known but the noisy one: mean and variance, in scaled units."""

    root: Tensor
    variance: Tensor

    def __init__(self, schedule: Schedule):
        super().__init__()
        share = torch.from_numpy(schedule.alpha_bar).float()
        self.register_buffer("root", share.sqrt(), persistent=False)
        self.register_buffer("variance", (1 - share) / share, persistent=False)

    def forward(
        self, x: Float[Tensor, "batch 3"], t: Float[Tensor, "batch"]
    ) -> tuple[Float[Tensor, "batch 3"], Float[Tensor, "batch 1"]]:
        step = t.long()[:, None]
        return x / self.root[step], self.variance[step]


class RestLikelihood(nn.Module):
    """How well a noisy goal agrees with where the animal is, for several spreads about it."""

    SPREADS = (0.0, 0.05, 0.2, 0.6)
    """standard deviations of goals that count as staying, in scaled units"""
    NUMBERS = 5 * len(SPREADS)
    MIN, MAX = -4.0, 5.0
    """bounds of its outputs"""
    spread: Tensor

    def __init__(self):
        super().__init__()
        self.register_buffer("spread", torch.tensor(self.SPREADS).square(), persistent=False)

    def forward(
        self, mean: Float[Tensor, "batch 3"], variance: Float[Tensor, "batch 1"]
    ) -> Float[Tensor, "batch 20"]:
        """Return likelihoods (not normalised), their logarithms, and where the goal would be expected."""
        odds = -mean.square().sum(-1, keepdim=True) / (2 * (variance + self.spread))
        shrunk = mean[:, None] * (odds.exp() * self.spread / (variance + self.spread))[..., None]
        likelihood, logarithm = odds.exp(), (odds / 5).clamp_min(self.MIN)
        return torch.cat([likelihood, logarithm, shrunk.flatten(1).clamp(-self.MAX, self.MAX)], dim=-1)


class MapAttention(nn.Module):
    """Attention over the cells of a map, whose keys and values are its channels, in place of a code of the
    whole.

    Two heads keep to where the clean goal may lie, given the noisy one, as a Bayesian would; two look
    anywhere.
    """

    LOCAL, HEADS = 2, 4
    PLACE = 5
    """numbers of a cell for its position: twice x and z, in parts of the map and as goals are diffused,
    and the latter's square"""
    NUMBERS = HEADS * (MAP_KEY_CHANNELS + 2) + LOCAL * 2
    FAR = 8.0
    """bound of the noisy goal, in scaled units"""
    FIRST_LOG_VARIANCE = (0.0, -3.0)
    """logarithms of the first share of the noise's variance in a head's, and of what is added to it"""
    place: Tensor
    power: Tensor
    goal_std: Tensor

    def __init__(self, cells: int, code_channels: int, ensemble_size: int):
        super().__init__()
        half_m = GRID_SHAPE[0] * GRID_CELL_M / 2
        axis = (torch.arange(cells) + 0.5) * (2 * half_m / cells) - half_m
        z, x = torch.meshgrid(axis, axis, indexing="ij")
        place = torch.stack([x, torch.zeros_like(x), z], dim=-1).flatten(0, 1)
        self.register_buffer("place", place[:, ::2] / half_m, persistent=False)
        self.register_buffer("power", with_powered_length(place, GOAL_LENGTH_POWER)[:, ::2], persistent=False)
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
        draws: int,  # noisy goals of each of the batch
    ) -> Float[Tensor, "member draw 44"]:
        """Return what each head reads, where it looks on average, and how far that is from the noisy goal."""
        key, value = maps.transpose(0, 1).unflatten(-1, (2, MAP_KEY_CHANNELS, -1)).unbind(2)
        scaled = self.power / self.goal_std[::2]
        cells = torch.cat([self.place, scaled, scaled.square().sum(-1, keepdim=True)], dim=-1)
        mean = mean[:, None, ::2].clamp(-self.FAR, self.FAR)
        share = self.log_variance.exp()
        narrow = 1 / (variance * share[..., 0] + share[..., 1])[..., None]
        query = self.query(code_channels).unflatten(-1, (self.HEADS, -1))
        near = torch.cat([torch.zeros_like(mean * narrow), mean * narrow, -narrow / 2], dim=-1)
        where = query[..., MAP_KEY_CHANNELS:] + nn.functional.pad(near, (0, 0, 0, self.HEADS - self.LOCAL))
        asked, where = (
            part.reshape(part.shape[0], -1, draws * self.HEADS, part.shape[-1])
            for part in (query[..., :MAP_KEY_CHANNELS] * MAP_KEY_CHANNELS**-0.5, where)
        )
        weight = (asked @ key + where @ cells.transpose(-1, -2)).softmax(-1)
        read, looked = (
            (weight @ rows).flatten(1, 2).unflatten(1, (-1, self.HEADS))
            for rows in (value.transpose(-1, -2), scaled)
        )
        read, place = read.flatten(2), looked.flatten(2)
        return torch.cat([read, place, (looked[:, :, : self.LOCAL] - mean).flatten(2)], dim=-1)
