"""Feature, flow and segmentation backends that are weight-free or load published checkpoints."""
