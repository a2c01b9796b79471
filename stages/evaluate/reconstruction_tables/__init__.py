"""Table 3: the reconstruction and its rivals, seen by the held-out phone, side by side."""
