"""Run-time checks of array shapes and dtypes in signatures, for code that tests call in their own process.

`install` checks every module below the given folders with jaxtyping and beartype when it is imported: the arrays
of each call and of each new dataclass must match the annotations. Other annotations are left to the type checker,
and modules with numba functions are skipped.
"""

import typing
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path

import jaxtyping
import numpy as np
from beartype import BeartypeConf, beartype

ROOT = Path(__file__).parent.parent
_check = beartype(conf=BeartypeConf(is_pep484_tower=True))


def install(folders: Iterable[str]) -> None:
    """Check the arrays of every module below these folders of the checkout when it is imported."""
    jaxtyping.install_import_hook(sorted(_modules(folders)), f"{__name__}.arrays_only")


def arrays_only(function: Callable) -> Callable:
    """Check a function against its array annotations alone."""
    hints = function.__annotations__
    function.__annotations__ = {name: hint for name, hint in hints.items() if _names_array(hint)}
    return _check(function) if function.__annotations__ else function


def _names_array(hint: object) -> bool:
    if isinstance(hint, type) and issubclass(hint, jaxtyping.AbstractArray):
        if hint.array_type is np.ndarray:
            hint.array_type = (np.ndarray, np.generic)  # NumPy returns scalars where no axis remains
        return True
    return any([_names_array(inner) for inner in typing.get_args(hint)])  # a list: all must be prepared


def _modules(folders: Iterable[str]) -> Iterator[str]:
    for folder in folders:
        for path in (ROOT / folder).rglob("*.py"):
            if path.name != "__init__.py" and "njit" not in path.read_text():
                yield ".".join(path.relative_to(ROOT).with_suffix("").parts)
