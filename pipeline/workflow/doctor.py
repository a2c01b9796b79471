"""`make doctor`: check what this machine lacks for a build.

Each check returns one finding; the exit code is 2 when something that every build needs is missing.
"""

import ctypes.util
import importlib
import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from pipeline.core import config
from pipeline.core.errors import InputError
from pipeline.workflow import captures, recipes

LIBRARIES = (
    "torch", "numpy", "scipy", "cv2", "pycolmap", "OpenEXR", "av", "lzfse", "numba", "embreex", "trimesh",
    "kornia", "onnxruntime", "pygltflib", "skimage", "safetensors", "matplotlib", "jinja2",
)  # fmt: skip
OLDEST_PYTHON, TOO_NEW_PYTHON = (3, 11), (3, 14)
NEEDED_DISK_GB = 10
NEEDED_MEMORY_GB = 8


@dataclass(frozen=True)
class Finding:
    """What one check found."""

    subject: str
    state: Literal["ok", "warn", "fail"]
    text: str


def python() -> Finding:
    """Check the interpreter."""
    good = OLDEST_PYTHON <= sys.version_info[:2] < TOO_NEW_PYTHON
    text = f"{sys.version.split()[0]} (3.11 to 3.13 {'will do' if good else 'is needed'})"
    return Finding("python", "ok" if good else "fail", text)


def libraries() -> Finding:
    """Import what the stages import."""
    missing = []
    for name in LIBRARIES:
        try:
            importlib.import_module(name)
        except ImportError as error:
            missing.append(f"{name} ({error})")
    text = f"missing: {', '.join(missing)}; remedy: envs/setup" if missing else f"all {len(LIBRARIES)} import"
    return Finding("libraries", "fail" if missing else "ok", text)


def meshes() -> Finding:
    """Look for OpenGL and import pymeshlab in a separate process, as the stage that uses it does."""
    missing = [f"lib{name}" for name in ("GL", "OpenGL") if ctypes.util.find_library(name) is None]
    found = subprocess.run([sys.executable, "-c", "import pymeshlab"], capture_output=True, text=True)
    if found.returncode == 0 and not missing:
        return Finding("pymeshlab", "ok", "imports")
    named = ", ".join(missing) or "system libraries"
    return Finding("pymeshlab", "fail", f"missing {named}; remedy: apt-get install libgl1 libopengl0")


def processors() -> Finding:
    """Count cores and look for a GPU that torch can use."""
    try:
        import torch  # late: it costs seconds
    except ImportError:
        return Finding("processors", "fail", f"{os.cpu_count()} cores; torch is missing; remedy: envs/setup")
    gpu = torch.cuda.get_device_name(0) if torch.cuda.is_available() else "none, everything runs on the CPU"
    return Finding("processors", "ok", f"{os.cpu_count()} cores; GPU: {gpu}")


def lock() -> Finding:
    """Compare the lock file of the environment with this machine."""
    try:
        kind = Path(".venv", "lock").read_text().strip()
    except OSError:
        return Finding("lock", "warn", "unknown which: this environment was not made by envs/setup")
    has_gpu = shutil.which("nvidia-smi") is not None
    if has_gpu and kind == "cpu":
        return Finding("lock", "warn", "envs/cpu.txt, although there is a GPU; remedy: make doctor LOCK=cuda")
    without = "" if has_gpu or kind == "cpu" else "; this machine has no GPU, others may"
    return Finding("lock", "ok", f"envs/{kind}.txt{without}")


def memory() -> Finding:
    """Check the machine's memory."""
    total_gb = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2**30
    text = f"{total_gb:.1f} GB (a full build wants {NEEDED_MEMORY_GB}; with less, use -j1)"
    return Finding("memory", "ok" if total_gb >= NEEDED_MEMORY_GB else "warn", text)


def disk() -> Finding:
    """Check the free disk space for builds."""
    free_gb = shutil.disk_usage(".").free / 2**30
    text = f"{free_gb:.0f} GB free (wanted: {NEEDED_DISK_GB})"
    return Finding("disk", "ok" if free_gb >= NEEDED_DISK_GB else "warn", text)


def browser() -> Finding:
    """Check the browser of the page test and its system libraries; builds do not need them."""
    found = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), "")
    missing = [] if found else ["chromium"]
    if sys.platform == "linux" and ctypes.util.find_library("atomic") is None:
        missing.append("libatomic1")
    remedy = f"the page test cannot run; remedy: apt-get install {' '.join(missing)}"
    return Finding("browser", "warn" if missing else "ok", remedy if missing else found)


def recordings() -> Finding:
    """Count the recordings of every agent."""
    counts = []
    for recipe in sorted(Path("agents").glob("*.toml")):
        try:
            flow = recipes.flow(config.read_table(recipe).get(recipes.FLOW_TABLE, {}), str(recipe))
        except InputError as error:
            return Finding("recordings", "warn", str(error))
        count = len(captures.find(Path("captures", recipe.stem), flow))
        counts.append(f"{recipe.stem}: {count or 'built-in'}")
    return Finding("recordings", "ok", ", ".join(counts))


CHECKS: tuple[Callable[[], Finding], ...] = (
    python, libraries, meshes, processors, lock, memory, disk, browser, recordings,
)  # fmt: skip


def main() -> int:
    """Print every finding; return the exit code."""
    findings = [check() for check in CHECKS]
    for finding in findings:
        print(f"{finding.state:5}{finding.subject:12}{finding.text}")
    return 2 if any(finding.state == "fail" for finding in findings) else 0


if __name__ == "__main__":
    sys.exit(main())
