"""Turn one phone recording into frames at 10 Hz: upright, metric depth, per-frame intrinsics, odometry.

`record3d` reads the recording through a guarded `containers`, `selection` picks frames by time, `conventions` checks
on the depth what the device poses mean, `upright` finds the quarter turns, `extraction` puts them together, `writing`
fills the artifact.

Errors: CAP-001 damaged container, CAP-002 unsafe archive, CAP-003 not a recording, CAP-004 broken metadata, CAP-005
Face-ID recording, CAP-006 no depth, CAP-007 no usable frames, CAP-008 wrong depth size, CAP-020 broken picture,
CAP-022 broken EXR.
"""
