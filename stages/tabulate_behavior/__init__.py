"""From the scores of all trials to the paper's Tables 4 and 5, with intervals.

`tables` draws intervals over seeds and episodes, `untrained` scores the rivals that need no training,
`chaining` lets the model live on for minutes, `printing` lays out the tables, `pictures` shows the learning
curves.
"""
