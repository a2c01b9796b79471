"""Train a localizer from rendered random views of a template.

target = "scene": the room's template and frames of the walk-through; target = "agent": the canonical animal
from all sides. Views are augmented with changing light, blur, noise and occluders; held-out views measure the
error and calibrate the uncertainty. Patches use the same descriptor as all features. Writes
localizer.safetensors and localizer.json.
"""

from pipeline.workflow import cli
from stages.train_localizer import stage
from stages.train_localizer.config import Config

if __name__ == "__main__":
    cli.main(__doc__, stage.run, stage.Inputs, Config)
