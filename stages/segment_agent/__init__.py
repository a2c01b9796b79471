"""Find the animal in a recording without any trained weights; `masks` has the steps in order.

`trajectory` corrects the drift of the phone's poses. `free_space` measures the recording's depth noise and
counts, for each depth point, how many other frames saw through it. `movers` tracks the one animal-sized thing
that such points make (`locate`; sessions); `turnaround` finds what stands on the floor where all cameras
look. `appearance` learns from those first masks what the animal looks like, which finds it where it never
moved and decides whether a frame shows it; `evidence` and `refine` turn both into sharp masks (`painting`).
Without depth, `follow` tracks a hinted animal by colour and flow.
"""
