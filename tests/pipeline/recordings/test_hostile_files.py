"""Malicious or damaged files give an error code, or the correct result, within bounded time and memory."""

import errno
import io
import json
import os
import resource
import struct
import zipfile
import zlib
from fractions import Fraction
from pathlib import Path

import av
import lzfse
import numpy as np
import OpenEXR
import pytest
import trimesh

from pipeline.core.errors import InputError, coded_disk_errors
from pipeline.data import clicks, images, ply
from pipeline.recordings import containers, movies
from pipeline.recordings.formats import open_recording
from tests.pipeline.recordings import made_formats
from tests.stages.extract_frames.made_recordings import walk

HUGE = int("9" * 400)


def test_file_without_permission_is_not_called_damaged(tmp_path, monkeypatch):
    """Root may read everything, so the system's answer is given by hand."""

    def refused(name, *_, **__):
        raise PermissionError(errno.EACCES, "Permission denied", str(name))

    (tmp_path / "session.mp4").write_bytes(bytes(100))
    monkeypatch.setattr(movies.av, "open", refused)
    monkeypatch.setattr(containers, "open", refused, raising=False)
    with pytest.raises(InputError, match="SYS-003.*session.mp4"):
        open_recording(tmp_path / "session.mp4")
    with pytest.raises(InputError, match="SYS-003.*session.mp4"):
        containers.FolderContainer(tmp_path).read("session.mp4")


def _archive(path: Path, members: dict[str, bytes]) -> Path:
    """Write a stored ZIP64 archive with very many members, much faster than zipfile."""
    parts, directory, at = [], [], 0
    for name, data in members.items():
        fields = struct.pack("<4H3L2H", 0, 0, 0, 33, zlib.crc32(data), len(data), len(data), len(name), 0)
        local = b"PK\x03\x04\x14\0" + fields + name.encode() + data
        directory.append(
            b"PK\x01\x02\x14\0\x14\0" + fields + struct.pack("<3H2L", 0, 0, 0, 0, at) + name.encode()
        )
        parts.append(local)
        at += len(local)
    listed = b"".join(directory)
    end = struct.pack("<4sQ2H2L4Q", b"PK\x06\x06", 44, 45, 45, 0, 0, *[len(members)] * 2, len(listed), at)
    end += struct.pack("<4sLQL", b"PK\x06\x07", 0, at + len(listed), 1)
    end += struct.pack("<4s4H2LH", b"PK\x05\x06", 0, 0, 0xFFFF, 0xFFFF, 0xFFFFFFFF, 0xFFFFFFFF, 0)
    path.write_bytes(b"".join(parts) + listed + end)
    return path


@pytest.mark.slow
def test_twenty_minutes_of_record3d_are_read(tmp_path):
    """72,000 frames of three files each: 216,001 members."""
    count, made = 72_000, walk(2)
    made.write(tmp_path / "short.r3d")
    with zipfile.ZipFile(tmp_path / "short.r3d") as short:
        metadata = json.loads(short.read("metadata"))
        stored = {kind: short.read(f"rgbd/0.{kind}") for kind in ("depth", "jpg", "conf")}
    metadata |= {"poses": [metadata["poses"][0]] * count, "frameTimestamps": (np.arange(count) / 60).tolist()}
    metadata["perFrameIntrinsicCoeffs"] = None
    members = {"metadata": json.dumps(metadata).encode()}
    for number in range(count):
        members |= {f"rgbd/{number}.{kind}": data for kind, data in stored.items()}
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    recording = open_recording(_archive(tmp_path / "long.r3d", members))
    assert len(recording.index) == count
    assert recording.read_depth(count - 1).shape == recording.depth_size
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 1_500_000, (
        "kB, the test's own archive too"
    )


def test_more_members_than_declared_frames_are_refused(tmp_path):
    made = walk(6)
    made.write(tmp_path / "a.r3d")
    with zipfile.ZipFile(tmp_path / "a.r3d", "a") as archive:
        for number in range(containers.MEMBERS_PER_FRAME * 6 + containers.EXTRA_MEMBERS):
            archive.writestr(f"more/{number}", b"")
    with pytest.raises(InputError, match="CAP-002"):
        open_recording(tmp_path / "a.r3d")


def test_archive_with_millions_of_members_is_refused(tmp_path):
    """The end record of a ZIP declares its members: five million are refused before any is read."""
    entry = struct.pack("<4s4B4HL2L5H2L", b"PK\x01\x02", *[20, 3, 20, 0], *[0] * 14)
    data = entry * 5_000_000
    end = struct.pack("<4s4H2LH", b"PK\x05\x06", 0, 0, 0xFFFF, 0xFFFF, len(data), 0, 0)
    (tmp_path / "a.r3d").write_bytes(data + end)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    del data
    with pytest.raises(InputError, match="CAP-002"):
        open_recording(tmp_path / "a.r3d")
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 200_000, "kB"


