"""Gymnasium and PettingZoo environments: a person or a robot acts, the animal of a build is the world.

`world` moves many persons and animals at once, `person_env` is one of them for Gymnasium, `vector_env` many,
`parallel_env` lets person and animal act for PettingZoo. Importing `pipeline.environments.registration` makes
`gymnasium.make("AgentToSim/Cat-v0", build=...)` work; needs the extra `env`.
"""
