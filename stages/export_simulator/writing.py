"""Write the simulator's files and say how good they are."""

import json
from pathlib import Path
from typing import Any, Literal, assert_never

import numpy as np

from pipeline.files import arrays, glb
from pipeline.qa import Check, Picture
from stages.export_simulator import page, pictures
from stages.export_simulator.contract import contract
from stages.export_simulator.export import Made
from stages.export_simulator.page import Asset
from stages.export_simulator.reading import Minds

Layout = Literal["file", "folder"]


def write_simulator(folder: Path, made: Made, minds: Minds, name: str, layout: Layout) -> float:
    """Write the page, the animated agent, the room and the contract; return the size of what a visitor loads, megabytes."""
    about = contract(
        name=name,
        behavior=minds.behavior,
        setting=made.setting,
        motions=made.motions,
        skin=made.skin,
        residuals_m={"skinning_residual_mm": made.residual_m, "skinning_residual_8_mm": made.eight_residual_m},
        volume=minds.volume,
    )
    room = glb.static(made.scene, "scene")
    assets = {
        "room": Asset(room, 4),
        "agent": Asset(glb.skinned(made.agent, made.skin, []), 4),
        "clips": Asset(page.clip_rows(made.motions), 4),
        "splats": Asset(made.splat_rows, 32),
        "agent-splats": Asset(made.agent_splats.rows, 32),
        "agent-skin": Asset(made.agent_splats.skin, 8),
        "volume": Asset(minds.features, 2),
        "allowed": Asset(minds.allowed),
        **{name: Asset(network, 4) for name, network in minds.networks.items()},
    }
    size = _write_page(folder, about, assets, layout)
    (folder / "agent.glb").write_bytes(glb.skinned(made.agent, made.skin, made.actions))
    (folder / "scene.glb").write_bytes(room)
    arrays.save(folder / "skin_8.npz", joints=made.eight.joints, weights=made.eight.weights)
    (folder / "simulator.json").write_text(json.dumps(about, indent=1) + "\n")
    return size / 1e6


def _write_page(folder: Path, about: dict[str, Any], assets: dict[str, Asset], layout: Layout) -> int:
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
    return len(text.encode()) + sum(map(len, files.values()))


def quality(made: Made, size_mb: float, warn_page_mb: float) -> dict[str, Any]:
    """Return what `qa.write` tells of the simulator."""
    residual_mm = made.residual_m * 1000
    return {
        "good": "the page opens within seconds and the skin of `agent.glb` follows the reconstruction within 2 mm",
        "bad": "limbs of `agent.glb` that thin out at the joints, or a page too big to send",
        "checks": [
            Check("size of the page", size_mb, "MB", warn=warn_page_mb, fail=2 * warn_page_mb),
            Check("skinning loss, mean", float(residual_mm.mean()), "mm", warn=2.0, fail=10.0),
            Check("skinning loss, 99th percentile", float(np.percentile(residual_mm, 99)), "mm", warn=10.0),
            Check("skinning loss, largest", float(residual_mm.max()), "mm", warn=15.0),
            Check("sessions to replay", len(made.motions), "", warn=1, better="higher"),
        ],
        "pictures": [
            Picture(
                "visits",
                pictures.visits(made.scene, made.setting, made.motions),
                "the room from above: where the animal (amber) and the person (blue) have been",
            )
        ],
    }
