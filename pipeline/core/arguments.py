"""Check numbers that a program passes to the Python API."""

from typing import Any

import numpy as np
from jaxtyping import Float

from pipeline.core.errors import InputError


def checked_numbers(
    given: Any, shape: tuple[int, ...], *, name: str, remedy: str
) -> Float[np.ndarray, "*batch number"]:
    """Return a new array of what a caller gave. Raises SIM-012 unless it is finite and of this shape."""
    try:
        numbers, received = np.array(given, float), ""
    except (TypeError, ValueError) as error:
        numbers, received = np.empty(0), str(error)
    if numbers.shape != shape or not np.isfinite(numbers).all():
        received = received or (str(numbers.tolist()) if numbers.shape == shape else f"shape {numbers.shape}")
        what = f"{name} are no {' x '.join(map(str, shape))} finite numbers: {received}"
        raise InputError("SIM-012", what, "step", remedy)
    return numbers
