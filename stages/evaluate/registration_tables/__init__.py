"""Table 1: the registration and its ablations against truth, side by side."""
