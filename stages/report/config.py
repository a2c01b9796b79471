"""Settings of the report."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Config:
    """How the report is written."""

    name: str = "the animal"
    """What it calls the animal."""
    share_safe: bool = False
    """Blur every picture that people or the home can be in, and leave out names of files; drawn pictures, the
    animal alone and metrics stay."""
    times: bool = True
    """Put machine and times into the crate; off where artifacts of two runs must be equal."""
