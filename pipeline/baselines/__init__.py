"""Baselines that behavior and long-term motion are compared with."""
