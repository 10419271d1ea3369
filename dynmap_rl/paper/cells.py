"""Cells of the tables, and the runs that fill them: recipes, their options, and the world model of each."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

from dynmap_rl.modules.supervision import parse_supervision, row_name

TASKS = "balance_reaching", "balance_reaching_obstacle", "bin_dropping"
TABLES = "I", "II", "III", "extra", "ablations"  # the first three are the paper's, one for each task
SUPERVISIONS = (
    "position,velocity", "none", "position", "velocity", "acceleration", "position,acceleration",
    "velocity,acceleration", "position,velocity,acceleration",
)  # fmt: skip
SEEDS = 0, 1, 2  # of the world models
MINUTES = {  # of one of two busy cores
    "decoupled": 25,
    "reuse": 8,
    "joint": 75,
    "end_to_end": 60,
    "generalize": 13,
    "baseline": 60,
}
VALIDATION = "--eval.split", "validation", "--eval.paper_episodes", "0"
UNDISTURBED = "datasets/{task}_undisturbed"
SAME_WINDOWS = {
    "no permuted colours": ("--world_model.augmentation.recolor", "false"),
    "no mirrored windows": ("--world_model.augmentation.mirror", "false"),
    "no shifted windows": ("--world_model.augmentation.max_shift", "0"),
}
ABLATIONS = {  # row: options that differ from the default
    "default": (),
    "no emphasis in the L1 loss": ("--policy.emphasis", "0"),
    "corrections in 100 scenes (DAgger)": ("--policy.corrections", "100"),
    "no pushes or noise in demonstrations": ("--dataset", UNDISTURBED),
    "no rarity in the RGB loss": ("--world_model.rarity", "0"),
    "no short windows": ("--world_model.short_windows", "0"),
    "no imagined steps": ("--world_model.imagined", "0"),
    **SAME_WINDOWS,
    "no augmentation": sum(SAME_WINDOWS.values(), ()),
    "latent loss times 10": ("--world_model.beta_z", "1"),
    "latent loss by 10": ("--world_model.beta_z", "0.01"),
}

Key = tuple[str, str, str, str]  # task, training (decoupled or joint, which includes End-to-End), policy, row


@dataclass(frozen=True)
class Run:
    """A run of a recipe for a cell of a table.

    A cell has a run for each of three world models, with three policies each, or a single run of joint or end-to-end
    training, in which each of three seeds has a world model of its own.

    Attributes:
        name: name of the run and of its result.
        recipe: name of the recipe.
        cell: task, training, policy and row of the cell.
        arguments: options of the recipe.
        needs: name of the run whose world model is used, followed by ``/seed_N`` for one seed of a joint run; or None.
        table: table of the cell: ``I``, ``II``, ``III``, ``extra`` or ``ablations``.
    """

    name: str
    recipe: str
    cell: Key
    arguments: tuple[str, ...] = ()
    needs: str | None = None
    table: str = "I"

    @property
    def task(self) -> str:
        """Task of the run's policies."""
        return self.cell[0]

    @property
    def needed_run(self) -> str | None:
        """Name of the run whose world model is used, or None."""
        return self.needs and self.needs.partition("/")[0]

    @property
    def dataset(self) -> str | None:
        """Dataset of the run, or None for that of its task."""
        return dict(zip(self.arguments[::2], self.arguments[1::2], strict=True)).get("--dataset")

    @property
    def minutes(self) -> int:
        """Approximate minutes of one core."""
        return MINUTES["reuse" if self.recipe == "decoupled" and self.needs else self.recipe]


def list_runs() -> list[Run]:
    """Return all runs, the most informative first; a world model is trained before it is used again.

    The first seeds of the decoupled cells come before those of the main joint cells, then the other seeds, the tables
    that the paper does not have, and the other joint cells.
    """
    main = [*(_joint(s) for s in SUPERVISIONS[:2]), _end_to_end()]
    other = [_joint(s) for s in SUPERVISIONS[2:]]
    runs = [*_decoupled(0), *main, *_transfer(main, 0)]
    for seed in SEEDS[1:]:
        runs += [*_decoupled(seed), *_transfer(main, seed)]
    runs += [*(run for seed in SEEDS for s in SUPERVISIONS for run in _plain(s, seed)), _plain_end_to_end()]
    runs += [_ablate(row, seed, task) for seed in SEEDS for task in TASKS[:2] for row in ABLATIONS]
    return runs + other + [run for seed in SEEDS for run in _transfer(other, seed)]


def _name(supervision: str) -> str:
    return supervision.replace(",", "_")


