"""Files of behavioral science: movement's netCDF (poses over time) and Neurodata Without Borders."""

import datetime
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from jaxtyping import Float

from pipeline.data.motion import Motion
from pipeline.geometry import rigid
from stages.export.writing import ExportRecord, extra, version

_UNKNOWN_DATE = datetime.datetime(1970, 1, 1, tzinfo=datetime.UTC)


def keypoints(session: Motion) -> Float[np.ndarray, "frame bone 3"]:
    """Return the bones' centers in the world, meters; NaN where the animal is unknown."""
    return (session.world_from_agent[:, None] @ session.agent_from_bone)[..., :3, 3]


def write_movement(folder: Path, sessions: Mapping[str, Motion]) -> ExportRecord:
    """Write `<video>.nc` with the variables, dimensions and attributes that movement reads."""
    xarray = extra("xarray", "xarray")
    extra("h5netcdf", "h5netcdf")
    worst_mm = 0.0
    for video, session in sessions.items():
        places = keypoints(session)
        bones = [f"bone_{bone:02d}" for bone in range(places.shape[1])]
        confidence = np.repeat(session.confidence[:, None], len(bones), 1)
        position = (("time", "space", "keypoints", "individuals"), np.swapaxes(places, 1, 2)[..., None])
        certain = (("time", "keypoints", "individuals"), confidence[..., None])
        time = {"time": session.timestamp_s, "space": list("xyz"), "keypoints": bones}
        rate_hz = round(float(1 / np.median(np.diff(session.timestamp_s))), 4)
        about = {"ds_type": "poses", "fps": rate_hz, "time_unit": "seconds"}
        poses = xarray.Dataset(
            {"position": position, "confidence": certain},
            coords=time | {"individuals": ["agent"]},
            attrs=about | {"source_software": "agent-to-sim"},
        )
        path = folder / f"{video}.nc"
        poses.to_netcdf(path, engine="h5netcdf")
        with xarray.open_dataset(path, engine="h5netcdf") as opened:
            found = np.swapaxes(opened.position.values[..., 0], 1, 2)
        worst_mm = max(worst_mm, float(np.nanmax(np.abs(found - places))) * 1000)
    remark = "meters, world frame (+y up); confidence is the frame's"
    return ExportRecord(version("xarray"), {"largest": worst_mm}, version("h5netcdf"), remark)


def write_nwb(folder: Path, sessions: Mapping[str, Motion]) -> ExportRecord:
    """Write `<video>.nwb`: position and heading of the animal, its bones, and the observer."""
    pynwb = extra("pynwb", "pynwb")
    behavior = extra("pynwb.behavior", "pynwb")
    worst_mm = 0.0
    for video, session in sessions.items():
        file = pynwb.NWBFile("behavior of one animal, from video", video, _UNKNOWN_DATE)
        about = "where animal and observer are, meters, world frame, +y up"
        module = file.create_processing_module("behavior", about)
        time = {"timestamps": session.timestamp_s}
        place = session.world_from_agent[:, :3, 3]
        series = [
            behavior.SpatialSeries(
                name=name, data=data, reference_frame="x, y up, z of the room; meters", unit="meters", **time
            )
            for name, data in (("agent", place), ("observer", session.world_from_camera[:, :3, 3]))
        ]
        module.add(behavior.Position(spatial_series=series))
        turn = np.full((len(place), 4), np.nan)
        known = np.isfinite(place).all(1)
        turn[known] = rigid.quaternion_from_rotation(session.world_from_agent[known, :3, :3])
        module.add(pynwb.TimeSeries(name="rotation", data=turn, unit="quaternion wxyz", **time))
        module.add(pynwb.TimeSeries(name="bones", data=keypoints(session), unit="meters", **time))
        module.add(pynwb.TimeSeries(name="confidence", data=session.confidence, unit="probability", **time))
        path = folder / f"{video}.nwb"
        with pynwb.NWBHDF5IO(str(path), "w") as out:
            out.write(file)
        with pynwb.NWBHDF5IO(str(path), "r") as opened:
            found = opened.read().processing["behavior"]["bones"].data[:]
        worst_mm = max(worst_mm, float(np.nanmax(np.abs(found - keypoints(session)))) * 1000)
    remark = "recordings do not say when they were made: the session's start stands as 1970-01-01"
    return ExportRecord(version("pynwb"), {"largest": worst_mm}, version("pynwb"), remark)
