"""The benchmark of pages finds those of one animal and those of a home."""

import pytest

from benchmarks import page_speed


@pytest.mark.parametrize("name", page_speed.PAGES)
def test_page_of_an_animal_or_of_a_home_is_found(tmp_path, name):
    with pytest.raises(SystemExit, match="home_simulator/index.html"):
        page_speed.page_of(tmp_path)
    (tmp_path / name).parent.mkdir()
    (tmp_path / name).touch()
    assert page_speed.page_of(tmp_path) == tmp_path / name
