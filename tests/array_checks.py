"""Run-time checks of the shapes and kinds of arrays in signatures, for what tests call in their own process.

`install` has every module below the given folders checked by jaxtyping and beartype as it is imported: each
call, and each dataclass that is made, must have the arrays that its signature says. All else in a signature
is the type checker's. Modules that numba compiles are left out: it compiles what it is given.
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
    """Check the arrays of every module below these folders of the checkout, from its first import on."""
    jaxtyping.install_import_hook(sorted(_modules(folders)), f"{__name__}.arrays_only")


def arrays_only(function: Callable) -> Callable:
    """Return a checked copy of a signature, as jaxtyping made it, with the hints alone that name arrays."""
    hints = function.__annotations__
    function.__annotations__ = {name: hint for name, hint in hints.items() if _names_array(hint)}
    return _check(function) if function.__annotations__ else function


def _names_array(hint: object) -> bool:
    if isinstance(hint, type) and issubclass(hint, jaxtyping.AbstractArray):
        if hint.array_type is np.ndarray:
            hint.array_type = (np.ndarray, np.generic)  # NumPy returns its scalars where no axis is left
        return True
    return any([_names_array(inner) for inner in typing.get_args(hint)])  # all are prepared


def _modules(folders: Iterable[str]) -> Iterator[str]:
    for folder in folders:
        for path in (ROOT / folder).rglob("*.py"):
            if path.name != "__init__.py" and "njit" not in path.read_text():
                yield ".".join(path.relative_to(ROOT).with_suffix("").parts)
