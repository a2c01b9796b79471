"""Run the behavior model without a page, or let the animal travel through sub-goals; write the take.

With `--behavior`: beside a scripted observer; writes `take.npz` and `take.csv`. In Python:
`Simulator.reset(seed)` and `Simulator.step(observer)` of `pipeline.behavior.simulator`. With `--animals`: all
animals of a home together, each with a take in a folder of its name, and `from_above.jpg`; with `--home`, in
the home of another build. `--guidance person=1.5 dog=2`: how strongly they react to whom. With `--serve`:
live in a browser, computed here; kept too. With `--longterm` and `--subgoals FILE` (see
`stages.simulate.subgoal_file`) or `--places`: writes `take.npz` at 30 fps, `take.glb`, `take.json` and
`frames/`. All in the space of `--behavior-data`.
"""

from pipeline.workflow import cli
from stages.simulate import stage
from stages.simulate.config import Config
from stages.simulate.inputs import Inputs

if __name__ == "__main__":
    options = ("serve", "port", "seed", "seconds", "places", "absent", "replayed", "guidance")
    cli.main(__doc__, stage.run, Inputs, Config, options=options)
