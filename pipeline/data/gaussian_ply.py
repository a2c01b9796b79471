"""Standard files of 3D Gaussians: binary PLY of 62 floats (248 bytes) a row, as read by 3DGS viewers."""

from pathlib import Path

import numpy as np
from jaxtyping import Float

from pipeline.core.errors import InputError
from pipeline.data.schema import FileSchema

COLUMNS = (
    ["x", "y", "z", "nx", "ny", "nz"] + [f"f_dc_{i}" for i in range(3)] + [f"f_rest_{i}" for i in range(45)]
    + ["opacity"] + [f"scale_{i}" for i in range(3)] + [f"rot_{i}" for i in range(4)]
)  # fmt: skip
"""opacity as logit, scale as natural logarithm of meters, rotation as quaternion wxyz"""
SPLATS = FileSchema.of(
    "splats/splats.npz",
    "agent_weights [point bone] f4",
    "agent_from_bone_rest [bone 4 4] f4",
    "videos [video] U",
    "stands [video row] bool",
    "appearance [video 3 4] f4",
)
_END = b"end_header\n"


def write(path: Path, rows: Float[np.ndarray, "point 62"]) -> None:
    """Write rows of `COLUMNS`."""
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(rows)}"]
    header += [*(f"property float {name}" for name in COLUMNS), ""]
    Path(path).write_bytes("\n".join(header).encode() + _END + rows.astype("<f4").tobytes())


def read(path: Path) -> Float[np.ndarray, "point 62"]:
    """Read rows of `COLUMNS`. Raises InputError ART-021 for any other file."""
    head, _, data = Path(path).read_bytes().partition(_END)
    lines = head.decode("ascii", "replace").splitlines()
    names = [line.split()[-1] for line in lines if line.startswith("property ")]
    if "format binary_little_endian 1.0" not in lines or names != COLUMNS or len(data) % (4 * len(COLUMNS)):
        what = "not a file of 3D Gaussians with 62 floats a row"
        raise InputError("ART-021", what, str(path), "rebuild `splats`")
    return np.frombuffer(data, "<f4").reshape(-1, len(COLUMNS))
