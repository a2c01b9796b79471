"""Measure a build: against truth where there is truth, against simple baselines everywhere.

The only stage that reads truth. `reading` opens artifacts and brings truth into our frames (one SE(3) from
the walk-through's cameras, one constant agent SE(3) from the turnaround); `registration`, `localizing`,
`perception`, `heldout`, `surfaces` and `behavior` each return `Metrics`.
"""
