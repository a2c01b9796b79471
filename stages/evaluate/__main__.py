"""Measure a build: registration, localizer, masks, flow, reconstruction and behaviour, beside simple rivals.

Truth is read where it is given (the built-in capture). Elsewhere clicked correspondences (`make annotate`)
stand for it, and a held-out phone is placed by them or by registration; metrics that need more are left out
with the reason.
"""

from pipeline.workflow import cli
from stages.evaluate import stage
from stages.evaluate.config import Config

if __name__ == "__main__":
    cli.main(__doc__, stage.run, stage.Inputs, Config)
