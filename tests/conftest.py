"""What tests share: the long ones come last, and the toy is built once."""

import importlib.util
import subprocess
from pathlib import Path

import pytest

# From `make dev`; continuous integration has it. Of stages' own signatures none is checked: to prepare those of
# `pipeline` takes 4 s once, and checking them a fifth of the time of short tests, as much as is worth it.
if importlib.util.find_spec("beartype"):
    import tests.array_checks

    tests.array_checks.install(["pipeline"])

ROOT = Path(__file__).parent.parent


def pytest_collection_modifyitems(items):
    """Run unit and house tests first, then the builds of the toy."""
    items.sort(key=lambda item: item.get_closest_marker("toy") is not None)


@pytest.fixture(scope="session")
def toy(pytestconfig) -> Path:
    """Build the toy in the repository's own `build/` and return its folder; its progress is shown."""
    capture = pytestconfig.pluginmanager.getplugin("capturemanager")
    with capture.global_and_fixture_disabled():
        print("\nmake toy", flush=True)
        made = subprocess.run(["make", "-j2", "toy"], cwd=ROOT)
    assert made.returncode == 0, "the toy does not build"
    return ROOT / "build" / "toy"
