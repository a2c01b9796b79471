"""The animal of a build in programs with a clock of their own: MuJoCo, USD stages (Isaac Sim), ROS 2.

`live_animal` lets an animal live in steps of any length; the others hand its poses on.
"""
