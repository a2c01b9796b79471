"""Build the scene template: structure from motion, metric scale and gravity, depth fused to a mesh."""
