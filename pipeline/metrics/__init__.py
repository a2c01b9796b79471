"""Metrics: best-of-K errors, energy score, bootstrap intervals."""
