"""Simulated motion of the built-in animal in several homes, without pictures, with the homes' surfaces: for
long-term motion."""
