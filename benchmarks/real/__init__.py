"""Metrics on public real data, with those of other methods.

    make real-benchmark DATA=folder

`rows` lists the rows and the expected layout of their data; `walkers`, `captured_dog`, `masks`, `flow` and `rooms`
measure one row each and return a `table.Row`; `__main__` prints the table and writes it as Markdown and JSON. Rows
without data are skipped, with the expected layout.
"""
