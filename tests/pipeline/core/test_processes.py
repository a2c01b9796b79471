"""Work in several processes, and its interruption."""

import os
import signal
import subprocess
import sys
from pathlib import Path

from pipeline.core import processes

ROOT = Path(__file__).parents[3]
PROGRAM = """
import signal
import time
from pipeline.core import processes

# Restore the default of a terminal: background processes of a shell script ignore SIGINT.
signal.signal(signal.SIGINT, signal.default_int_handler)
try:
    for _ in processes.unordered(time.sleep, [(0,), (60,), (60,)], 2):
        print("begun", flush=True)
except KeyboardInterrupt:
    print("stopped")
"""


def test_every_job_runs_once():
    assert sorted(processes.unordered(pow, [(2, 3), (3, 2), (5, 1)], workers=2)) == [(0, 8), (1, 9), (2, 5)]


def test_interrupt_ends_all_processes_with_one_message():
    command = [sys.executable, "-c", PROGRAM]
    running = subprocess.Popen(
        command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True
    )
    assert running.stdout.readline() == "begun\n"
    os.killpg(running.pid, signal.SIGINT)
    output, errors = running.communicate(timeout=30)
    assert (output, errors, running.returncode) == ("stopped\n", "", 0)
