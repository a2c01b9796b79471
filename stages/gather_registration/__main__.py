"""Gather the poses of all sessions, and summarize which were registered or rejected, and why."""

from pipeline.workflow import cli
from stages.gather_registration import stage
from stages.gather_registration.config import Config

if __name__ == "__main__":
    cli.main(__doc__, stage.run, stage.Inputs, Config)
