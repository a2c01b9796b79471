"""A small synthetic world for the page: a box-shaped room, a walking tube of five bones, networks trained to
flee.
"""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
import trimesh

from pipeline.behavior.diffusion import Schedule, noised
from pipeline.behavior.encoders import with_anticipated
from pipeline.behavior.model import Architecture, BehaviorNets, Scaling
from pipeline.behavior.path_encoding import (
    GOAL_LENGTH_POWER,
    velocity_channels_from_path,
    with_powered_length,
)
from pipeline.behavior.support import mark_supported
from pipeline.behavior.trajectories import FUTURE, BehaviorData, Trajectory, anticipated, anticipated_frames
from pipeline.data import npz, ply
from pipeline.geometry import rigid
from pipeline.geometry.meshes import Mesh
from stages.export_simulator import stage
from stages.export_simulator.config import Config
from stages.export_simulator.home import stage as home_stage
from stages.export_simulator.home.config import Config as HomeConfig
from stages.train_behavior.export import write_contract, write_networks

BONES = 5
HALF_ROOM_M = 2.0
CUPBOARD_M = 1.3
BOX_M = (0.6, 0.8, 0.4)
READS = ("reconstruction", "splats", "behavior", "behavior_data")
NAMED = Config(name="tube")


def rest() -> np.ndarray:
    """Five bones along the body, tail to head."""
    return rigid.make(
        np.eye(3), np.stack([np.zeros(BONES), np.zeros(BONES), np.linspace(-0.2, 0.2, BONES)], -1)
    )


def tube(rings: int = 24, sides: int = 12) -> tuple[Mesh, np.ndarray]:
    """A spindle along z, and its weights for five bones."""
    along, around = np.meshgrid(
        np.linspace(-0.25, 0.25, rings), np.arange(sides) * 2 * np.pi / sides, indexing="ij"
    )
    radius = 0.07 * np.sqrt(np.maximum(1 - (along / 0.26) ** 2, 0.02))
    vertices = np.stack([radius * np.cos(around), radius * np.sin(around), along], -1).reshape(-1, 3)
    corner = np.arange((rings - 1) * sides).reshape(rings - 1, sides)
    beside = np.roll(corner, -1, 1)
    faces = np.concatenate(
        [
            np.stack([corner, corner + sides, beside], -1),
            np.stack([beside, corner + sides, beside + sides], -1),
        ]
    ).reshape(-1, 3)
    squared = (vertices[:, None, 2] - rest()[None, :, 2, 3]) ** 2
    weights = np.exp(-squared / (2 * 0.06**2))
    color = np.where(np.sin(60 * vertices[:, 2:]) > 0, [214, 150, 92], [238, 214, 180]).astype(np.uint8)
    return Mesh(vertices.astype(np.float32), faces.astype(np.int32), color), weights / weights.sum(
        1, keepdims=True
    )


def room() -> Mesh:
    """Floor and four walls, visible from inside, with a checkerboard texture."""
    parts = [_sheet([0, 0, 0], [0, 0, 1], [1, 0, 0], (205, 180, 150), (188, 160, 130))]
    for normal, along in (
        ([1, 0, 0], [0, 0, -1]),
        ([-1, 0, 0], [0, 0, 1]),
        ([0, 0, 1], [1, 0, 0]),
        ([0, 0, -1], [-1, 0, 0]),
    ):
        center = -HALF_ROOM_M * np.array(normal, float) + [0, HALF_ROOM_M, 0]
        parts.append(_sheet(center, along, [0, 1, 0], (222, 226, 220), (206, 214, 210)))
    start = np.cumsum([0] + [len(part.vertices) for part in parts])
    faces = np.concatenate([part.faces + offset for part, offset in zip(parts, start[:-1], strict=True)])
    return Mesh(
        np.concatenate([part.vertices for part in parts]),
        faces.astype(np.int32),
        np.concatenate([part.color for part in parts]),
    )


