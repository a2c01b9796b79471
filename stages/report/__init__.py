"""The report of a build: the quality checks of every stage, on self-contained pages."""
