"""Canonical fields and Gaussians of scene and agent, skinning and rendering."""
