"""Assemble the page: one HTML file that holds its script, its worker, the WebAssembly runtime and every asset."""

import base64
import gzip
import html
import json
from collections.abc import Mapping
from importlib import resources
from typing import Any

import numpy as np

from stages.export_simulator.actions import Motion
from stages.export_simulator.contract import rigid_rows

_BUNDLE = "web/dist"
_STEPS = 4096.0


def clip_rows(motions: list[Motion]) -> bytes:
    """Write all frames of all clips as float32 rows: root, bones, camera; place and quaternion wxyz each.

    Numbers are rounded to 1/4096 (0.12 mm): the rest is noise that would not compress.
    """
    frames = []
    for motion in motions:
        poses = np.concatenate([motion.world_from_agent[:, None], motion.agent_from_bone, motion.world_from_camera[:, None]], axis=1)
        frames.append(rigid_rows(poses))
    return (np.rint(np.concatenate(frames) * _STEPS) / _STEPS).astype("<f4").tobytes()


def page(*, contract: Mapping[str, Any], assets: Mapping[str, bytes]) -> str:
    """Return the page with everything in it; `assets` are what differs between builds, by the names the script asks for."""
    content = compressed(contract, assets)
    tags = [f'<script type="application/octet-stream" id="asset-{name}">{_text(file)}</script>' for name, file in content.items()]
    return _assembled(contract, tags, connect="")


def light_page(*, contract: Mapping[str, Any], assets: Mapping[str, bytes]) -> tuple[str, dict[str, bytes]]:
    """Return a page that loads its assets from beside it, and these files by name; it wants a static host."""
    files = {f"assets/{name}.gz": file for name, file in compressed(contract, assets).items()}
    tags = [f'<script type="application/octet-stream" id="asset-{file[7:-3]}" data-file="{file}"></script>' for file in files]
    return _assembled(contract, tags, connect="'self'"), files


def compressed(contract: Mapping[str, Any], assets: Mapping[str, bytes]) -> dict[str, bytes]:
    """Compress all that the page needs beside its script; the same content always gives the same bytes."""
    bundle = resources.files("stages.export_simulator").joinpath(_BUNDLE)
    files = {name: gzip.compress(content, 9, mtime=0) for name, content in assets.items()}
    files["simulator"] = gzip.compress(json.dumps(contract).encode(), 9, mtime=0)
    return files | {name: bundle.joinpath(f"{file}.gz").read_bytes() for name, file in (("worker", "worker.js"), ("ort.wasm", "ort.wasm"))}


def _text(content: bytes) -> str:
    return base64.b64encode(content).decode()


def _assembled(contract: Mapping[str, Any], tags: list[str], connect: str) -> str:
    bundle = resources.files("stages.export_simulator").joinpath(_BUNDLE)
    script = gzip.decompress(bundle.joinpath("page.js.gz").read_bytes()).decode()
    name = html.escape(str(contract["name"]))
    pieces = {
        "@@TITLE@@": f"{name}: a behaviour simulator",
        "@@NAME@@": name,
        "@@CONNECT@@": connect,
        "@@NOTICES@@": bundle.joinpath("NOTICES.txt").read_text(),
        "@@STYLE@@": bundle.joinpath("style.css").read_text(),
        "@@ASSETS@@": "\n".join(tags),
        "@@SCRIPT@@": script.replace("</script", "<\\/script").replace("<!--", "<\\!--"),
    }
    text = bundle.joinpath("page.html").read_text()
    for mark, piece in pieces.items():
        text = text.replace(mark, piece)
    return text
