"""Where to compute: the CPU or a CUDA device."""

import importlib.util
import re
import sys
from pathlib import Path
from typing import Literal

from pipeline.core.errors import InputError

Device = Literal["cpu", "cuda"]


def choose(requested: Literal["auto", "cpu", "cuda"] | str) -> Device:
    """Return the device to compute on; `auto` takes CUDA where torch can use it.

    Raises `InputError` DEP-002 where CUDA is requested and cannot be used.
    """
    if requested == "cpu":
        return "cpu"
    if "torch" in sys.modules or _built_with_cuda():
        import torch  # late: it costs seconds, and many stages need none

        if torch.cuda.is_available():
            return "cuda"
    if requested == "cuda":
        what, remedy = "there is no CUDA device that torch can use", "give --device cpu, or see make doctor"
        raise InputError("DEP-002", what, "--device cuda", remedy)
    return "cpu"


def _built_with_cuda() -> bool:
    """Read from torch's version file, without importing torch, whether it was built for CUDA or ROCm."""
    found = importlib.util.find_spec("torch")
    if found is None or not found.submodule_search_locations:
        return False
    version = Path(found.submodule_search_locations[0], "version.py")
    return bool(re.search(r"^(cuda|hip)\b[^=]*= '", version.read_text(), re.MULTILINE))
