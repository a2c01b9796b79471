"""Parts of RAFT against reference formulas, its parameter count, and loading of official weights."""

import numpy as np
import pytest
import torch

from pipeline.backends import raft
from pipeline.core.errors import InputError

OFFICIAL_PARAMETERS = 5_257_536
"""as printed by the authors for the basic network"""


@pytest.fixture(scope="module")
def network():
    torch.manual_seed(0)
    return raft.Raft().eval()


def official_names(network) -> dict[str, torch.Tensor]:
    """The state dict as the authors save it: with a wrapper, and with shortcut norms under two names."""
    stored = {}
    for name, value in network.state_dict().items():
        stored[f"module.{name}"] = value
        if ".downsample.1." in name:
            stored["module." + name.replace(".downsample.1.", ".norm3.")] = value
    return stored


def test_parameter_count_is_official(network):
    assert sum(part.numel() for part in network.parameters()) == OFFICIAL_PARAMETERS
    expected = {
        "fnet.layer2.0.downsample.0.weight",
        "cnet.layer3.0.norm1.running_mean",
        "update_block.encoder.convc1.weight",
        "update_block.gru.convq2.bias",
        "update_block.flow_head.conv2.weight",
        "update_block.mask.2.weight",
    }
    assert expected <= set(network.state_dict())


def test_official_weights_load_and_others_are_refused(network, tmp_path):
    torch.save(official_names(network), tmp_path / "raft.pth")
    loaded = raft.load(tmp_path / "raft.pth")
    assert all(torch.equal(value, loaded.state_dict()[name]) for name, value in network.state_dict().items())
    torch.save({"module.conv1.weight": torch.zeros(1)}, tmp_path / "other.pth")
    (tmp_path / "text.pth").write_text("no weights")
    for name, code in (("none.pth", "MOD-001"), ("other.pth", "MOD-003"), ("text.pth", "MOD-003")):
        with pytest.raises(InputError) as refused:
            raft.load(tmp_path / name)
        assert refused.value.code == code
        assert "raft-things" in refused.value.remedy


def test_correlation_lookup_reads_the_volume():
    rng = torch.Generator().manual_seed(0)
    here, there = (torch.randn(1, 5, 16, 24, generator=rng) for _ in range(2))
    target = raft._cell_index(16, 24, torch.device("cpu")) + torch.tensor([1.0, -2.0])[None, :, None, None]
    seen = raft.look_up(raft.correlation_pyramid(here, there), target)
    assert seen.shape == (1, 4 * 81, 16, 24)
    side = 2 * raft.RADIUS + 1
    for across, down in ((0, 0), (3, -1), (-4, 4)):
        row, column = 8, 10
        expected = (
            here[0, :, row, column] * there[0, :, row - 2 + down, column + 1 + across]
        ).sum() / np.sqrt(5)
        channel = (across + raft.RADIUS) * side + down + raft.RADIUS
        torch.testing.assert_close(seen[0, channel, row, column], expected, atol=1e-5, rtol=1e-5)
    mean = there[0, :, 6:8, 12:14].mean((1, 2))  # cell (3, 6) of the second level
    second = raft.look_up(
        raft.correlation_pyramid(here, there),
        torch.full((1, 2, 16, 24), 0.0) + torch.tensor([12.0, 6.0])[None, :, None, None],
    )
    torch.testing.assert_close(
        second[0, side**2 + side**2 // 2, 8, 10],
        (here[0, :, 8, 10] * mean).sum() / np.sqrt(5),
        atol=1e-5,
        rtol=1e-5,
    )


def test_upsampling_preserves_constant_flow():
    flow = torch.tensor([1.5, -0.5])[None, :, None, None].expand(1, 2, 4, 5)
    mask = torch.full((1, 576, 4, 5), -30.0).view(1, 9, 64, 4, 5)
    mask[:, 4] = 30
    whole = raft.upsampled(flow, mask.view(1, 576, 4, 5))
    assert whole.shape == (1, 2, 32, 40)
    torch.testing.assert_close(whole[0, :, 7, 9], torch.tensor([12.0, -4.0]))


def test_pictures_of_any_size_are_padded(network):
    rng = np.random.default_rng(0)
    first, second = rng.integers(0, 255, (2, 66, 75, 3), dtype=np.uint8)
    flow = raft.flow_between(network, first, second, 1)
    padded = [np.pad(image, ((3, 3), (2, 3), (0, 0)), mode="edge") for image in (first, second)]
    assert flow.shape == (66, 75, 2)
    np.testing.assert_allclose(flow, raft.flow_between(network, *padded, 1)[3:69, 2:77], atol=1e-4)
    guessed = raft.flow_between(network, first, second, 1, np.full((66, 75, 2), 8.0, np.float32))
    assert np.abs(guessed - flow).max() > 1
