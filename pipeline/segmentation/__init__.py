"""Segmentation of the animal by appearance: a network trained per recording, and GrabCut."""
