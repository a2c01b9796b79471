"""Goal networks learn the distribution of goals from codes and from maps, and average their ensemble."""

import torch

from pipeline.behavior.diffusion import STANDARD, noised, sample
from pipeline.behavior.encoders import ATTENDED_CHANNELS
from pipeline.behavior.goal_denoiser import GoalMLP, MapAttention
from pipeline.behavior.path_encoding import GOAL_LENGTH_POWER
from pipeline.behavior.perception import MAP_KEY_CHANNELS

CELLS = 4


def trained(net: GoalMLP, draw, steps: int) -> GoalMLP:
    """Fit a network to pairs of goals and perception codes from ``draw``."""
    alpha_bar = torch.from_numpy(STANDARD.alpha_bar).float()
    optimizer = torch.optim.AdamW(net.parameters(), 3e-3)
    for _ in range(steps):
        clean, perceived = draw(128)
        t, noise = torch.randint(50, (128,)), torch.randn_like(clean)
        loss = (
            (net(noised(clean, noise, alpha_bar[t][:, None]), t.float(), perceived) - noise).square().mean()
        )
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    return net.eval()


def goals(net: GoalMLP, perceived: torch.Tensor, count: int) -> torch.Tensor:
    """Sample goals for every perception code."""
    shape = (len(perceived) * count, 3)
    with torch.inference_mode():
        x = sample(
            lambda x, t: net.per_member(x, torch.full(shape[:1], t), perceived, torch.ones(shape[0])).mean(0),
            torch.randn(shape), STANDARD, method="dpm_solver", count=10,
        )  # fmt: skip
    return x.unflatten(0, (-1, count))


def test_goal_network_learns_the_distribution():
    torch.manual_seed(0)

    def draw(size):
        code = torch.sign(torch.randn(size, 2))
        return torch.cat([code, code[:, :1]], dim=1) + 0.1 * torch.randn(size, 3), code

    net = trained(GoalMLP(code=2, hidden=32), draw, 400)
    found = goals(net, torch.tensor([[1.0, -1.0]]), 200)
    assert (found.mean((0, 1)) - torch.tensor([1.0, -1.0, 1.0])).abs().max() < 0.25


def test_goals_are_beside_the_attended_other():
    torch.manual_seed(0)
    net = GoalMLP(code=1, hidden=32, attended_channels=ATTENDED_CHANNELS)

    def draw(size):
        position = torch.randn(size, 2) * 2
        distance = position.norm(dim=-1, keepdim=True)
        scaled = position / distance * distance**GOAL_LENGTH_POWER
        goal = torch.stack([scaled[:, 0], torch.zeros(size), scaled[:, 1]], dim=-1)
        code = torch.cat([torch.zeros(size, 1), torch.ones(size, 1), position], dim=-1)
        return goal + 0.1 * torch.randn(size, 3), code

    net = trained(net, draw, 300)
    clean, code = draw(20)
    assert (goals(net, code, 20) - clean[:, None]).norm(dim=-1).mean() < 0.35
    code[:, 1:] = 0
    assert (goals(net, code, 20) - clean[:, None]).norm(dim=-1).mean() > 0.7


def test_goals_follow_the_map():
    torch.manual_seed(0)
    net = GoalMLP(code=1, hidden=32, map_cells=CELLS)
    places = net.map.power

    def draw(size):
        cell = torch.randint(CELLS**2, (size,))
        chart = torch.zeros(size, 2 * MAP_KEY_CHANNELS, CELLS**2)
        chart[torch.arange(size), 0, cell] = 1.0
        there = places[cell]
        return torch.stack([there[:, 0], 0 * there[:, 0], there[:, 1]], dim=1), torch.cat(
            [chart.flatten(1), torch.zeros(size, 1)], dim=1
        )

    clean, perceived = draw(16)
    found = goals(trained(net, draw, 300), perceived, 8)
    assert (found - clean[:, None]).norm(dim=-1).median() < 0.4  # neighboring cells are some 1.2 apart


def test_local_heads_read_the_map_at_candidate_goals():
    attention = MapAttention(CELLS, 2, 1)
    torch.nn.init.zeros_(attention.query.weight)
    torch.nn.init.zeros_(attention.query.bias)
    x = attention.power[[2, 9]] @ torch.tensor([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    read = attention(
        x, torch.zeros(2, 1), torch.zeros(1, 2, 2), torch.zeros(2, 1, 2 * MAP_KEY_CHANNELS * CELLS**2), 1
    )[0]
    looked = read[:, MapAttention.HEADS * MAP_KEY_CHANNELS :][:, : 2 * MapAttention.HEADS].unflatten(
        1, (-1, 2)
    )
    torch.testing.assert_close(looked[:, 0], x[:, ::2], atol=1e-3, rtol=0)
    torch.testing.assert_close(looked[:, -1], torch.zeros(2, 2), atol=1e-5, rtol=0)


def test_ensemble_members_are_averaged_and_read_their_own_codes():
    torch.manual_seed(0)
    net = GoalMLP(code=6, hidden=16, ensemble_size=2)
    x, t, code = torch.randn(5, 3), torch.full((5,), 7.0), torch.randn(5, 12)
    first, second = net.per_member(x, t, code, torch.ones(5))
    torch.testing.assert_close(net(x, t, code), (first + second) / 2)
    other = code.clone()
    other[:, 6:] += 1.0
    unmoved, moved = net.per_member(x, t, other, torch.ones(5))
    torch.testing.assert_close(unmoved, first)
    assert (moved - second).abs().max() > 1e-4
    earlier = net(x, t, code, torch.full((5,), 0.3))
    assert (earlier - net(x, t, code)).abs().max() > 1e-4
