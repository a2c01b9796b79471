"""The ablation of Table 5: the spatial control is put beside the perception code, in place of a twin UNet."""

import torch
from jaxtyping import Float
from torch import Tensor, nn

from pipeline.behavior.denoisers import EMBEDDING, UncontrolledUNet
from pipeline.behavior.diffusion import STANDARD, Schedule


class ConcatenationUNet(UncontrolledUNet):
    """Denoise a sequence under a control that is one more part of the code; called as `ControlUNet` is."""

    def __init__(
        self,
        channels: int,
        control: int,
        condition: int,
        width: int = 32,
        multipliers: tuple[int, ...] = (1, 2, 4),
        schedule: Schedule = STANDARD,
    ):
        """``control`` counts the numbers of the whole control: 3 of a goal, 8 per frame of what is known of a
        path.
        """
        read = nn.Sequential(
            nn.Linear(condition + control + 1, EMBEDDING), nn.SiLU(), nn.Linear(EMBEDDING, EMBEDDING)
        )
        super().__init__(channels, read, width, multipliers, schedule)
        self.condition = condition

    def forward(
        self,
        x: Float[Tensor, "batch channel frame"],
        t: Float[Tensor, "batch"],
        condition: Float[Tensor, "batch condition"],
        control: Float[Tensor, "batch control"] | Float[Tensor, "batch control frame"],
        keep: Float[Tensor, "batch 1"],
    ) -> Float[Tensor, "batch channel frame"]:
        code = torch.cat([condition[:, -self.condition :], control.flatten(1) * keep, keep], dim=-1)
        return super().forward(x, t, code, control, keep)
