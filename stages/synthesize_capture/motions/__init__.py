"""Simulated motion of the built-in animal in several homes with surfaces: for long-term motion."""
