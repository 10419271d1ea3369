"""State-based PPO experts."""

from .policy import (
    ExpertNetwork,
    film,
    find_expert,
    list_checkpoints,
    load_expert,
    make_actor,
    play,
    roll_out,
    task_of_expert,
)

__all__ = [
    "ExpertNetwork",
    "film",
    "find_expert",
    "list_checkpoints",
    "load_expert",
    "make_actor",
    "play",
    "roll_out",
    "task_of_expert",
]
