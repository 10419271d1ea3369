"""The grid of cells."""

from dynmap_rl.modules.supervision import parse_supervision, row_name
from dynmap_rl.paper.cells import list_cells
from dynmap_rl.paper.published import TABLES

CELLS = list_cells()
BY_NAME = {cell.name: cell for cell in CELLS}


def options_of(cell) -> dict[str, str]:
    return dict(zip(cell.arguments[::2], cell.arguments[1::2], strict=True))


def test_there_is_a_cell_for_every_one_of_the_paper():
    found = set()
    for cell in (cell for cell in CELLS if "world_model_" not in cell.name):
        source = BY_NAME[cell.needs] if cell.needs else cell
        supervision = parse_supervision(options_of(source).get("--world_model.supervision", "none"))
        training = "decoupled" if source.recipe == "decoupled" else "joint"
        policy = options_of(cell).get("--policy.kind", "recurrent")
        found.add((cell.task, training, policy, row_name(supervision, source.recipe)))
    assert found == {(*column, row) for column, rows in TABLES.items() for row in rows}
    assert len(BY_NAME) == len(CELLS)


def test_needed_world_models_are_trained_first():
    names = [cell.name for cell in CELLS]
    for number, cell in enumerate(CELLS):
        assert cell.needs is None or names.index(cell.needs) < number
        assert not (cell.needs and BY_NAME[cell.needs].needs)


def test_world_models_of_further_seeds_are_of_task_1():
    seeded = [cell for cell in CELLS if "world_model_" in cell.name]
    assert len(seeded) == 10
    for cell in seeded:
        assert cell.task == "balance_reaching" and cell.table == "I"
        assert options_of(cell)["--world_model.seed"] == cell.name[-1]
