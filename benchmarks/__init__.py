"""Time and memory, measured on builds, and figures on real data (`real`); never in tests."""
