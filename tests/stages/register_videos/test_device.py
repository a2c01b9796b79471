"""A session is localized on a simulated second device: the room by its pictures, the animal by its crops."""

import numpy as np
import trimesh

from pipeline.data.clips import Clip
from pipeline.geometry.contact import StandingSurface
from pipeline.geometry.meshes import Mesh, RayCaster
from pipeline.localization import localizer as localizers
from stages.register_videos import agent_roots, registration
from stages.register_videos.config import Config, RootConfig, VoteConfig
from tests.simulated_device import DEVICE, is_on_device, simulated_device
from tests.stages import room_with_animal, untrained_localizer

FRAMES = 3


class _Masks(list):
    visible = np.ones(FRAMES, bool)


def _colored(body: trimesh.Trimesh) -> Mesh:
    color = np.full((len(body.vertices), 3), 128, np.uint8)
    return Mesh(np.asarray(body.vertices, np.float32), np.asarray(body.faces, np.int32), color)


def test_sessions_are_localized_on_another_device(tmp_path):
    cameras, agents = (poses[:FRAMES] for poses in room_with_animal.session())
    truth = room_with_animal.record(tmp_path / "frames", cameras, agents, cameras)
    clip, masks = Clip.open(tmp_path / "frames"), _Masks(255 * truth.masks.astype(np.uint8))
    scene, agent = _colored(room_with_animal.room()), _colored(room_with_animal.animal())
    folders = [untrained_localizer.write(tmp_path / name, name) for name in ("scene", "agent")]
    config = Config(vote=VoteConfig(every_frames=1), root=RootConfig(headings=2))
    with simulated_device():
        localizer, agent_localizer = (localizers.load(folder, DEVICE) for folder in folders)
        assert all(map(is_on_device, (*localizer.model.parameters(), *agent_localizer.model.buffers())))
        maps = registration.Maps(scene, 0.0, agent, localizer, agent_localizer)
        found = registration.register(clip, masks, maps, config, np.random.default_rng(0))
        standing = StandingSurface(RayCaster(scene), 0.0)
        roots = agent_roots.find_roots(
            clip, masks, agent, standing, agent_localizer, cameras, config.root, np.random.default_rng(0)
        )
    assert found.votes.queries == len(found.votes.frame) == FRAMES
    assert np.isfinite(found.votes.world_from_camera).all() and roots.visible.all()
