"""Tables of long-term motion (Tables 1, 2 and 4 of LTM).

`methods` in-betweens clips with every method, `scores` computes their metrics, `lengths` evaluates minutes of
motion, `samples` samples of the behavior model, and `tables` computes intervals and formats the tables.
"""
