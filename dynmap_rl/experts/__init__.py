"""State-based PPO experts."""

from .policy import ExpertNetwork, list_checkpoints, load_expert, make_actor, roll_out

__all__ = ["ExpertNetwork", "list_checkpoints", "load_expert", "make_actor", "roll_out"]
