"""Settings of these metrics, in one table with those of behavior."""

from stages.evaluate.config import Config

__all__ = ["Config"]
