"""SAM 2 frame by frame with bounded memory agrees with transformers on the whole video."""

import numpy as np
import pytest
import torch
import torch.nn.functional as F

from tests.pipeline.backends import small_checkpoints

FRAMES, SIZE, SIDE = 14, (48, 64), small_checkpoints.SIDE
BOX = np.array([10.0, 12, 40, 40])


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory):
    return small_checkpoints.sam2(tmp_path_factory.mktemp("sam2"))


def video() -> np.ndarray:
    rng = np.random.default_rng(0)
    room = rng.integers(0, 255, (*SIZE, 3), dtype=np.uint8)
    frames = np.repeat(room[None], FRAMES, axis=0)
    for i in range(FRAMES):
        frames[i, 15:35, 12 + i : 32 + i] = [200, 120, 40]
    return frames


def whole_video(checkpoint, frames: np.ndarray, order: list[int]) -> list[torch.Tensor]:
    """Masks by transformers on the whole video with unbounded memory."""
    import transformers
    from transformers.models.sam2_video.modeling_sam2_video import Sam2VideoInferenceSession

    model = transformers.Sam2VideoModel.from_pretrained(checkpoint).eval()
    mean, std = (
        torch.tensor(values).view(1, 3, 1, 1) for values in ((0.485, 0.456, 0.406), (0.229, 0.224, 0.225))
    )
    pictures = torch.from_numpy(frames.transpose(0, 3, 1, 2).copy())
    pictures = F.interpolate(pictures, (SIDE, SIDE), mode="bilinear", antialias=True).float() / 255
    session = Sam2VideoInferenceSession(
        video=(pictures - mean) / std, video_height=SIZE[0], video_width=SIZE[1], dtype=torch.float32
    )
    points = torch.tensor(BOX, dtype=torch.float32).reshape(1, 1, 2, 2) * torch.tensor(
        [SIDE / SIZE[1], SIDE / SIZE[0]]
    )
    session.add_point_inputs(
        session.obj_id_to_idx(1), order[0], {"point_coords": points, "point_labels": torch.tensor([[[2, 3]]])}
    )
    session.obj_with_new_inputs = [1]
    with torch.no_grad():
        return [model(session, frame_idx=i, reverse=order[-1] < order[0]).pred_masks for i in order]


@pytest.mark.parametrize("order", [range(FRAMES), range(FRAMES - 1, -1, -1)], ids=["forwards", "backwards"])
def test_bounded_memory_gives_the_same_masks(checkpoint, order):
    from pipeline.backends.sam2 import Sam2

    frames = video()
    ours = list(Sam2(str(checkpoint), "cpu").track(lambda i: frames[i], order, BOX))
    theirs = whole_video(checkpoint, frames, list(order))
    assert len(ours) == FRAMES
    for (mask, _), expected in zip(ours, theirs, strict=True):
        expected = F.interpolate(
            expected.reshape(1, 1, *expected.shape[-2:]), (SIDE, SIDE), mode="bilinear", align_corners=False
        )
        expected = F.interpolate(expected, SIZE, mode="bilinear", align_corners=False)[0, 0]
        np.testing.assert_allclose(mask, expected.numpy(), atol=1e-4 * float(expected.abs().max()))


def test_memory_is_bounded(checkpoint, monkeypatch):
    from pipeline.backends.sam2 import Sam2

    tracker, sessions = Sam2(str(checkpoint), "cpu"), []
    inner = tracker._session
    monkeypatch.setattr(tracker, "_session", lambda: sessions.append(inner()) or sessions[-1])
    frames, held = video(), []
    for _ in tracker.track(lambda i: frames[i % FRAMES], range(30), BOX):
        outputs = next(iter(sessions[0].output_dict_per_obj.values()))
        held.append(len(sessions[0].processed_frames) + len(outputs["non_cond_frame_outputs"]))
    assert max(held[10:]) == max(held[20:]) <= 6
