"""PLY meshes, binary little-endian: positions, optional color and any per-vertex float properties.

`write_ply` and `read_ply` are exact inverses for float32 data. Reading checks counts, indices and finiteness.
"""

import re
from pathlib import Path

import numpy as np
from jaxtyping import Float, Shaped, UInt8

from pipeline.core.errors import InputError
from pipeline.geometry.meshes import Mesh

_TYPES = {
    "float": "<f4", "float32": "<f4", "double": "<f8", "float64": "<f8",
    "uchar": "u1", "uint8": "u1", "char": "i1", "int8": "i1",
    "short": "<i2", "int16": "<i2", "ushort": "<u2", "uint16": "<u2",
    "int": "<i4", "int32": "<i4", "uint": "<u4", "uint32": "<u4",
}  # fmt: skip
_COLOR = ("red", "green", "blue")


def write_ply(path: Path, mesh: Mesh, **properties: Float[np.ndarray, "vertex"]) -> None:
    """Write a mesh; each extra property becomes a float column of the vertices."""
    columns = [("x", "<f4"), ("y", "<f4"), ("z", "<f4")]
    columns += [(name, "<f4") for name in properties]
    colors = {} if mesh.color is None else dict(zip(_COLOR, mesh.color.T, strict=True))
    columns += [(name, "u1") for name in colors]
    table = np.zeros(len(mesh.vertices), columns)
    for name, values in {**dict(zip("xyz", mesh.vertices.T, strict=True)), **properties, **colors}.items():
        table[name] = values
    faces = np.zeros(len(mesh.faces), [("count", "u1"), ("index", "<i4", 3)])
    faces["count"], faces["index"] = 3, mesh.faces
    names = {"<f4": "float", "u1": "uchar"}
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(table)}"]
    header += [f"property {names[kind]} {name}" for name, kind in columns]
    header += [f"element face {len(faces)}", "property list uchar int vertex_indices", "end_header", ""]
    Path(path).write_bytes("\n".join(header).encode() + table.tobytes() + faces.tobytes())


def read_ply(path: Path) -> Mesh:
    """Read a binary triangle mesh. Raises InputError ART-020 for damaged and other files."""
    try:
        return _parse(Path(path).read_bytes())
    except (FileNotFoundError, IsADirectoryError) as error:
        why = f"cannot be read: {error.strerror}"
        raise InputError("ART-020", why, str(path), "build it again") from error
    except (ValueError, IndexError, KeyError, TypeError, OverflowError) as error:
        what, remedy = f"not a binary PLY of triangles: {error}", "export it as binary little-endian PLY"
        raise InputError("ART-020", what, str(path), remedy) from error


def _parse(data: bytes) -> Mesh:
    last = re.search(rb"^end_header\r?\n", data, re.MULTILINE)
    if last is None:
        raise ValueError("its header has no end")
    end = last.end()
    lines = [line.split() for line in data[:end].decode("ascii", "replace").splitlines()]
    if ["format", "binary_little_endian", "1.0"] not in lines:
        raise ValueError("only binary_little_endian 1.0 is read")
    elements: list[tuple[str, int, list[list[str]]]] = []
    for line in lines:
        if line[:1] == ["element"]:
            elements.append((line[1], int(line[2]), []))
        elif line[:1] == ["property"]:
            elements[-1][2].append(line[1:])
    if any(not 0 <= count <= len(data) for _, count, _ in elements):
        raise ValueError("the file is shorter than its header declares")
    if [name for name, _, _ in elements][:2] != ["vertex", "face"]:
        raise ValueError("it needs the elements vertex and face, in this order")
    (_, vertex_count, vertex_columns), (_, face_count, face_columns) = elements[:2]
    row = np.dtype([(name, _TYPES[kind]) for kind, name in vertex_columns])
    if len(face_columns) != 1 or face_columns[0][0] != "list":
        raise ValueError("faces must be one index list")
    face_row = np.dtype([("count", _TYPES[face_columns[0][1]]), ("index", _TYPES[face_columns[0][2]], 3)])
    if end + vertex_count * row.itemsize + face_count * face_row.itemsize > len(data):
        raise ValueError("the file is shorter than its header declares")
    table = np.frombuffer(data, row, vertex_count, end)
    faces = np.frombuffer(data, face_row, face_count, end + table.nbytes)
    vertices = np.stack([table[axis] for axis in "xyz"], axis=-1).astype(np.float32)
    index = faces["index"].astype(np.int32)
    if face_count and ((faces["count"] != 3).any() or index.min() < 0 or index.max() >= vertex_count):
        raise ValueError("faces are not triangles of existing vertices")
    if not np.isfinite(vertices).all():
        raise ValueError("vertices are not finite")
    has_color = set(_COLOR) <= {name for _, name in vertex_columns}
    color = np.stack([table[name] for name in _COLOR], axis=-1) if has_color else None
    return Mesh(vertices, index, None if color is None else _bytes(color))


def _bytes(color: Shaped[np.ndarray, "vertex 3"]) -> UInt8[np.ndarray, "vertex 3"]:
    """Return colors as bytes: floats are 0..1, integers up to the most that their type holds."""
    full = np.iinfo(color.dtype).max if color.dtype.kind in "iu" else 1
    if not ((color >= 0) & (color <= full)).all():
        raise ValueError(f"colors are not within 0 and {full}")
    return np.rint(color / full * 255).astype(np.uint8)
