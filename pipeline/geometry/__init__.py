"""Rigid transforms, cameras, meshes, rays and volumes. Knows no files and no models."""
