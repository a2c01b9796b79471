"""The room of the tables of long-term motion (Tables 1, 2 and 4 of paper 002).

`methods` makes short motions by every method, `scores` measures them against true ones, `lengths` and
`samples` measure minutes of motion and samples of the behaviour model, `tables` turns all into figures with
intervals and into text.
"""