def _with_metadata(path: Path, change) -> Path:
    made = walk(8)
    change(made.metadata)
    return made.write(path)


@pytest.mark.parametrize(
    "change",
    [
        lambda metadata: metadata.update(w=HUGE),
        lambda metadata: metadata.update(K=[HUGE] * 9),
        lambda metadata: metadata.update(frameTimestamps=[HUGE] * 8),
        lambda metadata: metadata.update(cameraType=HUGE),
        lambda metadata: metadata.update(fps=HUGE, frameTimestamps=None),
    ],
    ids=["w", "K", "times", "camera", "fps"],
)
def test_huge_integers_in_metadata_are_refused(tmp_path, change):
    with pytest.raises(InputError, match="CAP-004"):
        open_recording(_with_metadata(tmp_path / "a.r3d", change))


def test_damaged_lzma_and_wrong_lzfse_sizes_are_refused(tmp_path):
    made = walk(8)
    made.write(tmp_path / "a.r3d")
    with zipfile.ZipFile(tmp_path / "a.r3d") as whole:
        members = {name: whole.read(name) for name in whole.namelist()}
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_LZMA) as archive:
        for name, data in members.items():
            archive.writestr(name, data)
    data = bytearray(stream.getvalue())
    start = data.index(b"metadata") + len(b"metadata")
    data[start : start + 60] = os.urandom(60)
    (tmp_path / "lzma.r3d").write_bytes(data)
    with pytest.raises(InputError, match="CAP-00[124]"):
        open_recording(tmp_path / "lzma.r3d")
    packed = bytearray(lzfse.compress(np.zeros(200_000, "<f4").tobytes()))
    struct.pack_into("<I", packed, 4, 3072)
    with zipfile.ZipFile(tmp_path / "lzfse.r3d", "w") as archive:
        for name, member in members.items():
            archive.writestr(name, bytes(packed) if name.endswith(".depth") else member)
    recording = open_recording(tmp_path / "lzfse.r3d")
    with pytest.raises(InputError, match=r"CAP-00[18]"):
        recording.read_depth(0)


def _exr(path: Path, header: dict, channels: dict) -> Path:
    with OpenEXR.File(
        {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage, **header}, channels
    ) as file:
        file.write(str(path))
    return path


def test_true_data_window_of_an_exr_is_checked(tmp_path):
    """The first `dataWindow` in the bytes is inside a text attribute; the true one declares 20,000 x 20,000
    pixels.
    """
    path = _exr(
        tmp_path / "a.exr",
        {"a": "dataWindow\0box2i\0\x10\0\0\0" + "\0" * 16},
        {"Z": np.ones((8, 8), np.float16)},
    )
    data = bytearray(path.read_bytes())
    for name in (b"dataWindow\0box2i\0", b"displayWindow\0box2i\0"):
        at = data.rindex(name) + len(name) + 4
        data[at : at + 16] = struct.pack("<4i", 0, 0, 19_999, 19_999)
    path.write_bytes(data)
    with pytest.raises(InputError, match="sensible size"):
        images.read_depth(path)


def test_exr_size_limit_includes_channels(tmp_path):
    channels = {f"c{number:02d}": np.zeros((1200, 1200), np.float16) for number in range(25)}
    assert images.read_depth(_exr(tmp_path / "few.exr", {}, {"Z": np.ones((1200, 1200), np.float16)})).all()
    with pytest.raises(InputError, match="sensible size"):
        images.read_depth(_exr(tmp_path / "many.exr", {}, channels), channel="c00")


def test_full_disk_while_writing_depth_is_reported():
    with pytest.raises(InputError, match="SYS-001"), coded_disk_errors("frames"):
        images.write_depth(Path("/dev/full"), np.ones((64, 64)))


def _movie(path: Path, size: int = 64, **metadata: str) -> Path:
    with av.open(str(path), "w", metadata_encoding="latin-1") as container:
        container.metadata.update(metadata)
        stream = container.add_stream("mpeg4", rate=10)
        stream.width = stream.height = size
        stream.time_base = Fraction(1, 10)
        for number in range(3):
            frame = av.VideoFrame.from_ndarray(
                np.full((size, size, 3), 80 * number, np.uint8), format="rgb24"
            )
            frame.pts = number
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
    return path


def test_latin_1_title_is_accepted(tmp_path):
    movie = movies.Movie(_movie(tmp_path / "a.mp4", title="B\xe4r und M\xfccke"))
    assert len(movie) == 3
    assert movie.read(2).mean() == pytest.approx(160, abs=6)


def test_huge_video_frames_are_refused(tmp_path, monkeypatch):
    _movie(tmp_path / "a.mp4", size=256)
    monkeypatch.setattr(movies, "MAX_PIXELS", 255 * 255)
    with pytest.raises(InputError, match="CAP-001.*larger than any"):
        movies.Movie(tmp_path / "a.mp4")


