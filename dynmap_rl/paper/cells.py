"""Cells of the paper's Tables I, II and III: the recipe, its options, and the world model of each."""

from __future__ import annotations

from dataclasses import dataclass

TASKS = "balance_reaching", "balance_reaching_obstacle", "bin_dropping"
TABLES = "I", "II", "III"
SUPERVISIONS = (
    "none", "position", "velocity", "acceleration", "position,velocity", "position,acceleration",
    "velocity,acceleration", "position,velocity,acceleration",
)  # fmt: skip
SEEDED = (
    "none",
    "position",
    "velocity",
    "position,velocity",
    "position,velocity,acceleration",
)  # these carry the claims
MINUTES = {
    "decoupled": 14,
    "reuse": 5,
    "joint": 27,
    "end_to_end": 25,
    "generalize": 8,
}  # of one of two busy cores


@dataclass(frozen=True)
class Cell:
    """A run of a recipe.

    Attributes:
        name: name of the cell, its run and its result.
        recipe: name of the recipe.
        arguments: options of the recipe.
        needs: name of the cell whose world model is used, or None.
    """

    name: str
    recipe: str
    arguments: tuple[str, ...] = ()
    needs: str | None = None

    @property
    def task(self) -> str:
        """Task of the cell's policies."""
        return self.arguments[self.arguments.index("--task") + 1] if "--task" in self.arguments else TASKS[0]

    @property
    def table(self) -> str:
        """Table of the cell: ``I``, ``II`` or ``III``, one for each task."""
        return TABLES[TASKS.index(self.task)]

    @property
    def minutes(self) -> int:
        """Approximate minutes of one core."""
        return MINUTES["reuse" if self.recipe == "decoupled" and self.needs else self.recipe]


def list_cells() -> list[Cell]:
    """Return all cells; those that train world models come first."""
    task = TASKS[0]
    first = [_train(supervision) for supervision in SUPERVISIONS]
    first += [
        Cell(f"{task}_joint_{_name(s)}_recurrent", "joint", ("--world_model.supervision", s))
        for s in SUPERVISIONS
    ]
    first.append(Cell(f"{task}_end_to_end_recurrent", "end_to_end"))
    reuse = [_reuse(supervision) for supervision in SUPERVISIONS]
    reuse += [
        Cell(cell.name.replace(task, other, 1), "generalize", ("--task", other), needs=cell.name)
        for other in TASKS[1:]
        for cell in first
    ]
    return first + [_train(s, seed) for s in SEEDED for seed in (1, 2)] + reuse


def _name(supervision: str) -> str:
    return supervision.replace(",", "_")


def _train(supervision: str, seed: int = 0) -> Cell:
    """Return the cell that trains a decoupled world model and recurrent policies."""
    name = f"{TASKS[0]}_decoupled_{_name(supervision)}_recurrent"
    arguments = ("--world_model.supervision", supervision)
    if not seed:
        return Cell(name, "decoupled", arguments)
    return Cell(f"{name}_world_model_{seed}", "decoupled", (*arguments, "--world_model.seed", str(seed)))


def _reuse(supervision: str) -> Cell:
    """Return the cell that trains feed-forward policies on the world model of a recurrent cell."""
    arguments = ("--world_model.supervision", supervision, "--policy.kind", "feedforward")
    name = f"{TASKS[0]}_decoupled_{_name(supervision)}_feedforward"
    return Cell(name, "decoupled", arguments, needs=_train(supervision).name)
