"""Tables of made-up results."""

import pytest
from made_up import TASK, write

from dynmap_rl.paper.cells import TABLES
from dynmap_rl.paper.results import COLUMNS, ROWS, read_cells
from dynmap_rl.paper.tables import (
    join_table,
    markdown_column,
    markdown_overview,
    markdown_own,
    markdown_tables,
    table_rows,
)

RECURRENT = TASK, "decoupled", "recurrent"


def line_of(text: str, row: str) -> str:
    """Return the first line of a table in a row."""
    return next(line for line in text.splitlines() if line.startswith(f"| {row} |"))


def test_cells_without_a_run_are_dashes_and_counted(tmp_path):
    text = markdown_tables(read_cells(tmp_path, TABLES))
    rows = [line for line in text.splitlines() if line.startswith(tuple(f"| {row} |" for row in ROWS))]
    beside_plain = 2 * 8 + 1
    assert len(rows) == 59 + len(ROWS) + beside_plain and all(" - " in line for line in rows)
    assert text.count("\nTable ") == sum(map(len, COLUMNS.values()))
    assert "159 of 159 runs" in markdown_overview(read_cells(tmp_path))


def test_a_row_without_an_entry_for_every_column_is_refused():
    with pytest.raises(ValueError, match="2 entries"):
        join_table(["a", "b"], [["1", "2"], ["1", "2", "3"]])


def test_a_row_has_both_intervals_and_every_world_model(tmp_path):
    write(tmp_path, "RGB+[P]", 20, 24, 28)
    text = markdown_column(read_cells(tmp_path), RECURRENT)
    line = line_of(text, "RGB+[P]").split(" | ")
    assert line[1] == "92 (4.3); 4, 21" and line[3:5] == ["0.0", "10.0"]
    assert line[5].startswith("**60.0** [") and line[6] == "50.0, 60.0, 70.0"
    assert line[7] == "60.0 [35.2, 84.8]" and line[8] == "3, 9 |"
    assert line_of(markdown_overview(read_cells(tmp_path)), "RGB+[P]").startswith(
        "| RGB+[P] | 62 / - | 92 / **60.0** |"
    )


def test_a_table_of_different_code_says_so(tmp_path):
    write(tmp_path, "RGB+[P]", 20, 24, commit="abc")
    assert "abc" not in markdown_column(read_cells(tmp_path), RECURRENT)
    write(tmp_path, "RGB+[V]", 20, commit="def-dirty")
    assert "2 of `abc`, 1 of `def-dirty`" in markdown_column(read_cells(tmp_path), RECURRENT)
    assert "def" not in markdown_column(read_cells(tmp_path), (TASK, "joint", "recurrent"))


def test_a_table_names_the_gpus_of_its_runs(tmp_path):
    write(tmp_path, "RGB+[P]", 20)
    assert "GPU" not in markdown_column(read_cells(tmp_path), RECURRENT)
    write(tmp_path, "RGB+[V]", 20, 30, device="NVIDIA X")
    assert "Of 3 runs, 2 on one NVIDIA X" in markdown_column(read_cells(tmp_path), RECURRENT)


def test_rows_of_the_tables_are_the_cells_with_a_run(tmp_path):
    write(tmp_path, "RGB+[P]", 20, 24)
    write(tmp_path, "Only-RGB", 10, 20, 30, training="joint")
    rows = {row["row"]: row for row in table_rows(read_cells(tmp_path, TABLES))}
    assert set(rows) == {"RGB+[P]", "Only-RGB"}
    assert (rows["RGB+[P]"]["table"], rows["RGB+[P]"]["n"], rows["RGB+[P]"]["missing"]) == ("I", 240, 1)
    assert rows["RGB+[P]"]["policies"] == [50.0] * 3 + [60.0] * 3
    assert rows["RGB+[P]"]["commits"] == {"abc": 2} and rows["Only-RGB"]["world_models"] == [25.0, 50.0, 75.0]
    assert rows["Only-RGB"]["column"] == "joint, recurrent" and rows["Only-RGB"]["paper"]["SR"] == (64, 5.9)


def test_ablations_are_compared_with_the_default(tmp_path):
    write(tmp_path, "default", 40, 40, 40)
    write(tmp_path, "no imagined steps", 30, 20, 10)
    text = markdown_own(read_cells(tmp_path, ["ablations"]), "ablations")
    assert line_of(text, "default").endswith("|  |")
    assert " | -50.0 [" in line_of(text, "no imagined steps")
    assert line_of(text, "no mirrored windows").endswith("- | - |")


def test_plain_world_models_stand_beside_the_default(tmp_path):
    write(tmp_path, "Only-RGB, plain CNN", 20, policy="feedforward")
    write(tmp_path, "Only-RGB", 40, policy="feedforward")
    lines = markdown_own(read_cells(tmp_path, TABLES), "extra").splitlines()
    default, plain = (
        next(line for line in lines if line.startswith(f"| {row} | feedforward | "))
        for row in ("Only-RGB", "Only-RGB, plain CNN")
    )
    assert "| **100.0** [" in default and default.endswith("|  |")
    assert "| **50.0** [" in plain and " -50.0 [" in plain
    assert lines.index(plain) == lines.index(default) + 1
    alone = markdown_own(read_cells(tmp_path, ["extra"]), "extra")
    assert "| Only-RGB | " not in alone and "| **50.0** [" in alone


@pytest.mark.parametrize("form", [markdown_overview, markdown_tables])
def test_a_cell_without_the_papers_protocol_is_a_dash(tmp_path, form):
    write(tmp_path, "RGB+[V]", 20)
    for path in tmp_path.glob("*.json"):
        path.write_text(path.read_text().replace('"paper"', '"other"'))
    assert "85 / **50.0**" in form(read_cells(tmp_path, TABLES))
    assert line_of(markdown_column(read_cells(tmp_path), RECURRENT), "RGB+[V]").split(" | ")[2] == "-"
