"""Write the simulator's files and say how good they are."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, assert_never

import numpy as np

from pipeline.data import glb
from pipeline.data.qa import Check, Picture
from stages.export_simulator import page, pictures
from stages.export_simulator.config import Config, Layout
from stages.export_simulator.contract import MIN_SUPPORTED, contract
from stages.export_simulator.export import SimulatorParts
from stages.export_simulator.page import Asset
from stages.export_simulator.reading import BehaviorAssets

WARN_PAGE_MB = 25.0
"""Megabytes above which the report warns about the page: some mail programs and hosts refuse more."""


def write_simulator(
    folder: Path,
    parts: SimulatorParts,
    behavior: BehaviorAssets,
    config: Config,
    labels: Mapping[str, str],
    remark: str | None,
) -> float:
    """Write the page, the animated agent, the scene and the contract; return megabytes that a visitor loads.

    ``remark`` is what a visitor should know of the home beside what carries the animal.
    """
    about = contract(parts, behavior, config.name, labels, remark)
    room = glb.static(parts.scene, "scene")
    size_mb = _write_page(folder, about, _room(parts, room) | _animal(parts, behavior), config.layout)
    (folder / "agent.glb").write_bytes(glb.skinned(parts.agent, parts.skin, parts.actions))
    (folder / "scene.glb").write_bytes(room)
    (folder / "simulator.json").write_text(json.dumps(about, indent=1) + "\n")
    return size_mb


def write_home(
    folder: Path,
    animals: Mapping[str, tuple[SimulatorParts, BehaviorAssets]],
    config: Config,
    labels: Mapping[str, str],
) -> float:
    """Write the page of several animals, by name, in the room of the first; return megabytes to load.

    Assets and contract of each are those of its own page, and when clips begin in their sessions, so that all
    begin at one moment.
    """
    contracts = []
    for name, (parts, behavior) in animals.items():
        about = contract(parts, behavior, name, labels, None)
        about["assets"] = f"{name}-"
        for clip, motion in zip(about["clips"], parts.motions, strict=True):
            clip["begin_s"] = round(motion.begin_s, 4)
        contracts.append(about)
    shared = ("version", "units", "up", "quaternion", "rows", "scene", "observer", "controls")
    whole = {"name": config.name, **{key: contracts[0][key] for key in shared}, "animals": contracts}
    first = next(iter(animals.values()))[0]
    assets = _room(first, glb.static(first.scene, "scene"))
    for name, (parts, behavior) in animals.items():
        assets |= {f"{name}-{key}": asset for key, asset in _animal(parts, behavior).items()}
    size_mb = _write_page(folder, whole, assets, config.layout)
    (folder / "simulator.json").write_text(json.dumps(whole, indent=1) + "\n")
    return size_mb


def _room(parts: SimulatorParts, room: bytes) -> dict[str, Asset]:
    """Return the assets that are the room's."""
    return {"room": Asset(room, 4), "splats": Asset(parts.splat_rows, 32)}


def _animal(parts: SimulatorParts, behavior: BehaviorAssets) -> dict[str, Asset]:
    """Return the assets that are an animal's own."""
    return {
        "agent": Asset(glb.skinned(parts.agent, parts.skin, []), 4),
        "clips": Asset(page.clip_rows(parts.motions), 4),
        "agent-splats": Asset(parts.agent_splats.rows, 32),
        "agent-skin": Asset(parts.agent_splats.skin, 8),
        "volume": Asset(behavior.features, 2),
        **{name: Asset(values) for name, values in behavior.voxels.items()},
        **{name: Asset(network, 4) for name, network in behavior.networks.items()},
    }


def _write_page(folder: Path, about: dict[str, Any], assets: dict[str, Asset], layout: Layout) -> float:
    """Write the page and return its megabytes."""
    match layout:
        case "file":
            text, files = page.page(contract=about, assets=assets), {}
        case "folder":
            text, files = page.light_page(contract=about, assets=assets)
            (folder / "assets").mkdir()
        case _:
            assert_never(layout)
    for name, content in {"index.html": text.encode(), **files}.items():
        (folder / name).write_bytes(content)
    return (len(text.encode()) + sum(map(len, files.values()))) / 1e6


def quality(parts: SimulatorParts, size_mb: float, supported: float | None) -> dict[str, Any]:
    """Return checks and pictures of the simulator for `qa.write`."""
    residual_mm = parts.residual_m * 1000
    carried = "recorded motion that the scene carries"
    visits = pictures.visits(parts.scene, parts.setting.floor_m, parts.motions)
    about = "the room from above: where the animal (amber) and the person (blue) have been"
    heat = pictures.heat_maps(parts.scene, parts.setting.floor_m, parts.motions)
    about_heat = "trajectories of animal and person (left, right), and how long each was where, in space"
    return {
        "good": "the page opens within seconds; the skin of `agent.glb` is within 2 mm of the reconstruction",
        "bad": "limbs of `agent.glb` that thin out at the joints, or a page too big to send",
        "checks": [
            Check("size of the page", size_mb, "MB", warn=WARN_PAGE_MB, fail=2 * WARN_PAGE_MB),
            Check("skinning loss, mean", float(residual_mm.mean()), "mm", warn=2.0, fail=10.0),
            Check("skinning loss, 99th percentile", float(np.percentile(residual_mm, 99)), "mm", warn=10.0),
            Check("skinning loss, largest", float(residual_mm.max()), "mm", warn=15.0),
            Check(carried, supported, "share", MIN_SUPPORTED, better="higher"),
            Check("sessions to replay", len(parts.motions), "", warn=1, better="higher"),
        ],
        "pictures": [Picture("visits", visits, about), Picture("heat_maps", heat, about_heat)],
    }
