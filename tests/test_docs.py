"""Commands in the guides exist with their options; links and pictures have targets."""

import re
import shlex
import subprocess
import sys
from functools import cache
from pathlib import Path

import pytest

from pipeline.workflow import dag

ROOT = Path(__file__).parent.parent
PAGES = sorted([ROOT / "README.md", *(ROOT / "docs").rglob("*.md")])
BLOCK = re.compile(r"^```(\w*)\n(.*?)^```", re.MULTILINE | re.DOTALL)
AGENTS = {path.stem for path in (ROOT / "agents").glob("*.toml")} | {"luna", "hen", "toy_plain"}
TARGETS = set(re.search(r"^COMMANDS := (.*)$", (ROOT / "Makefile").read_text(), re.MULTILINE)[1].split())


def commands() -> list[tuple[str, str]]:
    """Return every command line in the code blocks."""
    found = []
    for page in PAGES:
        for language, block in BLOCK.findall(page.read_text()):
            lines = (line.partition("#")[0].strip() for line in block.splitlines() if not language)
            found += [
                (page.name, line)
                for line in lines
                if line.split(" ")[0] in ("make", "python", "snakemake", ".venv/bin/python")
            ]
    return found


@cache
def help_of(module: str) -> str:
    completed = subprocess.run(
        [sys.executable, "-m", module, "--help"], cwd=ROOT, capture_output=True, text=True
    )
    assert completed.returncode == 0, completed.stderr
    return completed.stdout


def check_make(words: list[str]) -> None:
    """Check that targets and variants exist and that the Makefile reads the variables."""
    makefile = (ROOT / "Makefile").read_text()
    for word in words:
        if word in ("|",) or re.fullmatch(r"-j\d*", word):
            continue
        if "=" in word:
            name, value = word.split("=", 1)
            assert (
                f"$({name})" in makefile or f"$(or $({name})" in makefile or f"$(if $({name})" in makefile
            ), word
            if name == "VARIANT":
                assert (ROOT / f"agents/variants/{value}.toml").exists(), word
            if name == "FORMAT":
                assert f'"{value}"' in (ROOT / "stages/export/config.py").read_text(), word
            continue
        agent, *rest = word.split(".")
        assert word in TARGETS or agent in AGENTS, word
        if rest:
            assert rest[0] in dag.NODES and rest[1:] in ([], ["redo"]), word


@pytest.mark.parametrize(("page", "line"), commands(), ids=lambda text: text)
def test_every_command_exists(page: str, line: str) -> None:
    program, *words = shlex.split(line)
    match program:
        case "make":
            check_make(words)
        case "snakemake":
            assert (ROOT / "Snakefile").exists() and (ROOT / "profiles/default/config.yaml").exists()
        case _:
            assert words[0] == "-m", line
            if words[1] == "http.server":
                assert "--directory" in help_of("http.server")
            elif words[1].startswith("benchmarks"):
                program = ROOT / words[1].replace(".", "/")
                assert program.with_suffix(".py").exists() or (program / "__main__.py").exists(), line
            else:
                assert {word for word in words[2:] if word.startswith("--")} <= set(
                    re.findall(r"--[a-z-]+", help_of(words[1]))
                ), line


@cache
def anchors(page: Path) -> set[str]:
    """Return the anchors of a page's headings, as GitHub makes them."""
    headings = re.findall(r"^#+ (.*)$", BLOCK.sub("", page.read_text()), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_link_targets_exist(page: Path) -> None:
    for target in re.findall(r"\]\(([^)\s]+)\)", page.read_text()):
        file, _, anchor = target.partition("#")
        place = page.parent / file if file else page
        assert target.startswith("http") or place.exists(), target
        assert not anchor or target.startswith("http") or anchor in anchors(place), target
    for key in re.findall(r"`(layout|scene_splats|scene_faces)", page.read_text()):
        assert key in (ROOT / "stages/export_simulator/config.py").read_text(), key


@pytest.mark.parametrize("measured", sorted(path.name for path in (ROOT / "docs/experiments").iterdir()))
def test_guide_has_one_table_of_figures_and_leads_to_the_others(measured: str) -> None:
    guide = (ROOT / "docs" / measured).read_text()
    metrics = re.search(r"^## Metrics\n(.*?)(?=^## |\Z)", guide, re.MULTILINE | re.DOTALL)
    assert metrics is not None and len(re.findall(r"^\|-", metrics[1], re.MULTILINE)) == 1
    assert f"](experiments/{measured})" in guide


def test_cited_commits_exist() -> None:
    def git(*arguments: str) -> str:
        return subprocess.run(["git", *arguments], cwd=ROOT, capture_output=True, text=True).stdout.strip()

    if git("rev-parse", "--is-shallow-repository") != "false":
        pytest.skip("no history here")
    cited = {word for page in PAGES for word in re.findall(r"\b[0-9a-f]{7,8}\b", page.read_text())}
    hashes = {word for word in cited if re.search("[a-f]", word) and re.search("[0-9]", word)}
    known = git("rev-list", "HEAD").split()
    assert not {word for word in hashes if not any(commit.startswith(word) for commit in known)}


def test_pictures_are_small() -> None:
    assert sum(path.stat().st_size for path in (ROOT / "docs/pictures").iterdir()) < 400_000, "bytes in total"
