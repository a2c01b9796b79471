"""Show all built animals on one page."""
