"""The environments' name in Gymnasium: importing this module makes ``AgentToSim/Cat-v0``."""

import gymnasium

NAME = "AgentToSim/Cat-v0"
"""A person or a robot beside the animal of a build, see `pipeline.environments.person_env`."""


def register() -> None:
    """Make the environments known to Gymnasium, once."""
    if NAME not in gymnasium.registry:
        gymnasium.register(
            NAME,
            entry_point="pipeline.environments.person_env:PersonEnv",
            vector_entry_point="pipeline.environments.vector_env:PersonVectorEnv",
        )


register()
