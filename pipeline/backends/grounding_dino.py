"""Grounding DINO (Liu et al. 2023): boxes in a picture from words, with the optional `transformers`."""

import numpy as np
import torch
from jaxtyping import Float, UInt8
from PIL import Image

from pipeline.backends import checkpoints

CHECKPOINT = "IDEA-Research/grounding-dino-tiny"
SHORTEST_PX, LONGEST_PX = 800, 1333


class GroundingDino:
    """A loaded detector."""

    def __init__(self, weights: str, device: str) -> None:
        """Load a checkpoint folder. Raises MOD-001, MOD-002 and MOD-003 as `checkpoints` does."""
        path = checkpoints.folder(weights, "Grounding DINO", CHECKPOINT)
        self._model = checkpoints.model("GroundingDinoForObjectDetection", path, device)
        self._tokenizer = checkpoints.library().AutoTokenizer.from_pretrained(path, local_files_only=True)
        self._preparation = checkpoints.Preparation.read(path, Image.Resampling.BILINEAR)
        self._device = device

    @torch.inference_mode()
    def find(
        self, color: UInt8[np.ndarray, "height width 3"], description: str, threshold: float
    ) -> tuple[Float[np.ndarray, "box 4"], Float[np.ndarray, "box"]]:
        """Return boxes (x0, y0, x1, y1, pixels) of what is described and scores (0..1), most certain first.

        Every phrase ends with a full stop (``a cat.``).
        """
        from transformers.image_transforms import get_size_with_aspect_ratio

        (height, width), wanted = color.shape[:2], self._preparation.size or {}
        edges = wanted.get("shortest_edge") or SHORTEST_PX, wanted.get("longest_edge") or LONGEST_PX
        pixels = self._preparation.pixels(color, get_size_with_aspect_ratio((height, width), *edges))
        sentence = description.lower().strip().rstrip(".") + "."
        words = self._tokenizer(sentence, return_tensors="pt").to(self._device)
        answer = self._model(pixel_values=torch.from_numpy(pixels).to(self._device), **words)
        score = answer.logits[0].sigmoid().amax(-1)
        center, size = answer.pred_boxes[0].split(2, dim=-1)
        corners = torch.cat([center - size / 2, center + size / 2], dim=-1)
        boxes = corners * torch.tensor([width, height] * 2, device=center.device)
        order = torch.argsort(score, descending=True, stable=True)
        order = order[score[order] > threshold]
        return boxes[order].cpu().numpy(), score[order].cpu().numpy()
