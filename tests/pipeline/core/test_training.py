"""The training loop resumes bit-exactly, skips and rolls back non-finite steps, and stops with a diagnosis."""

import math
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from pipeline.core import training as fitting

ROOT = Path(__file__).parents[3]


def make_problem(seed: int = 0):
    torch.manual_seed(seed)
    net = torch.nn.Sequential(torch.nn.Linear(4, 8), torch.nn.Dropout(0.2), torch.nn.Linear(8, 1))
    optimizer = torch.optim.AdamW(net.parameters(), 1e-2)

    def loss(step, generator):
        x = torch.randn(16, 4, generator=generator)
        return {"fit": ((net(x) - x.sum(1, keepdim=True)) ** 2).mean()}

    return net, optimizer, loss


def run(resume, *, loss_of=lambda loss: loss, steps=60, **options):
    net, optimizer, loss = make_problem()
    record = fitting.fit(
        modules={"net": net},
        optimizer=optimizer,
        loss=loss_of(loss),
        steps=steps,
        seed=3,
        resume=resume,
        save_every=7,
        **options,
    )
    return record, torch.cat([p.detach().flatten() for p in net.parameters()])


def test_resumed_run_is_bit_identical(tmp_path):
    record, whole = run(tmp_path / "whole")

    def interrupted(loss):
        def inner(step, generator):
            if step == 31:
                raise KeyboardInterrupt
            return loss(step, generator)

        return inner

    with pytest.raises(KeyboardInterrupt):
        run(tmp_path / "cut", loss_of=interrupted)
    resumed_record, resumed = run(tmp_path / "cut")
    assert torch.equal(whole, resumed)
    assert (record.total() == resumed_record.total()).all()
    assert record.total()[-10:].mean() < record.total()[:10].mean()


def test_damaged_checkpoint_falls_back_to_the_previous_one(tmp_path):
    _, whole = run(tmp_path)
    newest = max(tmp_path.glob("step*.pt"))
    newest.write_bytes(newest.read_bytes()[:100])
    _, again = run(tmp_path)
    assert torch.equal(whole, again)


def nonfinite_at(steps_broken):
    def wrap(loss):
        return lambda step, generator: {
            "fit": loss(step, generator)["fit"] * (math.nan if step in steps_broken() else 1.0)
        }

    return wrap


def test_one_nonfinite_step_is_skipped_and_recorded():
    record, weights = run(None, loss_of=nonfinite_at(lambda: {5}))
    assert math.isnan(record.total()[5]) and record.rolled_back == 0
    assert torch.isfinite(weights).all()


def test_three_nonfinite_steps_roll_back_once(tmp_path):
    calls = {"left": 3}

    def wrap(loss):
        def inner(step, generator):
            bad = step >= 20 and calls["left"] > 0
            calls["left"] -= bad
            return {"fit": loss(step, generator)["fit"] * (math.nan if bad else 1.0)}

        return inner

    record, weights = run(tmp_path, loss_of=wrap)
    assert record.rolled_back == 1 and torch.isfinite(weights).all() and len(record.total()) == 60


def test_persistently_nonfinite_loss_stops_with_a_diagnosis(tmp_path):
    with pytest.raises(SystemExit) as end:
        run(tmp_path, loss_of=nonfinite_at(lambda: range(20, 1000)))
    assert end.value.code == fitting.EXIT_DIVERGED
    assert "terms" in (tmp_path / "diagnosis.json").read_text()


FULL = """
import resource, sys
from pathlib import Path
import torch
from safetensors.torch import save_file
from pipeline.core import training
from pipeline.core.errors import InputError, coded_disk_errors

resource.setrlimit(resource.RLIMIT_FSIZE, (1 << 20, 1 << 20))
folder, tensors = Path(sys.argv[1]), {"a": torch.nn.Parameter(torch.ones(1 << 20))}
module = torch.nn.ParameterDict(tensors)
try:
    with coded_disk_errors(str(folder)):
        match sys.argv[2]:
            case "checkpoint":
                training.fit(modules={"m": module}, optimizer=torch.optim.SGD(module.parameters(), 0.1),
                             loss=lambda step, generator: {"a": module["a"].square().sum()}, steps=2, seed=0, resume=folder)
            case "tensors":
                save_file(dict(module.state_dict()), folder / "a.safetensors")
except InputError as error:
    print(f"error: {error}", file=sys.stderr)
    sys.exit(2)
"""


@pytest.mark.slow
@pytest.mark.parametrize("what", ["checkpoint", "tensors"])
def test_full_disk_is_reported_and_leaves_no_partial_checkpoint(tmp_path, what):
    """A file size limit of 1 MB fails like a full disk."""
    command = [sys.executable, "-c", FULL, str(tmp_path), what]
    ended = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert ended.returncode == 2, ended.stderr
    assert ended.stderr.startswith(f"error: SYS-001 {tmp_path}")
    if what == "checkpoint":
        assert list(tmp_path.iterdir()) == []
