"""Learned flow in place of search: same gaps, same grid, same confidence."""
