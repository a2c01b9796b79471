"""Settings of these metrics, in one table with those of behaviour."""

from stages.evaluate.config import Config

__all__ = ["Config"]
