"""Learned segmentation in place of motion and space: the same masks."""
