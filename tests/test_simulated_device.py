"""The simulated device refuses what CUDA refuses, and nothing else."""

import numpy as np
import pytest
import torch

from tests.simulated_device import DEVICE, MixedDevicesError, is_on_device, simulated_device

MISTAKES = {
    "forgotten .to": lambda there: there + torch.ones(3),
    "constant on the CPU": lambda there: torch.where(there > 0, there, torch.zeros(3)),
    "index of the CPU": lambda there: there[torch.tensor([0])],
    "index of the device": lambda there: torch.ones(3)[there.long()],
    "array of a device's tensor": lambda there: there.numpy(),
    "numpy function": lambda there: np.asarray(there),
    "generator of the CPU": lambda there: torch.rand(3, generator=torch.Generator(), device=there.device),
    "joined with the CPU's": lambda there: torch.cat([there, torch.ones(3)]),
    "assigned from the CPU": lambda there: there.__setitem__(slice(2), torch.ones(2)),
    "layer left on the CPU": lambda there: torch.nn.Linear(3, 1)(there),
}


@pytest.mark.parametrize("mistake", MISTAKES.values(), ids=MISTAKES.keys())
def test_mistakes_fail(mistake):
    with simulated_device(), pytest.raises(MixedDevicesError):
        mistake(torch.ones(3).to(DEVICE))


def test_what_cuda_does_passes():
    with simulated_device():
        layer = torch.nn.Linear(3, 2).to(DEVICE)
        there = torch.arange(3, device=layer.weight.device).float()
        assert there.device.type == DEVICE and is_on_device(there[there > 0])
        loss = (layer(there) * torch.tensor(2.0)).square().sum()
        loss.backward()
        optimizer = torch.optim.AdamW(layer.parameters(), lr=0.1)
        before = layer.weight.detach().cpu().numpy().copy()
        optimizer.step()
        assert is_on_device(layer.weight.grad) and (layer.weight.detach().cpu().numpy() != before).any()
        assert torch.ones(3).to(there).device == there.device and not is_on_device(there.cpu())
        assert is_on_device(torch.nn.Parameter(there.clone())) and there.sum().item() == 3
