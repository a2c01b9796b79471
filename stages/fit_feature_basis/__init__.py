"""Fit one linear feature basis to all recordings that models may learn from."""
