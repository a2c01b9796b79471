"""Reconstruct scene, agent and motion in 4D from registered recordings."""
