"""The trained model as files: ONNX networks, weights, the sampler's contract, one golden plan."""

import json
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import onnx
import onnxruntime
import torch
from jaxtyping import Float
from safetensors.torch import save_file

from pipeline.behavior.config import PlanSamplingConfig
from pipeline.behavior.diffusion import Schedule
from pipeline.behavior.encoders import POSE_CHANNELS, with_anticipated
from pipeline.behavior.model import Architecture, BehaviorNets, Scaling, contract, other_channels
from pipeline.behavior.path_encoding import PATH_CHANNELS_OF
from pipeline.behavior.perception import GRID_SHAPE, PerceptionEnsemble
from pipeline.behavior.planning import Observation, Sampler, TorchNetworks
from pipeline.behavior.trajectories import UP, anticipated
from pipeline.geometry import rigid

NETWORKS = ("perception", "goal", "path", "body")
GOLDEN_OBSERVER_M = ((0.5, 0.2), (1.2, 1.2), (1.8, 1.1))
"""first and last position of the golden plan's approaching observer: left, up, ahead"""


def write_contract(
    folder: Path,
    nets: BehaviorNets,
    architecture: Architecture,
    scaling: Scaling,
    schedule: Schedule,
    rest: Float[np.ndarray, "bone 4 4"],
) -> None:
    """Write weights, `behavior.json` and, for diffusion models, `golden.json`."""
    state = {name: value.contiguous() for name, value in nets.state_dict().items()}
    save_file(state, folder / "behavior.safetensors")
    document = contract(architecture, scaling, schedule, rest)
    (folder / "behavior.json").write_text(json.dumps(document, indent=1) + "\n")
    if architecture.family == "diffusion":
        sampler = Sampler(TorchNetworks(nets), schedule, scaling, corrections=architecture.corrections)
        golden = golden_plan(sampler, architecture)
        (folder / "golden.json").write_text(json.dumps(golden) + "\n")


def write_networks(folder: Path, nets: BehaviorNets, architecture: Architecture) -> float:
    """Write the four ONNX files; return the largest difference between ONNX and torch.

    With companions, perception takes any number of others, else the observer alone.
    """
    differences = []
    for name in NETWORKS:
        inputs, output = signature(name, architecture)
        path, network = folder / f"{name}.onnx", getattr(nets, name)
        export_network(network, path, inputs, output)
        differences.append(difference(network, path, inputs))
    return float(np.max(differences))  # propagates NaN


def export_network(
    module: torch.nn.Module, path: Path, inputs: dict[str, tuple[int, ...]], output: str
) -> None:
    """Write one network as ONNX with a dynamic batch axis and, if ``inputs`` have several others, a dynamic
    number of them; the same weights always give the same bytes.
    """
    dynamic_axes = {name: {0: "batch"} for name in (*inputs, output)}
    if inputs.get("others", (1,))[0] > 1:
        dynamic_axes["others"][1] = "other"
    example = tuple(torch.zeros(2, *shape) for shape in inputs.values())
    with warnings.catch_warnings(action="ignore"):
        torch.onnx.export(
            module.eval(),
            example,
            path,
            input_names=list(inputs),
            output_names=[output],
            dynamo=False,  # 3 s for all four networks, `torch.export` 46 s; knows no `diff`, no `mT`
            dynamic_axes=dynamic_axes,
        )
    onnx.checker.check_model(str(path))


def signature(name: str, a: Architecture) -> tuple[dict[str, tuple[int, ...]], str]:
    """Return the inputs of a network (name and shape without batch) and the name of its output.

    With companions, the example has two others.
    """
    step: dict[str, tuple[int, ...]] = {"t": (), "condition": (a.condition_length,)}
    match name:
        case "perception":
            grid = {
                "scene_grid": (a.scene_channels, *GRID_SHAPE),
                "others": (1 + a.companions, a.past + len(a.anticipated), POSE_CHANNELS + 1),
                "past": (a.past * (9 + 6 * a.bones),),
            }
            return grid | {"keep": (3,)}, "condition"
        case "goal":
            return {"x": (3,)} | step, "epsilon"
        case "path":
            x = (PATH_CHANNELS_OF[a.encoding], a.future)
            return {"x": x} | step | {"control": (3,), "keep": (1,)}, "epsilon"
        case _:
            controlled = {"control": (3, a.future), "keep": (1,)}
            return {"x": (a.body_channels, a.future)} | step | controlled, "epsilon"


