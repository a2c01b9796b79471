"""File formats: round trips, deterministic bytes, and refusal of damaged files."""

import struct

import numpy as np
import pytest

from pipeline.core.errors import InputError
from pipeline.data import images, npz, ply
from pipeline.geometry.meshes import Mesh


def test_row_writer_gives_the_same_file_as_save(tmp_path):
    rng = np.random.default_rng(0)
    flow = rng.normal(size=(5, 4, 3, 2)).astype(np.float16)
    flags = rng.integers(0, 255, (5, 4), dtype=np.uint8)
    npz.save(tmp_path / "whole.npz", flow=flow, flags=flags)
    with npz.Rows(
        tmp_path / "rows.npz", flow=(flow.shape, np.float16), flags=(flags.shape, np.uint8)
    ) as table:
        for one, other in zip(flow, flags, strict=True):
            table.append(flow=one, flags=other)
    assert (tmp_path / "rows.npz").read_bytes() == (tmp_path / "whole.npz").read_bytes()
    with npz.Rows(tmp_path / "none.npz", flow=((0, 4, 3, 2), np.float16)):
        pass
    assert npz.open_lazily(tmp_path / "none.npz", "flow").shape == (0, 4, 3, 2)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["none.npz", "rows.npz", "whole.npz"]


def test_depth_is_stored_as_half_floats_in_meters(tmp_path):
    depth = np.random.default_rng(0).uniform(0.2, 5, (64, 48)).astype(np.float32)
    depth[:5] = 0
    images.write_depth(tmp_path / "a.exr", depth)
    back = images.read_depth(tmp_path / "a.exr")
    assert back.dtype == np.float32 and np.array_equal(back, depth.astype(np.float16).astype(np.float32))
    first = (tmp_path / "a.exr").read_bytes()
    images.write_depth(tmp_path / "a.exr", depth)
    assert first == (tmp_path / "a.exr").read_bytes()


def test_invalid_depth_is_unknown(tmp_path):
    images.write_depth(tmp_path / "a.exr", np.array([[np.nan, np.inf, -1, 2]], np.float32))
    assert images.read_depth(tmp_path / "a.exr").tolist() == [[0, 0, 0, 2]]


def test_huge_exr_is_refused_before_decoding(tmp_path):
    images.write_depth(tmp_path / "a.exr", np.ones((4, 4), np.float32))
    data = bytearray((tmp_path / "a.exr").read_bytes())
    at = data.find(b"dataWindow\0box2i\0") + 21
    struct.pack_into("<4i", data, at, 0, 0, 60000, 60000)
    (tmp_path / "a.exr").write_bytes(data)
    with pytest.raises(InputError, match="CAP-022"):
        images.read_depth(tmp_path / "a.exr")


def test_lossless_pictures_round_trip(tmp_path):
    color = np.random.default_rng(0).integers(0, 256, (20, 30, 3), np.uint8)
    images.write_color(tmp_path / "a.png", color)
    assert np.array_equal(images.read_color(tmp_path / "a.png"), color)
    images.write_gray(tmp_path / "b.png", color[..., 0])
    assert np.array_equal(images.read_gray(tmp_path / "b.png"), color[..., 0])
    with pytest.raises(InputError, match="CAP-020"):
        images.decode_color(b"not a picture", "somewhere")


def test_arrays_round_trip_with_deterministic_bytes(tmp_path):
    data = {
        "v002/pose": np.random.default_rng(0).normal(size=(5, 4, 4)),
        "flag": np.array(True),
        "names": np.array(["a", "bc"]),
    }
    for name in ("a.npz", "b.npz"):
        npz.save(tmp_path / name, **data)
    assert (tmp_path / "a.npz").read_bytes() == (tmp_path / "b.npz").read_bytes()
    back = npz.load(tmp_path / "a.npz")
    assert back.keys() == data.keys() and all(np.array_equal(back[k], data[k]) for k in data)
    assert np.array_equal(npz.open_lazily(tmp_path / "a.npz", "v002/pose"), data["v002/pose"])


