"""Assemble the page: one HTML file that holds its script, its worker, the WebAssembly runtime and every asset."""

import base64
import gzip
import html
import json
from collections.abc import Mapping
from importlib import resources
from typing import Any

import numpy as np
from jaxtyping import Float

from pipeline.space import rigid
from stages.export_simulator.actions import Motion

_BUNDLE = "web/dist"


def packed(content: bytes) -> str:
    """Compress to text; the same content always gives the same text."""
    return base64.b64encode(gzip.compress(content, 9, mtime=0)).decode()


def clip_rows(motions: list[Motion]) -> bytes:
    """Write all frames of all clips as float32 rows: root, bones, camera; place and quaternion wxyz each."""
    frames = []
    for motion in motions:
        poses = np.concatenate([motion.world_from_agent[:, None], motion.agent_from_bone, motion.world_from_camera[:, None]], axis=1)
        frames.append(pose_rows(poses))
    return np.concatenate(frames).astype("<f4").tobytes()


def pose_rows(a_from_b: Float[np.ndarray, "*batch 4 4"]) -> Float[np.ndarray, "*batch 7"]:
    """Turn rigid motions into rows of place and quaternion wxyz."""
    return np.concatenate([a_from_b[..., :3, 3], rigid.quaternion_from_rotation(a_from_b[..., :3, :3])], axis=-1)


def page(*, contract: Mapping[str, Any], assets: Mapping[str, bytes]) -> str:
    """Return the whole page; `assets` are what differs between builds, by the names that the script asks for."""
    bundle = resources.files("stages.export_simulator").joinpath(_BUNDLE)
    texts = {name: packed(content) for name, content in assets.items()}
    texts["simulator"] = packed(json.dumps(contract).encode())
    for name, file in {"worker": "worker.js.gz", "ort.wasm": "ort.wasm.gz"}.items():
        texts[name] = base64.b64encode(bundle.joinpath(file).read_bytes()).decode()
    tags = [f'<script type="application/octet-stream" id="asset-{name}">{text}</script>' for name, text in texts.items()]
    script = gzip.decompress(bundle.joinpath("page.js.gz").read_bytes()).decode()
    name = html.escape(str(contract["name"]))
    pieces = {
        "@@TITLE@@": f"{name}: a behaviour simulator",
        "@@NAME@@": name,
        "@@NOTICES@@": bundle.joinpath("NOTICES.txt").read_text(),
        "@@STYLE@@": bundle.joinpath("style.css").read_text(),
        "@@ASSETS@@": "\n".join(tags),
        "@@SCRIPT@@": script.replace("</script", "<\\/script").replace("<!--", "<\\!--"),
    }
    text = bundle.joinpath("page.html").read_text()
    for mark, piece in pieces.items():
        text = text.replace(mark, piece)
    return text