def golden_observation(a: Architecture) -> Observation:
    """Return the deterministic input of the golden plan; a companion, if any, walks away to the left."""

    def wave(*shape: int, amplitude: float, frequency: float) -> np.ndarray:
        number = np.arange(np.prod(shape), dtype=np.float64)
        return (amplitude * np.sin(frequency * number)).reshape(1, *shape).astype(np.float32)

    left, up, ahead = (np.linspace(*ends, a.past) for ends in GOLDEN_OBSERVER_M)
    observer = np.stack([left, up, ahead], axis=-1)
    facing = rigid.look_at(observer, np.zeros(3), UP)
    scene = wave(a.scene_channels, *GRID_SHAPE, amplitude=0.25, frequency=0.01)
    past = wave(a.past * (9 + 6 * a.bones), amplitude=0.1, frequency=0.1)
    walk = np.linspace(0.5, 1.0, a.past)
    companion = np.stack([walk, np.full(a.past, 0.1), 0.5 * walk, np.ones(a.past)], axis=-1)
    others = other_channels(facing[None], companion[None, None] if a.companions else None)
    if a.anticipated:
        there = anticipated(observer[None], np.zeros((1, 3)), np.array(a.anticipated)).astype(np.float32)
        others = with_anticipated(torch.from_numpy(others), torch.from_numpy(there)).numpy()
    return Observation(scene, others, past)


def golden_plan(sampler: Sampler, architecture: Architecture) -> dict:
    """Sample plans by DPM-Solver++; return input, noise and results."""
    observation = golden_observation(architecture)
    sampling = PlanSamplingConfig(method="dpm_solver", goal_steps=10, sequence_steps=10, max_path_draws=1)
    noise = np.random.default_rng(0)
    shapes = {
        "goal": (1, 3),
        "path": (1, PATH_CHANNELS_OF[architecture.encoding], architecture.future),
        "body": (1, architecture.body_channels, architecture.future),
    }
    drawn = {name: noise.standard_normal(shape, dtype=np.float32) for name, shape in shapes.items()}
    plans = {
        f"guidance_{s:g}": sampler.plan(observation, replace(sampling, guidance=s), np.random.default_rng(0))
        for s in (sampling.guidance, 1.0, 0.5)
    }
    return {
        "input": {
            "scene_grid": "scene_grid.flat[i] = 0.25 sin(0.01 i)",
            "past": "past.flat[i] = 0.1 sin(0.1 i)",
            "others": _plain(observation.others),
            "keep": [1, 1, 1],
        },
        "sampling": {name: getattr(sampling, name) for name in ("method", "goal_steps", "sequence_steps")},
        "noise": {name: _plain(value) for name, value in drawn.items()},
        "plans": {
            name: {k: _plain(value) for k, value in vars(plan).items()} for name, plan in plans.items()
        },
    }


def _plain(array: np.ndarray) -> list:
    return np.round(array[0].astype(np.float64), 7).tolist()


def difference(module: torch.nn.Module, path: Path, inputs: dict[str, tuple[int, ...]]) -> float:
    """Return the largest difference between an ONNX file and its network on random inputs.

    The last of the batch is an animal at rest, with equal past frames. NaN outputs are propagated.
    """
    rng = np.random.default_rng(0)
    drawn = {name: rng.standard_normal((4, *shape), dtype=np.float32) for name, shape in inputs.items()}
    if isinstance(module, PerceptionEnsemble):
        for name, shape in (("others", inputs["others"][:2]), ("past", (1, module.first.past.frames))):
            still = drawn[name][-1].reshape(*shape, -1)
            drawn[name][-1] = np.broadcast_to(still[:, :1], still.shape).reshape(drawn[name][-1].shape)
    if "keep" in drawn:
        drawn["keep"][-1] = 1
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    session = onnxruntime.InferenceSession(path, options, providers=["CPUExecutionProvider"])
    with torch.inference_mode():
        expected = module(*(torch.from_numpy(value) for value in drawn.values())).numpy()
    return float(np.abs(session.run(None, drawn)[0] - expected).max())
