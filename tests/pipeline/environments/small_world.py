"""An untrained animal in a room of 4 m, in memory and as a build; imports no environment library."""

from pathlib import Path

import numpy as np

from pipeline.behavior.diffusion import Schedule
from pipeline.behavior.model import BehaviorNets
from pipeline.behavior.perception import FeatureVolume
from pipeline.behavior.planning import Sampler, TorchNetworks
from pipeline.behavior.scenes import Scenes
from pipeline.data import npz
from pipeline.environments.config import EnvironmentConfig
from pipeline.environments.homes import Habitat
from pipeline.environments.residents import ALONE, Resident
from pipeline.environments.world import AnimalWorld
from stages.train_behavior.export import write_contract
from tests.pipeline.behavior.wandering import ARCHITECTURE, REST, room, scaling, wandering

QUICK = EnvironmentConfig(sequence_steps=2, candidates=1, start_m=(0.8, 1.5))


def small_world(config=QUICK):
    sampler = Sampler(TorchNetworks(BehaviorNets(ARCHITECTURE)), Schedule(), scaling())
    habitat = Habitat.of_one_home(wandering(), Scenes.of(room()))
    return AnimalWorld({ALONE: Resident(sampler, habitat, "yaw")}, config)


def write_build(build: Path, seed: int = 0, nets: BehaviorNets | None = None) -> Path:
    """Write `behavior_data` with the room, and `behavior` with untrained networks."""
    (build / "behavior_data").mkdir(parents=True)
    write_volume(build / "behavior_data/volume.npz", room())
    write_animal(build, seed, nets)
    return build


def write_animal(build: Path, seed: int = 0, nets: BehaviorNets | None = None) -> None:
    """Write recordings into the `behavior_data` of a build, and `behavior` with untrained networks."""
    wandering(seed).save(build / "behavior_data")
    (build / "behavior").mkdir()
    nets = nets or BehaviorNets(ARCHITECTURE)
    write_contract(build / "behavior", nets, ARCHITECTURE, scaling(), Schedule(), REST)


def write_volume(path: Path, volume: FeatureVolume) -> None:
    """Write a scene whose free space is allowed, without heights of support."""
    allowed = (volume.occupancy == 0).astype(np.uint8)
    npz.save(path, **vars(volume), allowed=allowed, stands_m=np.full((2, 2), np.nan))
