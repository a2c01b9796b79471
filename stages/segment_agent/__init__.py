"""Find the animal in a recording without any trained weights; `masks` has the steps in order.

`trajectory` corrects the drift of the camera poses. `free_space` measures depth noise and counts, for each
depth point, how many other frames saw through it. In sessions, `locate` groups such points and `movers`
tracks the one animal-sized group; `turnaround` finds what stands on the floor where the optical axes meet.
`appearance` learns the animal's look from these first masks, so that it is also found where it never moved;
`evidence` and `refine` turn both into sharp masks (`segmenter`). Without depth, `follow` propagates a prompt
by color and flow.
"""
