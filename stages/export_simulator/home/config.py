"""Settings of the page of a home of several animals."""

from dataclasses import dataclass

from stages.export_simulator import config


@dataclass(frozen=True)
class Config(config.Config):
    """Those of one animal's page, and who lives there."""

    others: tuple[str, ...] = ()
    """Names of the home's animals; the planner sets it."""
