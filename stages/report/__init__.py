"""The report of a build: what every stage said about itself, on pages that can be sent."""
