"""Where to compute: the CPU or a CUDA device."""

import importlib.util
import re
import sys
from pathlib import Path
from typing import Literal

from pipeline.core.errors import InputError

Device = Literal["cpu", "cuda"]


def choose(requested: Literal["auto", "cpu", "cuda"] | str) -> Device:
    """Return the device to compute on; `auto`: CUDA if torch can use it. Raises DEP-002 without CUDA."""
    if requested == "cpu":
        return "cpu"
    if "torch" in sys.modules or _built_with_cuda():
        import torch  # imported late: it takes seconds, and many stages do not need it

        if torch.cuda.is_available():
            return "cuda"
    if requested == "cuda":
        what, remedy = "there is no CUDA device that torch can use", "give --device cpu, or see make doctor"
        raise InputError("DEP-002", what, "--device cuda", remedy)
    return "cpu"


def _built_with_cuda() -> bool:
    """Return whether torch was built for CUDA or ROCm, from its version file, without importing it."""
    found = importlib.util.find_spec("torch")
    if found is None or not found.submodule_search_locations:
        return False
    version = Path(found.submodule_search_locations[0], "version.py")
    return bool(re.search(r"^(cuda|hip)\b[^=]*= '", version.read_text(), re.MULTILINE))
