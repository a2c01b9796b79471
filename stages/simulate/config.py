"""Settings of a take."""

from dataclasses import dataclass
from typing import Literal

ObserverScript = Literal["away", "still", "approach"]
"""What a scripted observer does."""
SubgoalSource = Literal["none", "visited", "behavior"]
"""Where sub-goals come from that no file gives."""


@dataclass(frozen=True)
class Config:
    """What is simulated, for how long, and how plans are drawn."""

    seconds: float = 30.0
    """Length of a take of the behavior model."""
    observer: ObserverScript = "approach"
    """What the observer does."""
    observer_speed_m_s: float = 1.0
    """Walking speed of the observer, m/s."""
    guidance: tuple[str, ...] = ()
    """Scales of classifier-free guidance, the interactivity, by who is perceived: `person=1.5` for the
    observer, `dog=1.5` for an animal of the home; 1.25 and 1 by default."""
    goal_steps: int = 0
    """Denoising steps of the goal; 0: as the model is best sampled."""
    sequence_steps: int = 0
    """Denoising steps of paths and bodies; 0: as the model is best sampled."""
    places: SubgoalSource = "none"
    """Sub-goals that no file gives: sampled from where the animal has been, or the behavior model's goals
    one after the other; none: a take of the behavior model."""
    place_count: int = 20
    """How many of them."""
    optimize: bool = True
    """Make the motion physically plausible; a take of the behavior model only where `--longterm` and
    `--reconstruction` are given."""
    pictures_per_s: float = 10.0
    """Pictures per second of long-term motion; 0: none."""
    absent: tuple[str, ...] = ()
    """Animals of the home that are left out, with `--animals`."""
    replayed: tuple[str, ...] = ()
    """Animals in whose place a recorded clip of them is played, with `--animals`."""
    seed: int = 0
    """Seed of the beginning and of all noise."""
    serve: bool = False
    """Show the animal live, on this machine alone, until interrupted; needs `--simulator` and viser (`make
    extras`)."""
    port: int = 8080
    """Where it is shown."""
