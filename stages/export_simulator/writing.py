"""Write the simulator's files and say how good they are."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, assert_never

from pipeline.data import glb
from pipeline.data.qa import Check, Picture
from stages.export_simulator import page, pictures
from stages.export_simulator.config import Config, Layout
from stages.export_simulator.contract import MIN_SUPPORTED, contract, loss_mm
from stages.export_simulator.export import SimulatorParts
from stages.export_simulator.page import Asset
from stages.export_simulator.reading import BehaviorAssets

WARN_PAGE_MB = 25.0
"""Megabytes above which the report warns about the page: some mail programs and hosts refuse more."""
WARN_MORE_MB = 5.0
"""Megabytes that each animal but the first may add to the page before the report warns."""


def write_simulator(
    folder: Path,
    parts: SimulatorParts,
    behavior: BehaviorAssets,
    config: Config,
    labels: Mapping[str, str],
    remark: str | None,
) -> dict[str, float]:
    """Write page, animated agent, scene and contract; return megabytes that a visitor loads, by part.

    ``remark`` is what a visitor should know of the home beside what carries the animal.
    """
    about = contract(parts, behavior, config.name, labels, remark)
    room = glb.static(parts.scene, "scene")
    sizes_mb = _write_page(folder, about, _room(parts, room) | _animal(parts, behavior), config.layout)
    (folder / "agent.glb").write_bytes(glb.skinned(parts.agent, parts.skin, parts.actions))
    (folder / "scene.glb").write_bytes(room)
    (folder / "simulator.json").write_text(json.dumps(about, indent=1) + "\n")
    return sizes_mb


def write_home(
    folder: Path,
    animals: Mapping[str, tuple[SimulatorParts, BehaviorAssets]],
    config: Config,
    labels: Mapping[str, str],
    remarks: Mapping[str, str | None],
) -> dict[str, float]:
    """Write the page of several animals, by name, in the room of the first; return megabytes by part.

    ``remarks`` are what a visitor should know of the home of each. Assets and contract of each are those of
    its own page, and when clips begin in their sessions, so that all begin at one moment.
    """
    contracts = []
    for name, (parts, behavior) in animals.items():
        about = contract(parts, behavior, name, labels, remarks[name])
        about["assets"] = f"{name}-"
        for clip, motion in zip(about["clips"], parts.motions, strict=True):
            clip["begin_s"] = round(motion.begin_s, 4)
        contracts.append(about)
    shared = ("version", "units", "up", "quaternion", "rows", "scene", "observer", "controls")
    whole = {"name": config.name, **{key: contracts[0][key] for key in shared}, "animals": contracts}
    warnings = dict.fromkeys(each["scene"]["warning"] for each in contracts if each["scene"]["warning"])
    whole["scene"] = {**whole["scene"], "warning": " ".join(warnings) or None}
    first = next(iter(animals.values()))[0]
    assets = _room(first, glb.static(first.scene, "scene"))
    for name, (parts, behavior) in animals.items():
        assets |= {f"{name}-{key}": asset for key, asset in _animal(parts, behavior).items()}
    sizes_mb = _write_page(folder, whole, assets, config.layout)
    (folder / "simulator.json").write_text(json.dumps(whole, indent=1) + "\n")
    return sizes_mb


def _room(parts: SimulatorParts, room: bytes) -> dict[str, Asset]:
    """Return the assets that are the room's."""
    return {"room": Asset(room, 4), "splats": Asset(parts.splat_rows, 32)}


def _animal(parts: SimulatorParts, behavior: BehaviorAssets) -> dict[str, Asset]:
    """Return the assets that are an animal's own."""
    return {
        "agent": Asset(glb.skinned(parts.agent, parts.skin, []), 4, "bodies"),
        "clips": Asset(page.clip_rows(parts.motions), 4, "recorded motion"),
        "agent-splats": Asset(parts.agent_splats.rows, 32, "bodies"),
        "agent-skin": Asset(parts.agent_splats.skin, 8, "bodies"),
        "volume": Asset(behavior.features, 2, "voxels"),
        **{name: Asset(values, part="voxels") for name, values in behavior.voxels.items()},
        **{name: Asset(network, 4, "networks") for name, network in behavior.networks.items()},
    }


def _write_page(
    folder: Path, about: dict[str, Any], assets: dict[str, Asset], layout: Layout
) -> dict[str, float]:
    """Write the page and return its megabytes by part."""
    compressed = page.compressed(about, assets)
    match layout:
        case "file":
            text, files = page.page(about, assets, compressed), {}
        case "folder":
            text = page.light_page(about, assets, compressed)
            files = {f"assets/{name}.gz": file for name, file in compressed.items()}
            (folder / "assets").mkdir()
        case _:
            assert_never(layout)
    for name, content in {"index.html": text.encode(), **files}.items():
        (folder / name).write_bytes(content)
    whole_mb = (len(text.encode()) + sum(map(len, files.values()))) / 1e6
    mb_per_byte, sizes_mb = whole_mb / sum(map(len, compressed.values())), {}
    for name, file in compressed.items():
        part = assets[name].part if name in assets else "program"
        sizes_mb[part] = sizes_mb.get(part, 0.0) + mb_per_byte * len(file)
    return sizes_mb


def page_checks(sizes_mb: Mapping[str, float], animals: int = 1) -> list[Check]:
    """Return checks of the megabytes of a page by part, from `write_simulator` or `write_home`."""
    warn_mb = WARN_PAGE_MB + WARN_MORE_MB * (animals - 1)
    whole = Check("size of the page", sum(sizes_mb.values()), "MB", warn=warn_mb, fail=2 * warn_mb)
    return [whole, *(Check(f"of the page: {part}", size, "MB") for part, size in sizes_mb.items())]


def quality(parts: SimulatorParts, sizes_mb: Mapping[str, float], supported: float | None) -> dict[str, Any]:
    """Return checks and pictures of the simulator for `qa.write`."""
    lost_mm = loss_mm(parts.residual_m)
    carried = "recorded motion that the scene carries"
    visits = pictures.visits(parts.scene, parts.setting.floor_m, parts.motions)
    about = "the room from above: where the animal (amber) and the person (blue) have been"
    heat = pictures.heat_maps(parts.scene, parts.setting.floor_m, parts.motions)
    about_heat = "trajectories of animal and person (left, right), and how long each was where, in space"
    return {
        "good": "the page opens within seconds; the skin of `agent.glb` is within 2 mm of the reconstruction",
        "bad": "limbs of `agent.glb` that thin out at the joints, or a page too big to send",
        "checks": [
            *page_checks(sizes_mb),
            Check("skinning loss, mean", lost_mm["mean"], "mm", warn=2.0, fail=10.0),
            Check("skinning loss, 99th percentile", lost_mm["p99"], "mm", warn=10.0),
            Check("skinning loss, largest", lost_mm["max"], "mm", warn=15.0),
            Check(carried, supported, "share", MIN_SUPPORTED, better="higher"),
            Check("sessions to replay", len(parts.motions), "", warn=1, better="higher"),
        ],
        "pictures": [Picture("visits", visits, about), Picture("heat_maps", heat, about_heat)],
    }