def _suffix(seed: int) -> str:
    return f"_world_model_{seed}" if seed else ""


def _train(supervision: str, seed: int) -> Run:
    """Return the run that trains a decoupled world model, and recurrent policies on it."""
    name = f"{TASKS[0]}_decoupled_{_name(supervision)}_recurrent{_suffix(seed)}"
    arguments = ("--world_model.supervision", supervision)
    arguments += ("--world_model.seed", str(seed)) if seed else ()
    cell = TASKS[0], "decoupled", "recurrent", row_name(parse_supervision(supervision))
    return Run(name, "decoupled", cell, arguments)


def _reuse(run: Run) -> Run:
    """Return the run that trains feed-forward policies on the world model of a run with recurrent ones."""
    task, training, _, row = run.cell
    arguments = (*run.arguments[:2], "--policy.kind", "feedforward")
    name, cell = run.name.replace("recurrent", "feedforward"), (task, training, "feedforward", row)
    return Run(name, "decoupled", cell, arguments, needs=run.name, table=run.table)


def _decoupled(seed: int) -> list[Run]:
    """Return the runs on the decoupled world models of a seed, of Tables I, II and III."""
    recurrent = [_train(supervision, seed) for supervision in SUPERVISIONS]
    return [*recurrent, *(_reuse(run) for run in recurrent), *_transfer(recurrent)]


def _joint(supervision: str) -> Run:
    name = f"{TASKS[0]}_joint_{_name(supervision)}_recurrent"
    cell = TASKS[0], "joint", "recurrent", row_name(parse_supervision(supervision))
    return Run(name, "joint", cell, ("--world_model.supervision", supervision))


def _end_to_end() -> Run:
    cell = TASKS[0], "joint", "recurrent", row_name((), "end_to_end")
    return Run(f"{TASKS[0]}_end_to_end_recurrent", "end_to_end", cell)


def _transfer(sources: Iterable[Run], seed: int = 0) -> list[Run]:
    """Return the runs for tasks 2 and 3 on the world models of some runs, or on those of one seed of joint runs."""
    return [
        Run(
            source.name.replace(TASKS[0], task, 1) + _suffix(seed),
            "generalize",
            (task, *source.cell[1:]),
            ("--task", task),
            needs=f"{source.name}/seed_{seed}" if seed else source.name,
            table=table,
        )
        for task, table in zip(TASKS[1:], TABLES[1:3], strict=True)
        for source in sources
    ]


def _plain(supervision: str, seed: int) -> list[Run]:
    """Return the runs with plain CNNs."""
    run = _train(supervision, seed)
    *column, row = run.cell
    run = replace(
        run,
        name=run.name.replace("decoupled", "plain"),
        cell=(*column, f"{row}, plain CNN"),
        arguments=(*run.arguments, "--world_model.architecture", "plain"),
        table="extra",
    )
    return [run, _reuse(run)]


def _plain_end_to_end() -> Run:
    run = _end_to_end()
    *column, row = run.cell
    return replace(
        run,
        name=run.name.replace("end_to_end", "plain_end_to_end"),
        cell=(*column, f"{row}, plain CNN"),
        arguments=("--world_model.architecture", "plain"),
        table="extra",
    )


def _ablate(row: str, seed: int, task: str) -> Run:
    """Return a run of RGB+[P+V] with recurrent policies and the options of a row, on validation scenes.

    On task 2 the world model is that of the row's run on task 1, as in Table II.
    """
    default, (first, second, _) = _train(SUPERVISIONS[0], seed), TASKS
    options = tuple(option.format(task=task) for option in ABLATIONS[row])
    own = not all(name.startswith("--policy.") for name in options[::2])  # else the default's world model
    words = "".join(c if c.isalnum() else " " for c in row.lower()).split()
    name = f"{first}_ablation_{'_'.join(words)}{_suffix(seed)}"
    run = Run(
        name,
        "decoupled",
        (*default.cell[:3], row),
        (*(default.arguments if own else default.arguments[:2]), *options, *VALIDATION),
        needs=None if own else default.name,
        table="ablations",
    )
    if task == first:
        return run
    pairs = zip(options[::2], options[1::2], strict=True)
    kept = [part for pair in pairs if not pair[0].startswith("--world_model.") for part in pair]
    return replace(
        run,
        name=name.replace(first, second, 1),
        recipe="generalize",
        cell=(second, *run.cell[1:]),
        arguments=("--task", second, *kept, *VALIDATION),
        needs=run.needs or name,
    )
