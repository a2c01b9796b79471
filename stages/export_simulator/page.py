"""Assemble the page: one HTML file that holds scripts, WebAssembly runtime and every asset, compressed.

Arrays are stored byte by byte of their records (all first bytes, then all second ones) to compress better.
"""

import base64
import gzip
import html
import json
import re
from collections.abc import Mapping
from dataclasses import dataclass
from importlib import resources
from typing import Any

import numpy as np

from stages.export_simulator.actions import SessionClip
from stages.export_simulator.contract import rigid_rows

_BUNDLE = resources.files("stages.export_simulator").joinpath("web/dist")
_BUNDLED = {"page": "page.js.gz", "worker": "worker.js.gz", "ort.wasm": "ort.wasm.gz"}
_STEPS = 4096.0


@dataclass(frozen=True)
class Asset:
    """What differs between builds: some content, how many bytes its records have, and what it is part of."""

    content: bytes
    record: int = 1
    part: str = "room"


def clip_rows(motions: list[SessionClip]) -> bytes:
    """Write all frames of all clips as float32 rows: root, bones, camera; place and quaternion wxyz each.

    Numbers are rounded to 1/4096 (0.12 mm): the rest is noise that would not compress.
    """
    frames = []
    for motion in motions:
        root, camera = motion.world_from_agent[:, None], motion.world_from_camera[:, None]
        frames.append(rigid_rows(np.concatenate([root, motion.agent_from_bone, camera], axis=1)))
    return (np.rint(np.concatenate(frames) * _STEPS) / _STEPS).astype("<f4").tobytes()


def page(contract: Mapping[str, Any], assets: Mapping[str, Asset], files: Mapping[str, bytes]) -> str:
    """Return the page with all files in it, `compressed`, by the names that the script asks for."""
    tags = [_tag(name, assets, content=base64.b64encode(file).decode()) for name, file in files.items()]
    return _assembled(contract, tags, connect="")


def light_page(contract: Mapping[str, Any], assets: Mapping[str, Asset], files: Mapping[str, bytes]) -> str:
    """Return a page that loads its files from the folder `assets` beside it; it wants a static host."""
    tags = [_tag(name, assets, f' data-file="assets/{name}.gz"') for name in files]
    return _assembled(contract, tags, connect="'self'")


def compressed(contract: Mapping[str, Any], assets: Mapping[str, Asset]) -> dict[str, bytes]:
    """Compress all that the page unpacks; the same content always gives the same bytes."""
    files = {name: _BUNDLE.joinpath(file).read_bytes() for name, file in _BUNDLED.items()}
    files["simulator"] = gzip.compress(json.dumps(contract).encode(), 9, mtime=0)
    return files | {name: gzip.compress(planes(asset), 9, mtime=0) for name, asset in assets.items()}


def planes(asset: Asset) -> bytes:
    """Sort the content by the place of each byte in its record; what is left over stays at the end."""
    whole = len(asset.content) // asset.record * asset.record
    records = np.frombuffer(asset.content, np.uint8, whole).reshape(-1, asset.record)
    return records.T.tobytes() + asset.content[whole:]


def _tag(name: str, assets: Mapping[str, Asset], more: str = "", content: str = "") -> str:
    record = assets[name].record if name in assets else 1
    kind = 'type="application/octet-stream"'
    return f'<script {kind} id="asset-{name}" data-record="{record}"{more}>{content}</script>'


def _assembled(contract: Mapping[str, Any], tags: list[str], connect: str) -> str:
    name = html.escape(str(contract["name"]))
    pieces = {
        "@@TITLE@@": f"{name}: a behavior simulator",
        "@@NAME@@": name,
        "@@CONNECT@@": connect,
        "@@NOTICES@@": _BUNDLE.joinpath("NOTICES.txt").read_text(),
        "@@STYLE@@": _BUNDLE.joinpath("style.css").read_text(),
        "@@ASSETS@@": "\n".join(tags),
        "@@SCRIPT@@": _BUNDLE.joinpath("boot.js").read_text(),
    }
    text = _BUNDLE.joinpath("page.html").read_text()
    return re.sub("|".join(pieces), lambda mark: pieces[mark[0]], text)  # at once: a piece may hold a mark
