"""The gallery shows every finished simulator with valid links and works offline."""

import json
import re
from pathlib import Path

import numpy as np
import pytest

from pipeline.core.errors import InputError
from pipeline.data import qa
from pipeline.metrics.metrics import Metrics
from stages.compile_gallery import __main__ as program
from stages.compile_gallery import stage


def write_build(folder: Path, name: str, goal_m: float | None, megabytes: float) -> None:
    """Write the files of a finished build that the gallery reads."""
    simulator = folder / "simulator"
    simulator.mkdir(parents=True)
    (simulator / "index.html").write_text("page")
    (simulator / "manifest.json").write_text("{}")
    (simulator / "simulator.json").write_text(json.dumps({"name": name}))
    picture = np.tile(np.linspace(0, 255, 900).astype(np.uint8)[None, :, None], (600, 1, 3))
    qa.write(
        simulator,
        good="",
        bad="",
        checks=(
            qa.Check("size of the page", megabytes, "MB", warn=25.0),
            qa.Check("sessions to replay", 3, "", warn=1, better="higher"),
        ),
        pictures=(qa.Picture("visits", picture, ""),),
    )
    for page in ("report", "homes/other/simulator", "homes/third/home_simulator"):
        (folder / page).mkdir(parents=True)
        (folder / page / "index.html").write_text("page")
    (folder / "evaluation").mkdir()
    goals = {"behavior/ats/goal_minde_m": goal_m, "behavior/stand_still/goal_minde_m": 0.45}
    metrics = goals | {"registration/translation_m_median": None}
    Metrics(metrics).write(folder / "evaluation", "metrics.json")


def test_every_finished_simulator_has_a_card(tmp_path: Path) -> None:
    write_build(tmp_path / "luna", "luna & <co>", 0.4321, 30.0)
    write_build(tmp_path / "cat", "cat", None, 12.3)
    write_build(tmp_path / "cat/variants/no_scene", "cat without a scene", 0.5, 12.0)
    write_build(tmp_path / "pair/animals/luna", "pair", 0.5, 12.0)
    (tmp_path / "toy/simulator").mkdir(parents=True)
    (tmp_path / "toy/simulator/index.html").write_text("a build that was stopped")
    page = stage.run(tmp_path)
    names = re.findall(r"<h2>(.*?)</h2>", page)
    assert names == ["cat", "cat without a scene", "luna &amp; &lt;co&gt;", "luna"]
    links = re.findall(r'href="([^"]*)"', page)
    assert len(links) == 4 * 5 and all((tmp_path / link).is_file() for link in links)
    assert "0.432 m" in page and "30 MB" in page and "12.3 MB" in page
    lights = re.findall(r'class="light (\w+)"', page)
    assert lights == ["ok", "fail", "warn", "fail"], "goals behind standing still, a page of 30 MB"
    assert not re.search(r"https?://|src=\"(?!data:)", page), "nothing from the network"
    assert len(page) < 20_000, "thumbnails are small"


def test_a_home_of_several_animals_has_a_card_beside_its_animals(tmp_path: Path) -> None:
    for animal in ("cat", "dog"):
        write_build(tmp_path / "pair/animals" / animal, "pair", 0.4, 12.0)
    write_build(tmp_path / "made", "pair", None, 22.9)
    (tmp_path / "made/simulator").rename(tmp_path / "pair/home_simulator")
    (tmp_path / "pair/home_simulator/qa/visits.webp").rename(
        tmp_path / "pair/home_simulator/qa/visits_cat.webp"
    )
    page = stage.run(tmp_path)
    assert re.findall(r"<h2>(.*?)</h2>", page) == ["pair", "cat", "dog"] and "<h1>2 animals</h1>" in page
    assert 'href="pair/home_simulator/index.html">walk with them<' in page
    assert page.count("data:image/webp") == 3 and "22.9 MB" in page


def test_gallery_is_written_to_the_build_folder(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert program.main([str(tmp_path)]) == 2
    assert "ART-003" in capsys.readouterr().err
    with pytest.raises(InputError, match="ART-003"):
        stage.run(tmp_path)
    write_build(tmp_path / "cat", "cat", 0.4, 12.3)
    assert program.main([str(tmp_path)]) == 0
    assert (tmp_path / "index.html").read_text().startswith("<!doctype html>")
