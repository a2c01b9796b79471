"""Score one trained behavior model, a method with a seed, on every test window.

`protocols` predicts end to end (Table 4) and from the true goal and path (Table 5), `approaches` compares how
often model and animal flee from people. `tabulate_behavior` makes tables of many of these.
"""
