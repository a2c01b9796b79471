"""Long-term motion in 3D scenes (LTM): networks, synthesis and physical optimization."""
