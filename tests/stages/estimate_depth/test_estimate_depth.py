"""Plain videos get cameras and depth from the map: of the room, a walking animal, and a resting animal."""

import numpy as np
import pytest

from pipeline.core.errors import InputError
from pipeline.core.videos import Video
from pipeline.data.clips import Clip, read_source_index
from pipeline.geometry import rigid
from stages.estimate_depth import stage
from stages.estimate_depth.config import Config
from tests.stages import textured_room
from tests.stages.estimate_depth import filmed_room


@pytest.fixture(scope="module")
def mapped(tmp_path_factory):
    folder = tmp_path_factory.mktemp("mapped")
    room, walk = filmed_room.room_and_walk()
    filmed_room.write_walk(folder / "frames/v000", room, walk)
    filmed_room.write_map(folder / "scene_template", room, walk)
    return folder, room


def estimate(mapped, folder, path, agent, role, room=None):
    home, known = mapped
    truth = filmed_room.write_pictures(folder / "pictures", room or known, path, agent)
    inputs = stage.Inputs(folder / "pictures", {"v000": home / "frames/v000"}, home / "scene_template")
    (folder / "out").mkdir()
    stage.run(inputs, Config(), folder / "out", video=Video("v001", "a.mp4", role, "none", None))
    clip, kept = Clip.open(folder / "out"), read_source_index(folder / "out")
    return clip, kept, truth[0][kept], truth[1][kept]


def check_cameras(clip, true):
    deg = np.rad2deg(rigid.rotation_angle(clip.odometry_from_camera[:, :3, :3], true[:, :3, :3]))
    off_m = np.linalg.norm(clip.odometry_from_camera[:, :3, 3] - true[:, :3, 3], axis=1)
    assert np.median(deg) < 1.0 and np.median(off_m) < 0.04
    focal = clip.intrinsics[0, 0, 0] / filmed_room.INTRINSICS[0, 0]
    assert abs(focal - 1) < 0.03, "the lens is calibrated"


@pytest.mark.slow
def test_session_is_registered_and_its_animal_is_on_the_floor(mapped, tmp_path):
    path, agent = filmed_room.session(24)
    clip, kept, depth, masks = estimate(mapped, tmp_path, path, agent, "session")
    assert clip.mapped and clip.gravity_known and len(clip) >= 20
    check_cameras(clip, path[kept])
    off_room, off_animal, covered, overlap = [], [], [], []
    for frame in range(len(clip)):
        found, confidence = clip.depth(frame), clip.confidence(frame)
        room = (confidence == 2) & ~masks[frame]
        off_room.append(np.median(np.abs(found - depth[frame])[room]))
        animal = masks[frame] & (confidence == 1)
        covered.append(animal.sum() / masks[frame].sum())
        in_front = clip.foreground(frame) > 0
        overlap.append((in_front & masks[frame]).sum() / (in_front | masks[frame]).sum())
        if animal.sum() > 20:
            off_animal.append(np.median(np.abs(found - depth[frame])[animal]))
    assert np.median(off_room) < 0.03
    assert np.median(covered) > 0.5 and np.median(overlap) > 0.5, "the animal stands before the room"
    assert len(off_animal) > 0.7 * len(clip) and np.median(off_animal) < 0.1


@pytest.mark.slow
def test_turnaround_has_multi_view_depth(mapped, tmp_path):
    path, agent = filmed_room.circle(28)
    clip, kept, depth, masks = estimate(mapped, tmp_path, path, agent, "turnaround")
    check_cameras(clip, path[kept])
    off, known, overlap = [], [], []
    for frame in range(2, len(clip) - 2):
        found, confidence, in_front = clip.depth(frame), clip.confidence(frame), clip.foreground(frame) > 0
        overlap.append((in_front & masks[frame]).sum() / (in_front | masks[frame]).sum())
        animal = masks[frame] & (confidence > 0)
        known.append(animal.sum() / masks[frame].sum())
        off.append(np.median(np.abs(found - depth[frame])[animal]))
    assert np.median(known) > 0.3
    assert np.median(off) < 0.03
    assert np.median(overlap) > 0.8


@pytest.mark.slow
def test_video_of_another_room_is_refused(mapped, tmp_path):
    path, agent = filmed_room.session(12)
    elsewhere = textured_room.textured_room(seed=7, edge_m=0.03)
    with pytest.raises(InputError, match="MAP-007"):
        estimate(mapped, tmp_path, path, agent, "session", elsewhere)
