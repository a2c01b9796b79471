"""Configuration is strict, and says what it knows."""

import functools
from dataclasses import dataclass, field
from typing import Literal

import pytest

from pipeline.core import config
from pipeline.core.errors import InputError

HUGE = int("9" * 400)
DEEP = functools.reduce(lambda inner, _: {"a": inner}, range(5000), {})
"""What TOML makes of a key of 5,000 parts."""


@dataclass(frozen=True)
class Inner:
    width_m: float = 1.0


@dataclass(frozen=True)
class Outer:
    seed: int = 0
    steps: int = 3
    kind: Literal["a", "b"] = "a"
    sizes: tuple[int, ...] = (1, 2)
    name: str | None = None
    inner: Inner = field(default_factory=Inner)
    side_px: int = 640


def test_a_table_becomes_a_dataclass():
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
        ({"kind": "c"}, "REC-002"),
        ({"sizes": 3}, "REC-002"),
        ({"name": 3}, "REC-002"),
        ({"inner": 3}, "REC-002"),
        ({"seed": HUGE}, "REC-002"),
        ({"inner": {"width_m": HUGE}}, "REC-002"),
        ({"sizes": [HUGE]}, "REC-002"),
        ({"name": HUGE}, "REC-002"),
        ({"name": DEEP}, "REC-002"),
        ({"seed": DEEP}, "REC-002"),
        ({"inner": DEEP}, "REC-001"),
    ],
)
def test_what_does_not_fit_is_refused(table, code):
    with pytest.raises(InputError) as caught:
        config.from_table(Outer, table, where="recipe")
    assert caught.value.code == code
    assert len(str(caught.value)) < 500


def test_a_file_that_an_editor_began_with_a_mark_is_read(tmp_path):
    (tmp_path / "luna.toml").write_text("steps = 5\n", "utf-8-sig")
    assert config.read_table(tmp_path / "luna.toml") == {"steps": 5}


def test_an_unknown_key_is_answered_with_the_known_ones():
    with pytest.raises(InputError, match="steps"):
        config.from_table(Outer, {"step": 5}, where="recipe")


@pytest.mark.parametrize(
    "text", ["[", "a = ", '"\x00', "seed = " + "[" * 5000 + "]" * 5000, "seed = " + "9" * 5000]
)
def test_a_broken_file_is_named(tmp_path, text):
    path = tmp_path / "recipe.toml"
    path.write_text(text)
    with pytest.raises(InputError, match="REC-003.*recipe.toml"):
        config.read_table(path)
