"""Typed settings of the evaluation. A comment above a field is the help text of its option."""

from __future__ import annotations

from dataclasses import dataclass

from dynmap_rl.utils.settings import check_at_least, check_choice

SHARED_STARTS = 1000  # shared start states of a split; the paper's protocol uses the scenes after them


@dataclass(frozen=True)
class Evaluation:
    """Evaluation of a policy in closed loop."""

    # Split of the scenes: test, or validation while settings are being chosen.
    split: str = "test"
    # Scenes that every policy is evaluated on, the same for all; at most 1000.
    episodes: int = 1000
    # Further scenes, the same for every policy, 50 by the paper's protocol; 0 leaves them out.
    paper_episodes: int = 50

    def __post_init__(self):
        check_choice(self, "split", ("test", "validation"))
        check_at_least(self, 1, "episodes")
        check_at_least(self, 0, "paper_episodes")
        if self.episodes > SHARED_STARTS:
            raise ValueError(f"Evaluation.episodes must be at most {SHARED_STARTS}, got {self.episodes}")
