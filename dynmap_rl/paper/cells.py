"""The cells of the paper's Tables I, II and III: which recipe makes each, with which options, from which world model."""

from __future__ import annotations

from dataclasses import dataclass

TASKS = "balance_reaching", "balance_reaching_obstacle", "bin_dropping"
TABLES = "I", "II", "III"
SUPERVISIONS = (
    "none", "position", "velocity", "acceleration", "position,velocity", "position,acceleration",
    "velocity,acceleration", "position,velocity,acceleration",
)  # fmt: skip
CLAIMS = "none", "position", "velocity", "position,velocity", "position,velocity,acceleration"
MINUTES = {
    "decoupled": 14,
    "reuse": 5,
    "joint": 27,
    "end_to_end": 25,
    "generalize": 8,
}  # of one of two busy cores


@dataclass(frozen=True)
class Cell:
    """A run of a recipe; ``needs`` names the cell whose world model it takes."""

    name: str
    recipe: str
    arguments: tuple[str, ...]
    needs: str | None = None

    @property
    def task(self) -> str:
        """That the cell's policies are judged on."""
        return self.arguments[self.arguments.index("--task") + 1] if "--task" in self.arguments else TASKS[0]

    @property
    def table(self) -> str:
        """Of the paper, that the cell belongs to: ``I``, ``II`` or ``III``; each has a task of its own."""
        return TABLES[TASKS.index(self.task)]

    @property
    def minutes(self) -> int:
        """About how long it takes on one core."""
        return MINUTES["reuse" if self.recipe == "decoupled" and self.needs else self.recipe]


def list_cells() -> list[Cell]:
    """Those that train world models first."""
    task, first, second = TASKS[0], [], []
    for supervision in SUPERVISIONS:
        row, given = supervision.replace(",", "_"), ("--supervision", supervision)
        trained = f"{task}_decoupled_{row}_recurrent"
        first.append(Cell(trained, "decoupled", given))
        second.append(
            Cell(
                f"{task}_decoupled_{row}_feedforward",
                "decoupled",
                (*given, "--policy", "feedforward"),
                trained,
            )
        )
        first.append(Cell(f"{task}_joint_{row}_recurrent", "joint", given))
    first += [
        Cell(
            f"{task}_decoupled_{s.replace(',', '_')}_recurrent_world_model_{seed}",
            "decoupled",
            ("--supervision", s, "--world_model_seed", str(seed)),
        )
        for s in CLAIMS
        for seed in (1, 2)
    ]
    first.append(Cell(f"{task}_end_to_end_recurrent", "end_to_end", ()))
    sources = [cell for cell in first if "world_model_" not in cell.name]
    for other in TASKS[1:]:
        second += [
            Cell(cell.name.replace(task, other, 1), "generalize", ("--task", other), cell.name)
            for cell in sources
        ]
    return first + second