def _sheet(center, along, up, first, second, cells: int = 16) -> Mesh:
    u, v = np.meshgrid(np.linspace(-1, 1, cells + 1), np.linspace(-1, 1, cells + 1), indexing="ij")
    vertices = np.asarray(center, float) + HALF_ROOM_M * (
        u[..., None] * np.array(along) + v[..., None] * np.array(up)
    )
    row, column = np.meshgrid(np.arange(cells + 1), np.arange(cells + 1), indexing="ij")
    color = (
        np.where(((row // 2 + column // 2) % 2 == 0)[..., None], first, second)
        .reshape(-1, 3)
        .astype(np.uint8)
    )
    at = (row * (cells + 1) + column)[:-1, :-1].reshape(-1)
    faces = np.concatenate(
        [np.stack([at, at + cells + 1, at + 1], -1), np.stack([at + 1, at + cells + 1, at + cells + 2], -1)]
    )
    return Mesh(vertices.reshape(-1, 3).astype(np.float32), faces.astype(np.int32), color)


def trajectory(frames: int, seed: int) -> Trajectory:
    """Walk on a perturbed circle with a swinging body; the observer stands aside."""
    time_s = np.arange(frames) / 10
    angle = 0.5 * time_s + seed
    position = np.stack([1.2 * np.cos(angle), np.full(frames, 0.1), 1.2 * np.sin(angle)], -1)
    heading = np.stack([0 * angle, -angle, 0 * angle], -1)  # z in the direction of travel
    world_from_agent = rigid.make(rigid.rotation_from_vector(heading), position)
    phase = 2 * np.pi * time_s[:, None] + np.arange(BONES)
    wag = np.stack(
        [0 * phase, 0.25 * np.sin(phase), 0 * phase, 0.02 * np.sin(phase), 0 * phase, 0 * phase], -1
    )
    camera = np.stack(
        [rigid.look_at(np.array([0.2, 1.4, 0.1 * seed]), point, np.array([0.0, 1, 0])) for point in position]
    )
    return Trajectory(
        time_s, world_from_agent, (rest() @ rigid.exp(wag)).astype(np.float32), camera, np.ones(frames, bool)
    )


def networks_that_flee(architecture: Architecture, steps: int = 250) -> BehaviorNets:
    """Train perception and goal network briefly to flee from a near observer, and the path network to go
    straight; the body is random.
    """
    torch.manual_seed(0)
    nets, schedule = BehaviorNets(architecture), Schedule()
    (mind,) = nets.perception
    optimizer = torch.optim.Adam([*mind.others.parameters(), *nets.goal.parameters()], 3e-3)
    alpha_bar = torch.from_numpy(schedule.alpha_bar).float()
    for _ in range(steps):
        place = (torch.rand(128, 1, 3) * 2 - 1) * torch.tensor([3.0, 0.3, 3.0]) + torch.tensor(
            [0.0, 1.2, 0.0]
        )
        level = place[:, 0] * torch.tensor([1.0, 0.0, 1.0])
        distance = level.norm(dim=-1, keepdim=True)
        pace_m_s = torch.rand(128, 1, 1) * 1.2  # that of approaching; irrelevant too
        observer = (
            place + level[:, None] / distance[:, None] * pace_m_s * torch.arange(0.7, -0.05, -0.1)[:, None]
        )
        person = torch.nn.functional.pad(observer, (0, 7))
        goal = -level / (distance + 0.05) * (2.0 - distance).clamp_min(0)
        goal = goal + 0.3 * torch.randn(128, 3) * torch.tensor([1.0, 0.1, 1.0])
        elsewhere = torch.randn(2, 128, architecture.code)  # independent of room and past
        chart = torch.randn(128, architecture.condition_length - architecture.code_length)
        going_on = anticipated(observer.numpy(), np.zeros((128, 3)), anticipated_frames(FUTURE))
        seen = with_anticipated(person[:, None], torch.from_numpy(going_on))
        others = mind.others(seen, torch.ones(128))
        code, attended = others[:, : architecture.code], others[:, architecture.code :]
        condition = torch.cat([chart, elsewhere[0], code, elsewhere[1], attended], dim=-1)
        t = torch.randint(schedule.steps, (128,))
        noise = torch.randn(128, 3)
        loss = (
            (nets.goal(noised(goal, noise, alpha_bar[t][:, None]), t.float(), condition) - noise)
            .square()
            .mean()
        )
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    _teach_paths(nets, architecture, schedule)
    return nets


def scales(architecture: Architecture) -> Scaling:
    """Return a plain normalization: goals and paths in meters, positions more widely spread later."""
    grow = np.arange(1, FUTURE + 1) / FUTURE
    path_std = np.stack([grow, 0.02 + 0 * grow, grow])
    channels = architecture.body_channels
    mean = np.zeros(channels)
    mean[[0, 4]] = 1.0
    return Scaling(np.ones(3), np.ones((1, 4)), path_std, mean, np.full(channels, 0.05))


def _teach_paths(
    nets: BehaviorNets, architecture: Architecture, schedule: Schedule, steps: int = 100
) -> None:
    """Train the path network briefly to go straight to its goal."""
    optimizer = torch.optim.Adam(nets.path.parameters(), 3e-3)
    alpha_bar = torch.from_numpy(schedule.alpha_bar).float()
    for _ in range(steps):
        goal = torch.randn(32, 3)
        place = (
            with_powered_length(goal, 1 / GOAL_LENGTH_POWER)[:, None]
            * torch.arange(1, FUTURE + 1)[:, None]
            / FUTURE
        )
        path = velocity_channels_from_path(place, torch.zeros(32, 3)).mT + 0.05 * torch.randn(32, 4, FUTURE)
        t = torch.randint(schedule.steps, (32,))
        noise = torch.randn(32, 4, FUTURE)
        x = noised(path, noise, alpha_bar[t][:, None, None])
        predicted = nets.path(
            x, t.float(), torch.randn(32, architecture.condition_length), goal, torch.ones(32, 1)
        )
        loss = (predicted - noise).square().mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()


def write(build: Path, *, accompanied: bool = False, paper: bool = False) -> None:
    """Write the four artifacts that `export_simulator` reads (without manifests); an ``accompanied`` animal
    also perceives and flees other animals; that of the ``paper`` is untrained, in its encoding.
    """
    for name in ("reconstruction", "splats", "behavior_data", "behavior"):
        (build / name).mkdir(parents=True)
    write_surfaces(build / "reconstruction")
    body, weights = tube()
    write_gaussians(build / "splats/scene.ply", room())
    write_gaussians(build / "splats/agent.ply", body)
    npz.save(
        build / "splats/splats.npz",
        agent_weights=weights.astype(np.float32),
        agent_from_bone_rest=rest().astype(np.float32),
    )
    tracks = {f"v{2 + k:03d}": trajectory(120, k) for k in range(2)}
    zeros = np.zeros(2, np.int32)
    BehaviorData(
        tracks, rest(), np.arange(2, dtype=np.int32), zeros, np.array([False, True]), tuple(tracks)
    ).save(build / "behavior_data")
    rng = np.random.default_rng(0)
    shape = (44, 24, 44)
    npz.save(
        build / "behavior_data/volume.npz",
        features=rng.normal(0, 0.1, (16, *shape)).astype(np.float16),
        occupancy=np.zeros(shape, np.uint8),
        allowed=allowed(shape),
        stands_m=np.full((2, 2), np.nan),
        origin=np.array([-2.2, -0.2, -2.2]),
        voxel_m=np.array(0.1),
    )
    architecture = Architecture(
        bones=BONES,
        scene_width=8,
        hidden=32,
        code=16,
        unet_width=8,
        unet_multipliers=(1,),
        goal_hidden=64,
        ensemble_size=1,
        companions=accompanied,
    )
    if paper:
        architecture = replace(architecture, ego="full", encoding="positions", corrections=False)
        nets, scaling = BehaviorNets(architecture).eval(), replace(scales(architecture), encoding="positions")
    else:
        nets, scaling = networks_that_flee(architecture), scales(architecture)
    write_contract(build / "behavior", nets, architecture, scaling, Schedule(), rest())
    write_networks(build / "behavior", nets, architecture)
    assert json.loads((build / "behavior/behavior.json").read_bytes())["rate_hz"] == 10


def write_home(animals: Path) -> None:
    """Write a cat, and a dog with the same networks that walks elsewhere."""
    write(animals / "cat", accompanied=True)
    shutil.copytree(animals / "cat", animals / "dog")
    data = BehaviorData.load(animals / "dog/behavior_data")
    half_a_circle = rigid.make(rigid.rotation_from_vector(np.array([0, np.pi, 0])), np.zeros(3))
    for name, track in data.trajectories.items():
        turned = half_a_circle @ track.world_from_agent
        data.trajectories[name] = replace(track, world_from_agent=turned)
    data.save(animals / "dog/behavior_data")


def exported_home(animals: Path, out: Path, **elsewhere: Path) -> Path:
    """Export the page of both into an empty folder; return the folder. ``elsewhere``: home and take."""
    out.mkdir(parents=True)
    inputs = {name: {animal: animals / animal / name for animal in ("cat", "dog")} for name in READS}
    config = HomeConfig(name="home", others=("cat", "dog"))
    home_stage.run(home_stage.Inputs(**inputs, **elsewhere), config, out)
    return out


def exported(raw: Path, out: Path, config: Config = NAMED) -> Path:
    """Export a world into an empty folder; return the folder."""
    out.mkdir(parents=True)
    stage.run(stage.Inputs(**{name: raw / name for name in READS}), config, out)
    return out


def allowed(shape: tuple[int, int, int]) -> np.ndarray:
    """The animal may be anywhere except in a cupboard, where x > `CUPBOARD_M` and z < -`CUPBOARD_M`."""
    space = np.ones(shape, np.uint8)
    edge = round((CUPBOARD_M + 2.2) / 0.1)
    space[edge:, :, : shape[2] - edge] = 0
    return space


def furnish(build: Path) -> None:
    """Add a box of `BOX_M` at the center of the floor, and floor and walls to the volume."""
    scene, half = ply.read_ply(build / "reconstruction/scene.ply"), np.array(BOX_M) / 2
    box = trimesh.creation.box(BOX_M, rigid.make(np.eye(3), [0, half[1], 0])).subdivide().subdivide()
    vertices = np.concatenate([scene.vertices, box.vertices]).astype(np.float32)
    faces = np.concatenate([scene.faces, box.faces + len(scene.vertices)]).astype(np.int32)
    color = np.concatenate([scene.color, np.full((len(box.vertices), 3), (60, 90, 150))]).astype(np.uint8)
    ply.write_ply(build / "reconstruction/scene.ply", Mesh(vertices, faces, color))
    write_gaussians(build / "splats/scene.ply", Mesh(vertices, faces, color))
    volume = npz.load(build / "behavior_data/volume.npz")
    place = np.moveaxis(np.indices(volume["occupancy"].shape), 0, -1) * 0.1 + volume["origin"] + 0.05
    inside = (np.abs(place) < [HALF_ROOM_M, np.inf, HALF_ROOM_M]).all(-1)
    solid = ~inside | (place[..., 1] < 0)
    solid |= (np.abs(place - [0, half[1], 0]) < half).all(-1)
    volume["occupancy"] = solid.astype(np.uint8)
    volume["allowed"] = mark_supported(~solid, volume["occupancy"])
    volume["stands_m"] = np.array([[0.05, 0.15], [0.08, 0.12]])
    npz.save(build / "behavior_data/volume.npz", **volume)


def write_surfaces(reconstruction: Path) -> None:
    """Write the tube, its skin and the room."""
    body, weights = tube()
    ply.write_ply(reconstruction / "agent.ply", body)
    ply.write_ply(reconstruction / "scene.ply", room())
    npz.save(
        reconstruction / "skin.npz",
        weights=weights.astype(np.float32),
        agent_from_bone_rest=rest().astype(np.float32),
        bone_scale_m=np.full((BONES, 3), 0.06, np.float32),
    )


def write_gaussians(path: Path, mesh: Mesh) -> None:
    """Write one flat Gaussian per vertex, 62 floats per row."""
    rows = np.zeros((len(mesh.vertices), 62), "<f4")
    rows[:, :3] = mesh.vertices
    rows[:, 6:9] = (mesh.color / 255 - 0.5) / 0.28209479177387814
    rows[:, 54] = 4.0
    rows[:, 55:58] = np.log(0.12)
    rows[:, 58] = 1.0
    names = [
        "x",
        "y",
        "z",
        "nx",
        "ny",
        "nz",
        *(f"f_dc_{i}" for i in range(3)),
        *(f"f_rest_{i}" for i in range(45)),
    ]
    names += ["opacity", *(f"scale_{i}" for i in range(3)), *(f"rot_{i}" for i in range(4))]
    head = [
        "ply",
        "format binary_little_endian 1.0",
        f"element vertex {len(rows)}",
        *(f"property float {name}" for name in names),
        "end_header",
        "",
    ]
    path.write_bytes("\n".join(head).encode() + rows.tobytes())
