"""Learn what the animals of a home look like, from all their turnarounds."""
