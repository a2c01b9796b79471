"""Motion that was measured elsewhere: tables of trajectories and motion capture, in place of recordings and
all that follows.

`tables` reads CSV, `captured` reads joint positions, `lives` reads what is complete already; `obstacles`
makes a volume of an obstacle map. All end as `MeasuredMotion`.

Errors: TRJ-001 a table that cannot be understood, TRJ-002 no motion in it.
"""
