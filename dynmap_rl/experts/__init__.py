"""State-based PPO experts."""

from .policy import (
    ExpertNetwork,
    find_expert,
    list_checkpoints,
    load_expert,
    make_actor,
    roll_out,
    task_of_expert,
)

__all__ = [
    "ExpertNetwork",
    "find_expert",
    "list_checkpoints",
    "load_expert",
    "make_actor",
    "roll_out",
    "task_of_expert",
]
