"""Build the scene template: structure from motion, metric scale and gravity, depth fusion to a coloured
mesh."""
