"""Build the animal's canonical body from a turnaround.

`poses` registers the cameras, `fuse` fuses masked depth and silhouettes into a closed surface, `canonical`
chooses the agent's axes and fits Gaussian bones, `appearance` averages color and features per vertex;
`template` runs them in this order.
"""
