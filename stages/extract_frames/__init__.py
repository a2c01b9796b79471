"""Turn one recording into frames at 10 Hz: upright, metric depth, per-frame intrinsics, odometry."""
