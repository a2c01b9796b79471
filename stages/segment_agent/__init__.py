"""Find the animal in a recording without any trained weights.

`trajectory` takes the drift out of the phone's poses; `free_space` tells of each depth point how many other frames saw
through it, `movers` tracks the one animal-sized thing that such points make (sessions), `turnaround` finds what stands on
the floor where all cameras look; `refine` turns either into sharp masks with depth, colour and flow; `pipeline` order is in `segment`.
"""
