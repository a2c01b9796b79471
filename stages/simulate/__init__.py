"""Takes of the behavior model and of long-term motion.

`takes` makes each kind of take, `observers` scripts the person, `rollout` records a simulation.
"""
