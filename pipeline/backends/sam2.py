"""SAM 2 (Ravi et al. 2024) for videos of any length, with the optional `transformers`.

Frames are handed over one at a time, and whatever lies further back than the network looks is dropped, so
that memory does not grow with the video. The result is that of `Sam2VideoModel` on the whole video.
"""

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Float, UInt8
from PIL import Image

from pipeline.backends import checkpoints

CHECKPOINT = "facebook/sam2.1-hiera-small"
OBJECT = 1
Picture = UInt8[np.ndarray, "height width 3"]


class Sam2:
    """A loaded tracker of one thing."""

    def __init__(self, weights: str, device: str) -> None:
        """Load a checkpoint folder. Raises MOD-001, MOD-002 and MOD-003 as `checkpoints` does."""
        path = checkpoints.folder(weights, "SAM 2", CHECKPOINT)
        self._model = checkpoints.model("Sam2VideoModel", path, device)
        self._preparation = checkpoints.Preparation.read(path, Image.Resampling.BILINEAR)
        self._device = device
        side = self._model.config.image_size
        self._side = side if isinstance(side, int) else side[0]

    @torch.inference_mode()
    def track(
        self, color: Callable[[int], Picture], frames: range, box_px: Float[np.ndarray, "4"]
    ) -> Iterator[tuple[Float[np.ndarray, "height width"], float]]:
        """Follow what the box (x0, y0, x1, y1, pixels) shows in the first of ``frames``, in their order.

        Yields (log-odds per pixel, log-odds that it is in view) per frame.
        """
        session = self._session()
        for position, frame in enumerate(frames):
            picture = color(frame)
            if position == 0:
                self._point_at(session, frame, box_px, picture.shape[:2])
            pixels, reverse = self.prepared(picture), position > 0 and frames.step < 0
            answer = self._model(inference_session=session, frame=pixels, frame_idx=frame, reverse=reverse)
            # to the picture's size, by way of the network's
            masks = answer.pred_masks.reshape(1, 1, *answer.pred_masks.shape[-2:]).float()
            for size in ((self._side, self._side), picture.shape[:2]):
                masks = F.interpolate(masks, size, mode="bilinear", align_corners=False)
            yield masks[0, 0].cpu().numpy(), float(answer.object_score_logits.reshape(-1)[0])
            self._forget(session, frame, frames.step)

    def prepared(self, picture: Picture) -> Float[torch.Tensor, "1 3 side side"]:
        """Resize with antialiasing as bytes, scale and normalize, as the checkpoint's own processor does."""
        image = torch.from_numpy(np.ascontiguousarray(picture.transpose(2, 0, 1)))[None]
        size = self._side, self._side
        image = F.interpolate(image, size, mode="bilinear", antialias=True, align_corners=False)
        prepared = self._preparation.mean, self._preparation.std
        mean, std = (torch.tensor(values).view(1, 3, 1, 1) for values in prepared)
        return ((image.float() - 255 * mean) / (255 * std)).to(self._device)

    def _session(self) -> Any:
        from transformers.models.sam2_video.modeling_sam2_video import Sam2VideoInferenceSession

        return Sam2VideoInferenceSession(
            inference_device=self._device, inference_state_device=self._device, dtype=torch.float32
        )

    def _point_at(
        self, session: Any, frame: int, box_px: Float[np.ndarray, "4"], size: tuple[int, int]
    ) -> None:
        """Put the box in as its two corners, in the network's pixels."""
        session.video_height, session.video_width = size
        scale = torch.tensor([self._side / size[1], self._side / size[0]])
        corners = torch.as_tensor(np.asarray(box_px, np.float32)).reshape(1, 1, 2, 2) * scale
        labels = torch.tensor([2, 3], dtype=torch.int32).reshape(1, 1, 2)
        prompt = {"point_coords": corners, "point_labels": labels}
        session.add_point_inputs(session.obj_id_to_idx(OBJECT), frame, prompt)
        session.obj_with_new_inputs = [OBJECT]

    def _forget(self, session: Any, frame: int, step: int) -> None:
        """Drop what no later frame looks back to."""
        reach = max(self._model.config.num_maskmem, self._model.config.max_object_pointers_in_encoder)
        session.processed_frames.pop(frame, None)
        for outputs in session.output_dict_per_obj.values():
            memory = outputs["non_cond_frame_outputs"]
            memory.pop(frame - step * reach, None)
            for output in memory.values():
                output.pop("high_res_masks", None)
        for tracked in session.frames_tracked_per_obj.values():
            tracked.pop(frame - step * reach, None)
