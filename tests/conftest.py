"""What tests share: the order of tests, their share of cores, and one build of the toy."""

import importlib.util
import os
import subprocess
from pathlib import Path

import cv2
import jaxtyping
import pytest
import torch

# From `make dev`; continuous integration has it. To prepare the signatures of `pipeline` takes 4 s once, and
# checking them a fifth of the time of short tests, so that only the tests of `pipeline` itself do.
CHECKED = importlib.util.find_spec("beartype") is not None
if CHECKED:
    import tests.array_checks

    tests.array_checks.install(["pipeline"])

ROOT = Path(__file__).parent.parent
WORKERS = int(os.environ.get("PYTEST_XDIST_WORKER_COUNT", 1))
if WORKERS > 1:
    threads = max(1, (os.cpu_count() or 1) // WORKERS)
    torch.set_num_threads(threads)
    cv2.setNumThreads(threads)


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items):
    """Run unit and house tests first, then the builds of the toy.

    In several processes the builds of the toy are one group and begin first; the tests of a file share its
    fixtures in one process.
    """
    items.sort(key=lambda item: (item.get_closest_marker("toy") is not None) == (WORKERS == 1))
    for item in items:
        group = "toy" if item.get_closest_marker("toy") else item.path.relative_to(ROOT).as_posix()
        item.add_marker(pytest.mark.xdist_group(group))


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup(item):
    """Check arrays in signatures in the tests of `pipeline`."""
    jaxtyping.config.update(
        "jaxtyping_disable", not (CHECKED and item.path.is_relative_to(ROOT / "tests/pipeline"))
    )


@pytest.fixture(scope="session")
def toy(pytestconfig) -> Path:
    """Build the toy in the repository's own `build/` and return its folder; its progress is shown."""
    capture = pytestconfig.pluginmanager.getplugin("capturemanager")
    with capture.global_and_fixture_disabled():
        print("\nmake toy", flush=True)
        made = subprocess.run(["make", "-j2", "toy"], cwd=ROOT)
    assert made.returncode == 0, "the toy does not build"
    return ROOT / "build" / "toy"
