"""Run the behaviour model without a page: let the animal live beside a scripted observer and write the take.

Writes `take.npz` and `take.csv`. In Python: `Simulator.reset(seed)` and `Simulator.step(observer)` of
`stages.simulate.simulator`, ten steps a second.
"""

from dataclasses import dataclass, field

import numpy as np

from pipeline import cli, progress
from pipeline.files import arrays
from pipeline.models import behavior
from pipeline.models.perception import FeatureVolume
from pipeline.models.planning import Sampler, TorchNetworks
from pipeline.models.trajectories import BehaviorData
from stages.simulate.observers import Script, scripted
from stages.simulate.rollout import rollout, write_take
from stages.simulate.simulator import Chaining, Simulator


@dataclass(frozen=True)
class Config:
    """Settings of a rollout."""

    seconds: float = 30.0
    """Length of the take."""
    observer: Script = "approach"
    """What the observer does."""
    observer_speed_m_s: float = 1.0
    """How fast the observer walks."""
    chaining: Chaining = field(default_factory=Chaining)
    """How plans follow each other."""
    sampling: behavior.Sampling = field(default_factory=behavior.Sampling)
    """How plans are drawn; `guidance` is the interactivity."""
    seed: int = 0
    """Seed of the beginning and of all noise."""


def run(task: cli.Task) -> None:
    """Roll out one take."""
    c: Config = task.config
    model, source = task.input("behavior"), task.input("behavior_data")
    architecture, nets, scaling, schedule, _ = behavior.load(model)
    data, volume = BehaviorData.load(source), FeatureVolume.load(source / "volume.npz")
    allowed = arrays.load(source / "volume.npz", ("allowed",))["allowed"]
    sampler = Sampler(TorchNetworks(nets, task.device), schedule, scaling)
    simulator = Simulator(sampler, data, volume, allowed, architecture.ego, sampling=c.sampling, chaining=c.chaining)
    seen = np.concatenate([t.world_from_camera[t.valid, :3, 3] for t in data.trajectories.values()])
    observer = scripted(c.observer, center=np.median(seen, axis=0), speed_m_s=c.observer_speed_m_s)
    take = rollout(simulator, observer, seconds=c.seconds, seed=c.seed)
    progress.log(f"{c.seconds:g} s, {float(take.blocked.mean()):.1%} of the plans' frames outside the allowed space")
    with task.create() as folder:
        write_take(folder, take)


if __name__ == "__main__":
    cli.enter(__doc__, run, config=Config, reads=("behavior", "behavior_data"))
