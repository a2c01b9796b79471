"""The behaviour model as a program and as a gymnasium-style environment.

`simulator` chains plans behind `reset` and `step`, `observers` scripts the person, `rollout` records a take.
"""
