"""Judge one trained behaviour model, window by window: a method with a seed.

`protocols` predicts end to end (Table 4) and fed with the truth (Table 5), `approaches` asks whether the
model runs from people as the animal does. `tabulate_behavior` makes tables of many of these.
"""
