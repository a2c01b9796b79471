"""Figures on public real data, each beside its peers.

    make real-benchmark DATA=folder

`folders` states which data lies where; each other module measures one row (`walkers`, `captured_dog`, `masks`,
`flow`, `rooms`) and returns `table.Row`; `__main__` prints the table and writes it as Markdown and JSON. What
is not there is skipped, with the layout that is expected.
"""
