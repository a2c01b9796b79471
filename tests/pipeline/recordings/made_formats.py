"""Writers of the same short walk through a room in the format of every supported app and data set."""

import json
from fractions import Fraction
from pathlib import Path

import av
import cv2
import numpy as np
import trimesh

from pipeline.data import images
from pipeline.geometry import cameras
from tests.stages.extract_frames.made_recordings import Made, write_zip

START_S = 65575.6
"""device uptime at the start of Stray Scanner and TUM recordings"""


def png(image: np.ndarray) -> bytes:
    return cv2.imencode(".png", image)[1].tobytes()


def millimeters(depth: np.ndarray, per_meter: float = 1000) -> np.ndarray:
    return np.rint(depth * per_meter).astype(np.uint16)


def put(folder: Path, members: dict[str, bytes | str]) -> Path:
    for name, data in members.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(data.encode() if isinstance(data, str) else data)
    return folder


def write_movie(
    path: Path,
    pictures: list[np.ndarray],
    *,
    rate: int = 60,
    key_every: int = 8,
    codec: str = "libx264",
    options: dict[str, str] | None = None,
    tags: dict[str, str] | None = None,
    aspect: Fraction = Fraction(1),
    pixels: str = "yuv444p",
) -> None:
    """Write a video; `tags` are container tags, `aspect` is the pixel aspect ratio."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with av.open(str(path), "w", options={"movflags": "use_metadata_tags"} if tags else {}) as container:
        container.metadata.update(tags or {})
        encoder = {"crf": "4", "preset": "ultrafast", "g": str(key_every)} if options is None else options
        stream = container.add_stream(codec, rate=rate, options=encoder)
        stream.codec_context.sample_aspect_ratio = aspect
        stream.height, stream.width, stream.pix_fmt = *pictures[0].shape[:2], pixels
        stream.time_base = Fraction(1, rate)
        for number, picture in enumerate(pictures):
            frame = av.VideoFrame.from_ndarray(picture, format="rgb24")
            frame.pts = number
            container.mux(stream.encode(frame))
        container.mux(stream.encode())


def stored_cameras(made: Made) -> np.ndarray:
    """World-from-camera poses with OpenCV axes of the stored pictures."""
    return made.stored_from_upright(made.world_from_camera)


def quaternion_poses(made: Made) -> np.ndarray:
    """[frame 7] qx qy qz qw x y z with OpenCV axes; every second quaternion has the opposite sign, as in some
    apps.
    """
    from pipeline.recordings.recording import pose_from_matrix

    pose = pose_from_matrix(stored_cameras(made))
    pose[1::2, :4] *= -1
    return pose


def coefficients(made: Made) -> np.ndarray:
    return made.intrinsics[[0, 1, 0, 1], [0, 1, 2, 2]]


def stray(folder: Path, made: Made, columns: int = 15) -> Path:
    frames = range(len(made.timestamp_s))
    write_movie(folder / "rgb.mp4", [made.color(i) for i in frames])
    scale = np.array([1920, 1440] * 2) / np.array(made.color(0).shape[1::-1] * 2)
    fx, fy, cx, cy = coefficients(made) * scale
    header = "timestamp, frame, x, y, z, qx, qy, qz, qw"
    header += ", fx, fy, cx, cy, distortion_center_x, distortion_center_y" if columns == 15 else ""
    rows = [] if columns == 7 else [header]
    for i, pose in enumerate(quaternion_poses(made)):
        cells = [START_S + made.timestamp_s[i], f"{i:06d}", *pose[4:], *pose[:4]]
        cells = cells[2:] if columns == 7 else cells + ([fx, fy, cx, cy, "", ""] if columns == 15 else [])
        rows.append(", ".join(map(str, cells)))
    members = {
        "odometry.csv": "\n".join(rows),
        "camera_matrix.csv": f"{fx}, 0.0, {cx}\n0.0, {fy}, {cy}\n0.0, 0.0, 1.0",
    }
    for i in frames:
        members[f"depth/{i:06d}.png"] = png(millimeters(made.depth(i)))
        members[f"confidence/{i:06d}.png"] = png(np.full(made.depth(i).shape, 1, np.uint8))
    return put(folder, members)


def polycam(folder: Path, made: Made, corrected: bool = False) -> Path:
    members: dict[str, bytes | str] = {"thumbnail.jpg": images.encode_jpeg(made.color(0))}
    parts = ("corrected_images", "corrected_cameras") if corrected else ("images", "cameras")
    fx, fy, cx, cy = coefficients(made)
    for i, camera in enumerate(cameras.opencv_from_opengl(stored_cameras(made))):
        stem = str(1_600_000_000 + round(1e6 * made.timestamp_s[i]))
        height, width = made.color(i).shape[:2]
        table = dict(fx=fx, fy=fy, cx=cx, cy=cy, width=width, height=height, blur_score=100)
        table |= {f"t_{row}{column}": camera[row, column] for row in range(3) for column in range(4)}
        members[f"keyframes/{parts[0]}/{stem}.jpg"] = images.encode_jpeg(made.color(i))
        members[f"keyframes/{parts[1]}/{stem}.json"] = json.dumps(table)
        members[f"keyframes/depth/{stem}.png"] = png(millimeters(made.depth(i)))
        members[f"keyframes/confidence/{stem}.png"] = png(np.full(made.depth(i).shape, 54, np.uint8))
    return put(folder, members)


def polycam_mesh(folder: Path, mesh: trimesh.Trimesh, aligned_from_world: np.ndarray) -> None:
    """Add the mesh of the app, in its own axes, and the transform beside it."""
    (folder / "raw.glb").write_bytes(mesh.copy().apply_transform(aligned_from_world).export(file_type="glb"))
    (folder / "mesh_info.json").write_text(
        json.dumps({"alignmentTransform": aligned_from_world.T.ravel().tolist()})
    )


def nerfcapture(folder: Path, made: Made, reach_m: float = 8.0) -> Path:
    """The streamed folder: depth upsampled to the picture, with a scale in meters for 16 bits."""
    members, frames, scale = {}, [], reach_m / 65535
    fl_x, fl_y, cx, cy = coefficients(made)
    for i, camera in enumerate(cameras.opencv_from_opengl(stored_cameras(made))):
        size = made.color(i).shape[1::-1]
        members[f"rgb/{i}.png"] = png(made.color(i)[..., ::-1])
        members[f"depth/{i}.png"] = png(
            cv2.resize(millimeters(made.depth(i), 1 / scale), size, interpolation=cv2.INTER_NEAREST)
        )
        names = dict(file_path=f"rgb/{i}.png", depth_path=f"depth/{i}.png")
        frames.append(
            names | dict(transform_matrix=camera.tolist(), timestamp=float(made.timestamp_s[i]), cx=cx, cy=cy)
        )
    table = dict(fl_x=fl_x, fl_y=fl_y, integer_depth_scale=scale, frames=frames[::-1])
    return put(folder, members | {"transforms.json": json.dumps(table)})


def nerfcapture_zip(path: Path, made: Made) -> Path:
    """The archive that the phone saves, with depth that is not metric."""
    frames = [dict(file_path="images/0", transform_matrix=np.eye(4).tolist(), timestamp=0.0)]
    table = dict(w=48, h=64, fl_x=50.0, fl_y=50.0, cx=24.0, cy=32.0, depth_integer_scale=1.0, frames=frames)
    write_zip(path, {"transforms.json": json.dumps(table).encode(), "images/0.png": png(made.color(0))})
    return path


def tum(folder: Path, made: Made, poses: bool = True, per_meter: float = 5000) -> Path:
    """Depth and poses have timestamps some milliseconds after color, as from separate sensors."""
    times = START_S + made.timestamp_s
    members: dict[str, bytes | str] = {"intrinsics.txt": " ".join(map(str, coefficients(made)))}
    for i, time in enumerate(times):
        members[f"rgb/{time:.6f}.png"] = png(made.color(i)[..., ::-1])
        members[f"depth/{time + 0.004:.6f}.png"] = png(millimeters(made.depth(i), per_meter))
    members["rgb.txt"] = "# color\n" + "\n".join(f"{time:.6f} rgb/{time:.6f}.png" for time in times)
    members["depth.txt"] = "# depth\n" + "\n".join(
        f"{time + 0.004:.6f} depth/{time + 0.004:.6f}.png" for time in times
    )
    lines = [
        " ".join(map(str, [t + 0.002, *p[4:], *p[:4]]))
        for t, p in zip(times, quaternion_poses(made), strict=True)
    ]
    return put(
        folder,
        members | ({"groundtruth.txt": "# time tx ty tz qx qy qz qw\n" + "\n".join(lines)} if poses else {}),
    )


def seven_scenes(folder: Path, made: Made, poses: bool = True) -> Path:
    members: dict[str, bytes | str] = {
        "camera-intrinsics.txt": "\n".join(" ".join(map(str, row)) for row in made.intrinsics)
    }
    for i, camera in enumerate(stored_cameras(made)):
        number = round(30 * made.timestamp_s[i])
        members[f"frame-{number:06d}.color.png"] = png(made.color(i)[..., ::-1])
        members[f"frame-{number:06d}.depth.png"] = png(millimeters(made.depth(i)))
        if poses:
            members[f"frame-{number:06d}.pose.txt"] = "\n".join(
                "\t".join(f"{x:.9e}" for x in row) for row in camera
            )
    return put(folder, members)


def video_and_depth(folder: Path, made: Made, poses: bool = True) -> Path:
    frames = range(len(made.timestamp_s))
    write_movie(folder / "clip.mov", [made.color(i) for i in frames], rate=15)
    members: dict[str, bytes | str] = {f"depth/{i:06d}.png": png(millimeters(made.depth(i))) for i in frames}
    members["intrinsics.txt"] = "\n".join(" ".join(map(str, row)) for row in made.intrinsics)
    lines = [" ".join(map(str, [i, *p[4:], *p[:4]])) for i, p in enumerate(quaternion_poses(made))]
    return put(folder, members | ({"poses.txt": "\n".join(lines)} if poses else {}))
