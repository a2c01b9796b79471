"""Order of tests, threads per process, and the shared build of the toy."""

import importlib.util
import os
import subprocess
from pathlib import Path

import cv2
import jaxtyping
import pytest
import torch
from xdist.scheduler import LoadScopeScheduling

# Installed by `make dev`, and in continuous integration. Preparing the signatures of `pipeline` takes 4 s, and
# checking them 20 % of the time of short tests, so that only the tests of `pipeline` itself are checked.
HAS_BEARTYPE = importlib.util.find_spec("beartype") is not None
if HAS_BEARTYPE:
    import tests.array_checks

    tests.array_checks.install(["pipeline"])

ROOT = Path(__file__).parent.parent
WORKERS = int(os.environ.get("PYTEST_XDIST_WORKER_COUNT", 1))
if WORKERS > 1:
    threads = max(1, (os.cpu_count() or 1) // WORKERS)
    torch.set_num_threads(threads)
    cv2.setNumThreads(threads)
    # else the first parallel loop of numba gives torch all cores
    os.environ["NUMBA_NUM_THREADS"] = str(threads)


TOY_FILES = ("test_data_layout.py", "test_docs_example.py", "test_restart.py", "test_toy_build.py")
"""Files with tests of the toy build; with several processes, one of them runs all of these first."""
PAGES = "export_simulator"
"""Folder of tests in which pages run in real time; with several processes, they run while the toy is built."""


def pytest_collection_modifyitems(items):
    """Run tests of the toy build last in a single process; in several first, beside tests that wait for pages."""
    for item in items:
        assert not item.get_closest_marker("toy") or item.path.name in TOY_FILES, f"{item.path}: TOY_FILES"
    if WORKERS == 1:
        items.sort(key=lambda item: item.get_closest_marker("toy") is not None)
    else:
        items.sort(key=lambda item: (item.path.name not in TOY_FILES, item.path.parent.name != PAGES))


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config, log):
    """Distribute whole files, whose tests share fixtures, over processes; all of `TOY_FILES` are one unit."""

    class Scheduler(LoadScopeScheduling):
        def _split_scope(self, nodeid):
            path = nodeid.split("::", 1)[0]
            return "toy" if Path(path).name in TOY_FILES else path

    return Scheduler(config, log)


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup(item):
    """Check array shapes only in the tests of `pipeline`."""
    jaxtyping.config.update(
        "jaxtyping_disable", not (HAS_BEARTYPE and item.path.is_relative_to(ROOT / "tests/pipeline"))
    )


@pytest.fixture(scope="session")
def toy(pytestconfig) -> Path:
    """Build the toy in `build/` of the repository, with visible progress, and return its folder."""
    capture = pytestconfig.pluginmanager.getplugin("capturemanager")
    with capture.global_and_fixture_disabled():
        print("\nmake toy", flush=True)
        completed = subprocess.run(["make", "-j2", "toy"], cwd=ROOT)
    assert completed.returncode == 0, "the toy does not build"
    return ROOT / "build" / "toy"