def test_playlist_is_not_read_as_a_video(tmp_path):
    _movie(tmp_path / "secret.mp4")
    (tmp_path / "a.mp4").write_text("ffconcat version 1.0\nfile secret.mp4\n")
    with pytest.raises(InputError, match="CAP-001"):
        movies.Movie(tmp_path / "a.mp4")


@pytest.mark.parametrize("kind", ["pipe", "link"])
def test_pipes_and_links_are_not_read(tmp_path, kind):
    made_formats.tum(tmp_path / "walk", walk(8))
    listed = tmp_path / "walk" / "rgb.txt"
    listed.rename(tmp_path / "elsewhere.txt")
    if kind == "pipe":
        os.mkfifo(listed)
    else:
        listed.symlink_to(tmp_path / "elsewhere.txt")
    with pytest.raises(InputError, match="CAP-00[13]"):
        open_recording(tmp_path / "walk")


PLY_HEADS = {
    "property before element": "ply\nformat binary_little_endian 1.0\nproperty float x\nelement vertex 0\nend_header\n",
    "400 digits": f"ply\nformat binary_little_endian 1.0\nelement vertex {HUGE}\nproperty float x\nelement face 0\n"
    "property list uchar int vertex_indices\nend_header\n",
    "negative": "ply\nformat binary_little_endian 1.0\nelement vertex -1\nproperty float x\nelement face 0\n"
    "property list uchar int vertex_indices\nend_header\n",
    "same twice": "ply\nformat binary_little_endian 1.0\nelement vertex 0\nproperty float x\nproperty float x\nelement face 0\n"
    "property list uchar int vertex_indices\nend_header\n",
}


@pytest.mark.parametrize("head", PLY_HEADS.values(), ids=PLY_HEADS)
def test_impossible_ply_header_is_refused(tmp_path, head):
    (tmp_path / "a.ply").write_text(head)
    with pytest.raises(InputError, match="ART-020"):
        ply.read_ply(tmp_path / "a.ply")


@pytest.mark.parametrize("number", [HUGE, -1, float("inf"), "x"], ids=["huge", "negative", "inf", "text"])
def test_impossible_frame_numbers_of_clicks_are_refused(tmp_path, number):
    spot = {"recording": "a", "source_index": number, "pixel": [0.5, 0.5]}
    (tmp_path / "clicks.json").write_text(json.dumps({"pairs": [{"seen": spot, "reference": spot}]}))
    with pytest.raises(InputError, match="EVA-001"):
        clicks.read(tmp_path / "clicks.json")


def test_mesh_that_expands_to_gigabytes_is_refused(tmp_path):
    """A sparse accessor stores no bytes for most of its declared elements."""
    folder = made_formats.polycam(tmp_path / "scan", walk(8))
    made_formats.polycam_mesh(folder, trimesh.creation.box(), np.eye(4))
    data = (folder / "raw.glb").read_bytes()
    length = struct.unpack_from("<I", data, 12)[0]
    listed = json.loads(data[20 : 20 + length])
    spot = listed["accessors"][listed["meshes"][0]["primitives"][0]["attributes"]["POSITION"]]
    sparse = {"count": 1, "indices": {"bufferView": 0, "componentType": 5125}, "values": {"bufferView": 1}}
    spot |= {"count": 100_000_000, "sparse": sparse}
    del spot["bufferView"]
    text = json.dumps(listed).encode()
    text += b" " * (-len(text) % 4)
    rest = data[20 + length :]
    head = struct.pack("<4s2I2I", b"glTF", 2, 20 + len(text) + len(rest), len(text), 0x4E4F534A)
    (folder / "raw.glb").write_bytes(head + text + rest)
    recording = open_recording(folder)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(InputError, match="CAP-001"):
        recording.read_mesh()
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 200_000, "kB"


def test_control_characters_are_escaped_in_messages():
    message = str(InputError("CAP-001", "damaged \x1b[2J", "a\x1b]0;x\x07\nb.r3d", "again"))
    assert "\x1b" not in message
    assert message.count("\n") == 1, "only the remedy has a line of its own"


def test_picture_that_expands_to_gigabytes_is_refused(tmp_path):
    png = bytearray(made_formats.png(np.zeros((8, 8), np.uint16)))
    struct.pack_into(">2I", png, 16, 30_000, 30_000)
    struct.pack_into(">I", png, 29, zlib.crc32(png[12:29]))
    jpeg = bytearray(images.encode_jpeg(np.zeros((8, 8, 3), np.uint8)))
    struct.pack_into(">2H", jpeg, jpeg.index(b"\xff\xc0") + 5, 30_000, 30_000)
    for data in (png, jpeg):
        with pytest.raises(InputError, match="CAP-020"):
            images.decode_color(bytes(data), "made")
    (tmp_path / "0.png").write_bytes(png)
    with pytest.raises(InputError, match="CAP-008"):
        containers.FolderContainer(tmp_path).meters("0.png")
