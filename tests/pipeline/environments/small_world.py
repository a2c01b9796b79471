"""An untrained animal in a room of 4 m, for tests of environments; imports no environment library."""

import numpy as np

from pipeline.behavior.diffusion import Schedule
from pipeline.behavior.model import BehaviorNets
from pipeline.behavior.planning import Sampler, TorchNetworks
from pipeline.behavior.scenes import Scenes
from pipeline.environments.config import EnvironmentConfig
from pipeline.environments.homes import Habitat
from pipeline.environments.residents import ALONE, Resident
from pipeline.environments.world import AnimalWorld
from tests.pipeline.behavior.wandering import ARCHITECTURE, room, scaling, wandering

QUICK = EnvironmentConfig(goal_steps=2, sequence_steps=2, candidates=1, start_m=(0.8, 1.5))


def small_world(config=QUICK):
    volume = room()
    sampler = Sampler(TorchNetworks(BehaviorNets(ARCHITECTURE)), Schedule(), scaling())
    scenes = Scenes((volume,), (volume.occupancy == 0,), np.zeros(1, int))
    return AnimalWorld({ALONE: Resident(sampler, Habitat.of_one_home(wandering(), scenes), "yaw")}, config)
