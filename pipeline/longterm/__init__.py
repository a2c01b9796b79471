"""Long-term motion in 3D scenes (paper 002): networks, synthesis and physical optimization."""
