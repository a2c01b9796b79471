"""Make one page for a home of several animals: the room once, each animal with its body and its networks.

Reads `reconstruction`, `splats`, `behavior` and `behavior_data` of each, from the folder of all animals.
Writes `index.html` and `simulator.json`; the animated files stand beside each animal's own page.

    all=build/pair/animals plan=build/pair/plan
    python -m stages.export_simulator.home --reconstruction $all --splats $all --behavior $all \\
        --behavior-data $all --config $plan/configs/home_simulator.json --out build/pair/home_simulator
"""

from pipeline.workflow import cli
from stages.export_simulator.home import stage
from stages.export_simulator.home.config import Config

if __name__ == "__main__":
    cli.main(__doc__, stage.run, stage.Inputs, Config)
