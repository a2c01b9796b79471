"""Tables 4 and 5 of the paper, with bootstrap intervals, from the scores of all trials.

`tables` computes intervals over seeds and episodes, `untrained` scores the baselines without training,
`chaining` simulates minutes of chained plans, `printing` formats tables, `pictures` draws learning curves.
"""
