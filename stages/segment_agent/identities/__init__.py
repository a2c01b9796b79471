"""Train the network that distinguishes the animals of a home, on all their turnarounds."""
