"""The simulated device refuses what CUDA refuses, and nothing else."""

import numpy as np
import pytest
import torch

from tests.simulated_device import DEVICE, MixedDevicesError, is_on_device, simulated_device

MISTAKES = {
    "forgotten .to": lambda on_device: on_device + torch.ones(3),
    "constant on the CPU": lambda on_device: torch.where(on_device > 0, on_device, torch.zeros(3)),
    "index on the CPU": lambda on_device: on_device[torch.tensor([0])],
    "index on the device": lambda on_device: torch.ones(3)[on_device.long()],
    "array of a tensor on the device": lambda on_device: on_device.numpy(),
    "numpy function": lambda on_device: np.asarray(on_device),
    "generator on the CPU": lambda on_device: torch.rand(
        3, generator=torch.Generator(), device=on_device.device
    ),
    "concatenated with a CPU tensor": lambda on_device: torch.cat([on_device, torch.ones(3)]),
    "assigned from the CPU": lambda on_device: on_device.__setitem__(slice(2), torch.ones(2)),
    "layer left on the CPU": lambda on_device: torch.nn.Linear(3, 1)(on_device),
}


@pytest.mark.parametrize("mistake", MISTAKES.values(), ids=MISTAKES.keys())
def test_mixed_devices_are_refused(mistake):
    with simulated_device(), pytest.raises(MixedDevicesError):
        mistake(torch.ones(3).to(DEVICE))


def test_operations_valid_on_cuda_pass():
    with simulated_device():
        layer = torch.nn.Linear(3, 2).to(DEVICE)
        on_device = torch.arange(3, device=layer.weight.device).float()
        assert on_device.device.type == DEVICE and is_on_device(on_device[on_device > 0])
        loss = (layer(on_device) * torch.tensor(2.0)).square().sum()
        loss.backward()
        optimizer = torch.optim.AdamW(layer.parameters(), lr=0.1)
        before = layer.weight.detach().cpu().numpy().copy()
        optimizer.step()
        assert is_on_device(layer.weight.grad) and (layer.weight.detach().cpu().numpy() != before).any()
        assert torch.ones(3).to(on_device).device == on_device.device and not is_on_device(on_device.cpu())
        assert is_on_device(torch.nn.Parameter(on_device.clone())) and on_device.sum().item() == 3
