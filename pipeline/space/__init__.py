"""Geometry: rigid motions, cameras, alignment, meshes and rays. Knows no files and no models."""
