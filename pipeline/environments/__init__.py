"""Gymnasium and PettingZoo environments: a person or a robot acts, the animal of a build is the world.

`world` moves many persons and animals at once, `person_env` is one of them for Gymnasium, `vector_env` many,
`parallel_env` lets person and animal act for PettingZoo. Importing this package registers its name in
Gymnasium: `gymnasium.make("pipeline.environments:AgentToSim/Cat-v0", build=...)` imports it itself, after
`import pipeline.environments` the name is enough. Needs the extra `env`; without it, nothing is registered.
"""

from importlib.util import find_spec

NAME = "AgentToSim/Cat-v0"
"""A person or a robot beside the animal of a build, see `pipeline.environments.person_env`."""

if find_spec("gymnasium"):
    import gymnasium

    gymnasium.register(
        NAME,
        entry_point="pipeline.environments.person_env:PersonEnv",
        vector_entry_point="pipeline.environments.vector_env:PersonVectorEnv",
    )
