"""Turn one recording into frames at 10 Hz: upright, metric depth, per-frame intrinsics, odometry.

`pipeline.recordings` reads and understands the recording, `writing` fills the artifact and checks its
quality.
"""
