"""Motion measured elsewhere: tables of trajectories and motion capture, instead of recordings.

`tables` reads CSV, `captured` joint positions, and `lives` complete motion; `obstacles` converts an obstacle
map to a volume. All return `MeasuredMotion`.

Errors: TRJ-001 a table that cannot be understood, TRJ-002 no motion in it.
"""
