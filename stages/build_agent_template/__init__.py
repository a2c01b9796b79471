"""Make the animal's canonical body from a walk around it.

`poses` places the phone around the standing animal, `fuse` carves and fuses masked depth into a closed
surface, `canonical` chooses the agent's axes and lays Gaussian bones along its limbs, `appearance` gathers
color and features per vertex; `template` runs them in this order.
"""
