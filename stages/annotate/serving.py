"""The page's server on 127.0.0.1: pictures, fits, and the file of clicks. Nothing leaves the machine."""

import json
import os
import re
import threading
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from pipeline.core import loopback
from pipeline.core.errors import InputError
from pipeline.data import clicks
from pipeline.data.clicks import ClickedClip, ClickedPair

MAX_DIGITS = 10
"""maximum digits of a Content-Length"""
PICTURE = re.compile(r"/picture/([0-9]{1,9})/([0-9]{1,9})\.jpg\Z")


@dataclass(frozen=True)
class ClickSession:
    """The recordings to click in, and the file of clicks."""

    recordings: Mapping[str, ClickedClip]
    """by file name"""
    shown: Mapping[str, list[int]]
    """frames to click in, by file name"""
    reference: str
    """file name of the walk-through"""
    world_from_reference: Float[np.ndarray, "frame 4 4"]
    path: Path
    """file of clicks"""

    def state(self) -> dict[str, Any]:
        """Return the initial state of the page."""
        names = list(self.recordings)

        def frame_of(name: str, frame: int) -> dict[str, Any]:
            source_index = int(self.recordings[name].source_index[frame])
            return {"source_index": source_index, "url": f"/picture/{names.index(name)}/{frame}.jpg"}

        frames = {name: [frame_of(name, frame) for frame in self.shown[name]] for name in names}
        pairs = [asdict(pair) for pair in clicks.read(self.path)] if self.path.exists() else []
        return {"reference": self.reference, "wanted": clicks.WANTED, "frames": frames, "pairs": pairs}

    def fits(self, pairs: list[ClickedPair]) -> dict[str, Any]:
        """Return the residual of each pair in millimeters (null without depth), for frames with enough."""
        found = {}
        for name, recorded in self.recordings.items():
            for source_index, group in clicks.by_frame(pairs, name).items():
                fit = clicks.fit(group, recorded, self.recordings[self.reference], self.world_from_reference)
                if fit is not None:
                    left = [None if np.isnan(m) else round(1000 * float(m), 1) for m in fit.residual_m]
                    typical_mm = round(1000 * fit.typical_m, 1)
                    found[f"{name}/{source_index}"] = {"typical_mm": typical_mm, "left_mm": left}
        return found

    def keep(self, pairs: list[ClickedPair]) -> None:
        """Replace the file of clicks, which must name recordings that are shown."""
        for pair in pairs:
            if pair.seen.recording not in self.recordings or pair.reference.recording != self.reference:
                names = f"{pair.seen.recording!r} and {pair.reference.recording!r}"
                raise ValueError(f"{names} are not what is clicked on")
        self.path.parent.mkdir(parents=True, exist_ok=True)
        fresh = self.path.with_name(f".{self.path.name}.tmp")
        with open(fresh, "w") as file:
            file.write(clicks.text(pairs))
            file.flush()
            os.fsync(file.fileno())
        fresh.replace(self.path)

    def picture(self, recording: int, frame: int) -> bytes:
        """Return a JPEG; raises LookupError for one that is not shown."""
        name = list(self.recordings)[recording]
        if frame not in self.shown[name]:
            raise LookupError(frame)
        return (self.recordings[name].clip.folder / "color" / f"{frame:06d}.jpg").read_bytes()


class ClickServer(ThreadingHTTPServer):
    """Server of one session of clicking; bound, but not yet running."""

    def __init__(self, desk: ClickSession, port: int) -> None:
        """Bind to a local port; 0 takes any free one. Raises InputError SYS-002 for a port in use."""
        try:
            super().__init__((loopback.HOST, port), Handler)
        except OSError as error:
            what = f"port {port}: {error.strerror}"
            raise InputError("SYS-002", what, loopback.HOST, "give another with --port") from error
        self.desk = desk
        self.keeping = threading.Lock()  # each request has its own thread, and all write one file


class Handler(BaseHTTPRequestHandler):
    """One request; only requests of the page itself are served."""

    server: "ClickServer"

    def do_GET(self) -> None:
        """Serve the page, its state or a picture."""
        if not self._from_here():
            return self._send(HTTPStatus.FORBIDDEN, b"", "text/plain")
        match = PICTURE.match(self.path)
        if self.path == "/":
            page = resources.files("stages.annotate").joinpath("page.html").read_bytes()
            return self._send(HTTPStatus.OK, page, "text/html; charset=utf-8")
        if self.path == "/state":
            try:
                return self._json(self.server.desk.state())
            except InputError as error:  # the file of clicks was damaged since the server started
                return self._send(HTTPStatus.INTERNAL_SERVER_ERROR, str(error).encode(), "text/plain")
        try:
            found = self.server.desk.picture(int(match[1]), int(match[2])) if match else b""
        except (LookupError, OSError):  # the build may run at the same time
            found = b""
        if not found:
            return self._send(HTTPStatus.NOT_FOUND, b"", "text/plain")
        return self._send(HTTPStatus.OK, found, "image/jpeg")

    def do_POST(self) -> None:
        """Save the clicks and respond with their fits."""
        stated = self.headers.get("Content-Length") or ""
        length = int(stated) if stated.isascii() and stated.isdigit() and len(stated) < MAX_DIGITS else 0
        wanted = self.path == "/clicks" and self.headers.get("Content-Type") == "application/json"
        if not self._from_here() or not wanted:
            return self._send(HTTPStatus.FORBIDDEN, b"", "text/plain")
        if not 0 < length <= clicks.MAX_BYTES:
            return self._send(HTTPStatus.REQUEST_ENTITY_TOO_LARGE, b"", "text/plain")
        try:
            pairs = clicks.parse(json.loads(self.rfile.read(length)))
            with self.server.keeping:
                self.server.desk.keep(pairs)
        except (ValueError, RecursionError, InputError, OSError) as error:
            return self._send(HTTPStatus.BAD_REQUEST, str(error).encode(), "text/plain")
        return self._json({"fits": self.server.desk.fits(pairs)})

    def log_message(self, format: str, *arguments: Any) -> None:
        """Log nothing."""

    def _from_here(self) -> bool:
        hosts, origins = (self.headers.get_all(name, []) for name in ("Host", "Origin"))
        return loopback.is_own(self.server.server_port, hosts, origins)

    def _json(self, value: Any) -> None:
        self._send(HTTPStatus.OK, json.dumps(value).encode(), "application/json")

    def _send(self, code: int, body: bytes, kind: str) -> None:
        self.send_response(code)
        self.send_header("Content-Type", kind)
        self.send_header("Content-Length", str(len(body)))
        self.send_header("Cache-Control", "no-store")
        self.end_headers()
        self.wfile.write(body)
