"""A small flow on a Slurm of its own, one node on this machine, by the profile that users start from.

`make test-slurm`; needs root, slurmctld, slurmd, munge and Snakemake's plugin, and is skipped without them.
"""

import importlib.util
import os
import shutil
import socket
import subprocess
import time

import pytest

from tests.pipeline.workflow import checkout

PROGRAMS = ("munged", "slurmctld", "slurmd", "sbatch", "srun")
PLUGIN = "snakemake_executor_plugin_slurm"
FOUND = all(map(shutil.which, PROGRAMS)) and importlib.util.find_spec(PLUGIN) and os.geteuid() == 0
LIMIT_S = 60
"""Time limit for the start of Slurm."""
CONFIG = """
ClusterName=test
SlurmctldHost={host}(127.0.0.1)
SlurmctldPort={port}
SlurmdPort={node_port}
SlurmUser=root
SlurmdUser=root
AuthType=auth/munge
AuthInfo=socket={folder}/munge.socket
CredType=cred/munge
StateSaveLocation={folder}/state
SlurmdSpoolDir={folder}/spool
SlurmctldPidFile={folder}/slurmctld.pid
SlurmdPidFile={folder}/slurmd.pid
SlurmctldLogFile={folder}/slurmctld.log
SlurmdLogFile={folder}/slurmd.log
ProctrackType=proctrack/pgid
TaskPlugin=task/none
SelectType=select/cons_tres
SelectTypeParameters=CR_Core_Memory
SwitchType=switch/none
MpiDefault=none
JobAcctGatherType=jobacct_gather/none
AccountingStorageType=accounting_storage/none
NodeName={host} NodeAddr=127.0.0.1 CPUs={cores} RealMemory=10000 State=UNKNOWN
PartitionName=cpu Nodes={host} Default=YES MaxTime=INFINITE State=UP
PartitionName=gpu Nodes={host} MaxTime=INFINITE State=UP
"""


def _free_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as server:
        return server.getsockname()[1]


@pytest.fixture
def slurm(tmp_path, monkeypatch):
    """Start munged, slurmctld and slurmd as foreground processes that end with the test."""
    folder = tmp_path / "slurm"
    for name in ("state", "spool", "bin"):
        (folder / name).mkdir(parents=True)
    (folder / "munge.key").write_bytes(os.urandom(1024))
    (folder / "munge.key").chmod(0o400)
    config, host = folder / "slurm.conf", socket.gethostname().partition(".")[0]
    ports = {"port": _free_port(), "node_port": _free_port()}
    config.write_text(CONFIG.format(folder=folder, host=host, cores=os.cpu_count(), **ports))
    wrapper = folder / "bin/srun"  # the plugin removes variables that start with SLURM_
    wrapper.write_text(f'#!/bin/sh\nSLURM_CONF={config} exec {shutil.which("srun")} "$@"\n')
    wrapper.chmod(0o755)
    monkeypatch.setenv("SLURM_CONF", str(config))
    monkeypatch.setenv("PATH", f"{folder}/bin:{os.environ['PATH']}")
    own = [
        f"--{name}={folder}/munge.{name.split('-')[0]}"
        for name in ("key-file", "socket", "pid-file", "seed-file")
    ]
    munge = ["munged", "--foreground", "--force", f"--log-file={folder}/munged.log", *own]
    started = [subprocess.Popen(munge)]
    try:
        _wait((folder / "munge.socket").exists)
        started.append(subprocess.Popen(["slurmctld", "-D", "-c", "-f", str(config)]))
        started.append(subprocess.Popen(["slurmd", "-D", "-f", str(config)]))
        _wait(lambda: "idle" in subprocess.run(["sinfo"], capture_output=True, text=True).stdout)
        yield
    finally:
        for each in reversed(started):
            each.terminate()
        for each in started:
            each.wait(LIMIT_S)


def _wait(ready) -> None:
    end = time.monotonic() + LIMIT_S
    while not ready():
        assert time.monotonic() < end, "Slurm did not begin"
        time.sleep(0.2)


@pytest.mark.slow
@pytest.mark.skipif(not FOUND, reason="needs root, Slurm, munge and Snakemake's plugin for Slurm")
def test_flow_runs_on_slurm(slurm, tmp_path):
    small_checkout = checkout.create(tmp_path / "checkout")
    options = "--workflow-profile profiles/slurm --config agent=toy --slurm-status-command squeue --retries 0"
    target = "build/toy/frames/v001/.ok"
    checks = ("--slurm-init-seconds-before-status-checks", "2")
    made = small_checkout.snakemake(*options.split(), *checks, "--", target)
    assert made.returncode == 0, made.stderr
    assert (small_checkout.folder / target).is_file()
    assert made.stderr.count("has been submitted with SLURM jobid") == 2, (
        "the built-in capture and its frames"
    )
