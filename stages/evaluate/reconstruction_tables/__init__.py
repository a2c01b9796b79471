"""Table 3: the reconstruction and its baselines, seen by the held-out phone, side by side."""
