"""Time and memory, measured on builds; never in tests."""
