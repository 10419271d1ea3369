"""State-based experts and the checkpoints that ship with the package."""

from .network import ExpertNetwork, list_checkpoints, load_expert, make_actor, roll_out

__all__ = ["ExpertNetwork", "list_checkpoints", "load_expert", "make_actor", "roll_out"]
