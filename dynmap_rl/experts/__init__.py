"""State-based PPO experts."""

from .policy import ExpertNetwork, list_checkpoints, load_expert, make_actor

__all__ = ["ExpertNetwork", "list_checkpoints", "load_expert", "make_actor"]
