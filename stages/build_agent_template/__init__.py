"""Make the animal's canonical body from a walk around it.

`poses` places the phone around the standing animal, `fuse` carves and fuses masked depth into a closed
surface (`limbs` finds what moved meanwhile), `canonical` chooses the agent's axes, `bones` divides the body
into Gaussian bones along its limbs, `appearance` gathers features per vertex; `template` runs them in this
order.
"""
