"""The grid of runs."""

import importlib
from collections import Counter

import pytest

from dynmap_rl.paper.cells import ABLATIONS, SEEDS, TABLES, TASKS, list_runs
from dynmap_rl.paper.published import TABLES as PUBLISHED
from dynmap_rl.utils.cli import parse_settings, read_arguments

RUNS = list_runs()
BY_NAME = {run.name: run for run in RUNS}
MAIN = "balance_reaching_decoupled_position_velocity_recurrent"


def settings_of(run):
    """Return the settings that a run's recipe parses from its arguments."""
    config = importlib.import_module(f"recipes.{run.recipe}").Config
    return parse_settings(config, read_arguments([*run.arguments], config))


def test_there_is_a_cell_for_every_one_of_the_paper():
    found = {run.cell for run in RUNS if run.table in ("I", "II", "III")}
    assert found == {(*column, row) for column, rows in PUBLISHED.items() for row in rows}
    assert len(BY_NAME) == len(RUNS) and {run.table for run in RUNS} == set(TABLES)


def test_every_cell_rests_on_three_world_models():
    counts = Counter((run.table, run.cell) for run in RUNS)
    for (table, cell), count in counts.items():
        own = (
            table in ("I", "extra") and cell[1] == "joint"
        )  # each of its three seeds has a world model of its own
        assert count == (1 if own else len(SEEDS)), cell
    for run in RUNS:
        if run.recipe in ("joint", "end_to_end"):
            assert settings_of(run).seeds == "0,1,2"


def test_needed_world_models_are_trained_first_and_are_of_the_same_seed():
    names = [run.name for run in RUNS]
    for number, run in enumerate(RUNS):
        if run.needs:
            source = BY_NAME[run.needed_run]
            assert names.index(source.name) < number and source.needs is None
            seed = run.name.partition("_world_model_")[2]
            joint = source.recipe in ("joint", "end_to_end")
            expected = f"{source.name}/seed_{seed}" if joint and seed else source.name
            assert run.needs == expected and (joint or source.name.partition("_world_model_")[2] == seed)


def test_the_seed_of_a_name_is_that_of_the_world_model():
    for run in RUNS:
        if run.recipe == "decoupled" and not run.needs:
            assert settings_of(run).world_model.seed == int(run.name.partition("_world_model_")[2] or 0)


def test_the_shipped_model_is_the_first_of_the_grid():
    assert RUNS[0].name == MAIN
    assert settings_of(RUNS[0]) == importlib.import_module("recipes.decoupled").Config()


@pytest.mark.parametrize("recipe", ["decoupled", "joint", "end_to_end", "generalize"])
def test_names_tell_runs_of_different_settings_apart(recipe):
    runs = [run for run in RUNS if run.recipe == recipe]
    assert len({(settings_of(run), run.needs) for run in runs}) == len(runs)


def test_the_first_seeds_of_the_decoupled_cells_come_first():
    places = [
        number for number, run in enumerate(RUNS) if run.cell[1] == "decoupled" and run.table != "extra"
    ]
    first = [n for n in places if "_world_model_" not in RUNS[n].name and RUNS[n].table != "ablations"]
    assert first == list(range(len(first)))


def test_ablations_differ_from_the_default_in_their_options_alone_on_validation_scenes():
    ablations = [run for run in RUNS if run.table == "ablations" and run.task == "balance_reaching"]
    runs = {run.cell[-1]: settings_of(run) for run in ablations}
    assert list(runs) == list(ABLATIONS)
    assert all(run.eval.split == "validation" and not run.eval.paper_episodes for run in runs.values())
    flat = {row: parts(settings) for row, settings in runs.items()}
    for row, values in flat.items():
        seed = "world_model.seed"
        changed = {name for name, value in values.items() if name != seed and value != flat["default"][name]}
        assert len(changed) == len(ABLATIONS[row]) // 2, (row, changed)


def test_ablations_of_task_2_use_the_world_models_of_task_1():
    task = "balance_reaching_obstacle"
    one, two = ([r for r in RUNS if r.table == "ablations" and r.task == t] for t in (TASKS[0], task))
    assert [run.name.replace(TASKS[0], task, 1) for run in one] == [run.name for run in two]
    assert [run.needs or run.name for run in one] == [run.needs for run in two]
    default, changed = parts(settings_of(two[0])), {}
    assert default["eval.split"] == "validation" and default["task"] == task
    for run in two:
        pairs = parts(settings_of(run)).items()
        changed[run.cell[-1]] = {name: value for name, value in pairs if value != default[name]}
    assert {row: options for row, options in changed.items() if options} == {
        "no emphasis in the L1 loss": {"policy.emphasis": 0},
        "corrections in 100 scenes (DAgger)": {"policy.corrections": 100},
        "no pushes or noise in demonstrations": {"dataset": f"datasets/{task}_undisturbed"},
    }


def parts(settings, prefix="") -> dict:
    """Return nested settings as one dict of dotted names."""
    found = {}
    for name, value in vars(settings).items():
        nested = hasattr(value, "__dataclass_fields__")
        found |= parts(value, f"{prefix}{name}.") if nested else {prefix + name: value}
    return found
