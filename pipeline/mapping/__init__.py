"""Camera motion and maps from measurements: COLMAP, ICP, visual odometry, pose graphs, pose optimization."""
