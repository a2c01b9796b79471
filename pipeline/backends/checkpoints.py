"""Checkpoints of foundation models: folders of `save_pretrained`, read with the optional `transformers`.

Nothing is downloaded: a missing library or checkpoint is an error that says where to get it. Pictures are
prepared here, without torchvision, as the checkpoint's own `preprocessor_config.json` says.
"""

import json
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8
from PIL import Image

from pipeline.core.errors import InputError

CONFIG = "config.json"
PREPARATION = "preprocessor_config.json"
LONGEST_REASON = 200
"""letters of a library's message that are passed on: some list every weight"""
MEAN, STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
"""ImageNet's, where a checkpoint has none"""


def library() -> ModuleType:
    """Return the `transformers` package. Raises MOD-002 where the extra is not installed."""
    try:
        import transformers
    except ImportError as error:
        what = "this backend needs the package transformers"
        raise InputError("MOD-002", what, str(error), "make extras") from error
    return transformers


def folder(path: str, what: str, name: str) -> Path:
    """Return a checkpoint's folder. Raises MOD-001 with the name of a public one where there is none."""
    fetch = f"hf download {name} --local-dir weights/{name.split('/')[-1]}"
    remedy = f"download {name} (`{fetch}`) and name its folder in the recipe"
    if not path or not (Path(path) / CONFIG).is_file():
        where = str(Path(path or ".") / CONFIG)
        raise InputError("MOD-001", f"the weights of {what} are not there", where, remedy)
    return Path(path)


def model(kind: str, path: Path, device: str) -> Any:
    """Load a model of the class `kind` for inference. Raises MOD-003 where the folder holds another one."""
    try:
        loaded = getattr(library(), kind).from_pretrained(path, local_files_only=True)
    except (OSError, ValueError, RuntimeError, KeyError) as error:
        what = f"no usable {kind} ({str(error)[:LONGEST_REASON]})"
        raise InputError("MOD-003", what, str(path), "download the checkpoint again") from error
    return loaded.to(device).eval()


@dataclass(frozen=True)
class Preparation:
    """How a checkpoint wants its pictures."""

    mean: tuple[float, float, float] = MEAN
    std: tuple[float, float, float] = STD
    resample: int = Image.Resampling.BICUBIC
    size: Any = None
    """as in the checkpoint"""

    @classmethod
    def read(cls, path: Path, resample: int) -> "Preparation":
        """Read a checkpoint's own; ``resample`` is the method of its family where it has none."""
        file = path / PREPARATION
        table = json.loads(file.read_text()) if file.is_file() else {}
        table = table.get("image_processor", table)
        (m0, m1, m2), (s0, s1, s2) = table.get("image_mean") or MEAN, table.get("image_std") or STD
        resample = int(table.get("resample") or resample)
        return cls((m0, m1, m2), (s0, s1, s2), resample, table.get("size"))

    def pixels(
        self, color: UInt8[np.ndarray, "height width 3"], size: tuple[int, int]
    ) -> Float[np.ndarray, "1 3 resized_height resized_width"]:
        """Resize to (height, width), scale to 0..1 and normalize."""
        image = Image.fromarray(color)
        height, width = size
        if color.shape[:2] != size:
            image = image.resize((width, height), self.resample)
        mean, std = np.array(self.mean, np.float32), np.array(self.std, np.float32)
        scaled = (np.asarray(image, np.float32) / 255 - mean) / std
        return np.ascontiguousarray(scaled.transpose(2, 0, 1)[None])
