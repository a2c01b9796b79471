"""Settings of the environments. Standard library only."""

from dataclasses import dataclass
from typing import Literal

from pipeline.behavior.config import PlanSamplingConfig, ReplanningConfig

Embodiment = Literal["person", "robot"]
"""A person steps forward, sideways and turns; a robot on wheels drives forward and turns."""
RewardName = Literal["approach", "follow", "calm", "none"]
"""See `pipeline.environments.rewards`."""
Seen = Literal["animal", "velocity", "occupancy", "rgbd"]
"""What can be observed, see `pipeline.environments.spaces`."""


@dataclass(frozen=True)
class EnvironmentConfig:
    """What acts, what it is rewarded for, and how the animal plans."""

    animal: str | None = None
    """Of a home of several, the animal that observation, reward and end refer to; by default the first."""
    embodiment: Embodiment = "person"
    """What acts."""
    reward: RewardName = "approach"
    """What is rewarded."""
    observations: tuple[Seen, ...] = ("animal", "velocity", "occupancy")
    """What is observed; `rgbd` needs the artifact `reconstruction` of every home."""
    episode_s: float = 20.0
    """Length of an episode, seconds."""
    speed_m_s: float = 1.2
    """Highest walking or driving speed, m/s."""
    turn_rad_s: float = 2.0
    """Highest turning speed, rad/s."""
    start_m: tuple[float, float] = (1.5, 3.5)
    """Nearest and furthest distance from the animal at which an episode begins, meters."""
    sequence_steps: int = 6
    """Denoising steps of the animal's paths and bodies; 10 for the full sampler."""
    guidance: float = PlanSamplingConfig.guidance
    """Scale of classifier-free guidance: the interactivity."""
    candidates: int = 2
    """Plans drawn at most where the first one is blocked."""

    @property
    def sampling(self) -> PlanSamplingConfig:
        """How plans are sampled: goals by the model's own sampler, since fewer steps blur them and cost as
        much; paths and bodies, which take most of the time, in few steps.
        """
        return PlanSamplingConfig(None, 0, self.sequence_steps, self.guidance, max_path_draws=1)

    @property
    def chaining(self) -> ReplanningConfig:
        """When animals plan anew, and of how many candidates."""
        return ReplanningConfig(candidates=self.candidates)
