"""Strict parsing of configuration, with errors that name the known keys."""

import functools
from dataclasses import dataclass, field
from typing import Literal

import pytest

from pipeline.core import config
from pipeline.core.errors import InputError

HUGE = int("9" * 400)
DEEPLY_NESTED = functools.reduce(lambda inner, _: {"a": inner}, range(5000), {})
"""The table of a TOML key with 5,000 parts."""


@dataclass(frozen=True)
class Inner:
    width_m: float = 1.0
    batch: int = 16
    epochs: float = 20.0


@dataclass(frozen=True)
class Outer:
    seed: int = 0
    steps: int = 3
    kind: Literal["a", "b"] = "a"
    sizes: tuple[int, ...] = (1, 2)
    name: str | None = None
    inner: Inner = field(default_factory=Inner)
    side_px: int = 640


def test_table_is_converted_to_a_dataclass():
    made = config.from_table(
        Outer, {"steps": 5, "sizes": [3], "inner": {"width_m": 2}, "name": "x"}, where="recipe"
    )
    assert made == Outer(0, 5, "a", (3,), "x", Inner(2.0))
    assert isinstance(made.inner.width_m, float)


@pytest.mark.parametrize(
    ("table", "code"),
    [
        ({"step": 5}, "REC-001"),
        ({"inner": {"width": 1.0}}, "REC-001"),
        ({"steps": "5"}, "REC-002"),
        ({"steps": 5.0}, "REC-002"),
        ({"steps": True}, "REC-002"),
        ({"steps": -1}, "REC-002"),
        ({"seed": -1}, "REC-002"),
        ({"side_px": 0}, "REC-002"),
        ({"inner": {"batch": 0}}, "REC-002"),
        ({"inner": {"epochs": 0.0}}, "REC-002"),
        ({"kind": "c"}, "REC-002"),
        ({"sizes": 3}, "REC-002"),
        ({"name": 3}, "REC-002"),
        ({"inner": 3}, "REC-002"),
        ({"seed": HUGE}, "REC-002"),
        ({"inner": {"width_m": HUGE}}, "REC-002"),
        ({"sizes": [HUGE]}, "REC-002"),
        ({"name": HUGE}, "REC-002"),
        ({"name": DEEPLY_NESTED}, "REC-002"),
        ({"seed": DEEPLY_NESTED}, "REC-002"),
        ({"inner": DEEPLY_NESTED}, "REC-001"),
    ],
)
def test_wrong_values_are_refused(table, code):
    with pytest.raises(InputError) as caught:
        config.from_table(Outer, table, where="recipe")
    assert caught.value.code == code
    assert len(str(caught.value)) < 500


def test_file_with_byte_order_mark_is_read(tmp_path):
    (tmp_path / "luna.toml").write_text("steps = 5\n", "utf-8-sig")
    assert config.read_table(tmp_path / "luna.toml") == {"steps": 5}


def test_error_of_an_unknown_key_lists_the_known_ones():
    with pytest.raises(InputError, match="steps"):
        config.from_table(Outer, {"step": 5}, where="recipe")


@pytest.mark.parametrize(
    "text", ["[", "a = ", '"\x00', "seed = " + "[" * 5000 + "]" * 5000, "seed = " + "9" * 5000]
)
def test_invalid_file_is_named(tmp_path, text):
    path = tmp_path / "recipe.toml"
    path.write_text(text)
    with pytest.raises(InputError, match="REC-003.*recipe.toml"):
        config.read_table(path)
