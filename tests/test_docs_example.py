"""The example of docs/adding_a_stage.md works as written in a copy of the checkout."""

import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
GUIDE = (ROOT / "docs/adding_a_stage.md").read_text()
BLOCKS = re.findall(r"^```python\n(.*?)^```", GUIDE, re.MULTILINE | re.DOTALL)
CONTRACTS = re.findall(r"^```markdown\n(.*?)^```", GUIDE, re.MULTILINE | re.DOTALL)


@pytest.fixture(scope="module")
def copy(tmp_path_factory) -> Path:
    """A checkout with the stage of the guide."""
    folder = tmp_path_factory.mktemp("checkout")
    skip = shutil.ignore_patterns("__pycache__", "node_modules", "dist")
    for name in ("pipeline", "stages", "agents"):
        shutil.copytree(ROOT / name, folder / name, ignore=skip)
    for name in ("pyproject.toml", "ERRORS.md", "data_layout.md", "envs/setup"):
        (folder / name).parent.mkdir(exist_ok=True)
        shutil.copy(ROOT / name, folder / name)
    for page, contract in zip(("data_layout.md", "ERRORS.md"), CONTRACTS, strict=True):
        with (folder / page).open("a") as file:
            file.write(contract if contract.startswith("|") else f"\n{contract}")
    (folder / "tests").mkdir()
    for name in ("test_house.py", "test_data_layout.py"):
        shutil.copy(ROOT / "tests" / name, folder / "tests")
    declaration, *files = BLOCKS
    for text in files:
        path, _, body = text.removeprefix("# ").partition("\n")
        (folder / path).parent.mkdir(parents=True, exist_ok=True)
        (folder / path).write_text(body)
    dag = folder / "pipeline/workflow/dag.py"
    source = dag.read_text()
    before = '    Node("splats",'
    assert source.count(before) == 1
    dag.write_text(source.replace(before, declaration + before))
    return folder


def python(folder: Path, *words: str) -> str:
    done = subprocess.run([sys.executable, *words], cwd=folder, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.mark.slow
def test_tests_of_the_stage_pass(copy):
    assert "3 passed" in python(copy, "-m", "pytest", "tests/stages/map_visits")


@pytest.mark.slow
def test_stage_has_a_command_line(copy):
    usage = python(copy, "-m", "stages.map_visits", "--help")
    assert "--reconstruction" in usage and "cell_m = 0.25" in usage


def test_stage_is_planned(copy):
    python(copy, "-SE", "-m", "pipeline.workflow.plan", "plan", "toy")
    assert "visits" in (copy / "build/toy/plan/rules.mk").read_text()


@pytest.mark.slow
def test_stage_passes_the_checks_of_the_architecture(copy):
    chosen = "visits or dag.py or documented_in_errors or stage_is_in_the_flow or artifact_is_documented"
    files = ("tests/test_house.py", "tests/test_data_layout.py")
    done = python(copy, "-m", "pytest", "-m", "not toy", *files, "-k", chosen)
    assert " passed" in done


@pytest.mark.toy
def test_python_guide_runs(toy, tmp_path, monkeypatch):
    """Run the blocks of docs/python.md in order on the toy build."""
    (tmp_path / "build").mkdir()
    (tmp_path / "build/toy").symlink_to(toy)
    monkeypatch.chdir(tmp_path)
    names: dict[str, object] = {}
    for block in re.findall(r"^```python\n(.*?)^```", (ROOT / "docs/python.md").read_text(), re.M | re.S):
        exec(compile(block, "docs/python.md", "exec"), names)
    assert (tmp_path / "flow_at_160/flow.png").stat().st_size > 1000
    assert 0 < names["difference_px"].size
