"""What tests share: the long ones come last, and the toy is built once."""

import importlib.util
import subprocess
from pathlib import Path

import jaxtyping
import pytest

# From `make dev`; continuous integration has it. To prepare the signatures of `pipeline` takes 4 s once, and
# checking them a fifth of the time of short tests, so that only the tests of `pipeline` itself do.
CHECKED = importlib.util.find_spec("beartype") is not None
if CHECKED:
    import tests.array_checks

    tests.array_checks.install(["pipeline"])

ROOT = Path(__file__).parent.parent


def pytest_collection_modifyitems(items):
    """Run unit and house tests first, then the builds of the toy."""
    items.sort(key=lambda item: item.get_closest_marker("toy") is not None)


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
