"""The rooms. Each `__main__.py` is a program of its own; `pipeline/workflow/dag.py` has their order."""
