"""Files of behavioural science: movement's netCDF (poses over time) and Neurodata Without Borders."""

import datetime
from pathlib import Path

import numpy as np
from jaxtyping import Float

from pipeline.geometry import rigid
from stages.export.reading import Session
from stages.export.writing import ExportRecord, extra, version

_UNKNOWN_DATE = datetime.datetime(1970, 1, 1, tzinfo=datetime.UTC)


def keypoints(session: Session) -> Float[np.ndarray, "frame bone 3"]:
    """Return the bones' centres in the world, metres; NaN where the animal is unknown."""
    return (session.world_from_agent[:, None] @ session.agent_from_bone)[..., :3, 3]


def write_movement(folder: Path, sessions: list[Session]) -> ExportRecord:
    """Write `<video>.nc` with the variables, dimensions and attributes that movement reads."""
    xarray = extra("xarray", "xarray")
    extra("h5netcdf", "h5netcdf")
    worst_mm = 0.0
    for session in sessions:
        places = keypoints(session)
        bones = [f"bone_{bone:02d}" for bone in range(places.shape[1])]
        confidence = np.repeat(session.confidence[:, None], len(bones), 1)
        poses = xarray.Dataset(
            {
                "position": (
                    ("time", "space", "keypoints", "individuals"),
                    np.swapaxes(places, 1, 2)[..., None],
                ),
                "confidence": (("time", "keypoints", "individuals"), confidence[..., None]),
            },
            coords={
                "time": session.timestamp_s,
                "space": list("xyz"),
                "keypoints": bones,
                "individuals": ["agent"],
            },
            attrs={
                "ds_type": "poses",
                "fps": _rate_hz(session),
                "time_unit": "seconds",
                "source_software": "agent-to-sim",
            },
        )
        path = folder / f"{session.video}.nc"
        poses.to_netcdf(path, engine="h5netcdf")
        with xarray.open_dataset(path, engine="h5netcdf") as opened:
            found = np.swapaxes(opened.position.values[..., 0], 1, 2)
        worst_mm = max(worst_mm, float(np.nanmax(np.abs(found - places))) * 1000)
    return ExportRecord(
        version("xarray"),
        {"largest": worst_mm},
        version("h5netcdf"),
        "metres, world frame (+y up); confidence is the frame's",
    )


def write_nwb(folder: Path, sessions: list[Session]) -> ExportRecord:
    """Write `<video>.nwb`: position and heading of the animal, its bones, and the observer."""
    pynwb = extra("pynwb", "pynwb")
    behavior = extra("pynwb.behavior", "pynwb")
    worst_mm = 0.0
    for session in sessions:
        file = pynwb.NWBFile("behaviour of one animal, from video", session.video, _UNKNOWN_DATE)
        module = file.create_processing_module(
            "behavior", "where animal and observer are, metres, world frame, +y up"
        )
        time = {"timestamps": session.timestamp_s}
        place, frame = session.world_from_agent[:, :3, 3], "x, y up, z of the room; metres"
        series = behavior.SpatialSeries(
            name="agent", data=place, reference_frame=frame, unit="meters", **time
        )
        observer = behavior.SpatialSeries(
            name="observer",
            data=session.world_from_camera[:, :3, 3],
            reference_frame=frame,
            unit="meters",
            **time,
        )
        module.add(behavior.Position(spatial_series=[series, observer]))
        turn = np.full((len(place), 4), np.nan)
        known = np.isfinite(place).all(1)
        turn[known] = rigid.quaternion_from_rotation(session.world_from_agent[known, :3, :3])
        module.add(pynwb.TimeSeries(name="rotation", data=turn, unit="quaternion wxyz", **time))
        module.add(pynwb.TimeSeries(name="bones", data=keypoints(session), unit="meters", **time))
        module.add(pynwb.TimeSeries(name="confidence", data=session.confidence, unit="probability", **time))
        path = folder / f"{session.video}.nwb"
        with pynwb.NWBHDF5IO(str(path), "w") as out:
            out.write(file)
        with pynwb.NWBHDF5IO(str(path), "r") as opened:
            found = opened.read().processing["behavior"]["bones"].data[:]
        worst_mm = max(worst_mm, float(np.nanmax(np.abs(found - keypoints(session)))) * 1000)
    remark = "recordings do not say when they were made: the session's start stands as 1970-01-01"
    return ExportRecord(version("pynwb"), {"largest": worst_mm}, version("pynwb"), remark)


def _rate_hz(session: Session) -> float:
    return round(float(1 / np.median(np.diff(session.timestamp_s))), 4)
