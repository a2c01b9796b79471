"""Measure masks, flow, registration, localizer and reconstruction, beside simple baselines.

Truth is read where it is given (the built-in capture). Elsewhere clicked correspondences (`make annotate`)
stand for it, and a held-out phone is placed by them or by registration; metrics that need more are left out
with the reason. `evaluate` adds behavior to them; its table of the recipe configures both.
"""

from pipeline.workflow import cli
from stages.evaluate.config import Config
from stages.evaluate.reading import BuildFolders
from stages.evaluate.reconstruction_metrics import stage

if __name__ == "__main__":
    cli.main(__doc__, stage.run, BuildFolders, Config)
