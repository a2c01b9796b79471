"""The page of all animals of a home."""