def test_pickles_damage_and_missing_arrays_are_refused(tmp_path):
    np.savez(tmp_path / "pickle.npz", bad=np.array([{}], dtype=object))
    npz.save(tmp_path / "good.npz", a=np.arange(5))
    (tmp_path / "cut.npz").write_bytes((tmp_path / "good.npz").read_bytes()[:40])
    for path, names in (("pickle.npz", None), ("cut.npz", None), ("good.npz", ("b",))):
        with pytest.raises(InputError, match="ART-010"):
            npz.load(tmp_path / path, names)


def test_meshes_round_trip_and_damage_is_refused(tmp_path):
    rng = np.random.default_rng(0)
    mesh = Mesh(
        rng.normal(size=(10, 3)).astype(np.float32),
        rng.integers(0, 10, (6, 3)).astype(np.int32),
        rng.integers(0, 256, (10, 3), np.uint8),
    )
    ply.write_ply(tmp_path / "a.ply", mesh, nx=np.zeros(10))
    back = ply.read_ply(tmp_path / "a.ply")
    assert (
        np.array_equal(back.vertices, mesh.vertices)
        and np.array_equal(back.faces, mesh.faces)
        and np.array_equal(back.color, mesh.color)
    )
    (tmp_path / "a.ply").write_bytes((tmp_path / "a.ply").read_bytes()[:-8])
    for unreadable in ("a.ply", "missing.ply", "."):
        with pytest.raises(InputError, match="ART-020"):
            ply.read_ply(tmp_path / unreadable)


@pytest.mark.parametrize(("kind", "full"), [("<f4", 1), ("<f8", 1), ("u1", 255), ("<u2", 65535)])
def test_meshes_of_other_programs_are_read(tmp_path, kind, full):
    """A header with Windows line ends, and colors of any type."""
    names = {"<f4": "float", "<f8": "double", "u1": "uchar", "<u2": "ushort"}
    color = np.array([[0, 51, 255], [255, 102, 0], [204, 0, 153]], np.uint8)
    table = np.zeros(
        3, [*((axis, "<f4") for axis in "xyz"), *((name, kind) for name in ("red", "green", "blue"))]
    )
    table["x"], table["y"] = [0, 1, 0], [0, 0, 1]
    for name, values in zip(("red", "green", "blue"), color.T / 255 * full, strict=True):
        table[name] = values
    header = ["ply", "format binary_little_endian 1.0", "comment end_header is below", "element vertex 3"]
    header += [*(f"property float {axis}" for axis in "xyz")]
    header += [*(f"property {names[kind]} {name}" for name in ("red", "green", "blue"))]
    header += ["element face 1", "property list uchar int vertex_indices", "end_header", ""]
    faces = bytes([3]) + np.arange(3, dtype="<i4").tobytes()
    (tmp_path / "a.ply").write_bytes("\r\n".join(header).encode() + table.tobytes() + faces)
    mesh = ply.read_ply(tmp_path / "a.ply")
    np.testing.assert_array_equal(mesh.color, color)
    np.testing.assert_array_equal(mesh.vertices[:, :2], [[0, 0], [1, 0], [0, 1]])
    table["red"] = -1.0 if kind.startswith("<f") else 0
    (tmp_path / "a.ply").write_bytes("\n".join(header).encode() + table.tobytes() + faces)
    if kind.startswith("<f"):
        with pytest.raises(InputError, match="ART-020.*colors"):
            ply.read_ply(tmp_path / "a.ply")
    else:
        assert (ply.read_ply(tmp_path / "a.ply").color[:, 0] == 0).all()


def test_damaged_mask_is_refused(tmp_path):
    (tmp_path / "a.png").write_bytes(b"not a picture")
    with pytest.raises(InputError, match="CAP-021"):
        images.read_gray(tmp_path / "a.png")


def test_srgb_and_linear_are_inverse_and_continuous():
    srgb = np.linspace(0, 1, 256)
    linear = images.linear_from_srgb(srgb)
    assert np.allclose(images.srgb_from_linear(linear), srgb, atol=1e-6)
    assert np.all(np.diff(linear) > 0) and linear[128] == pytest.approx(0.2158605, abs=1e-6)
