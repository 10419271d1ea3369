"""The paper's three tables, built from the results alone: ours beside the paper's."""

from __future__ import annotations

import json
from pathlib import Path

from dynmap_rl.evaluation.protocol import result_rows
from dynmap_rl.evaluation.statistics import shared_interval, summarize
from .published import METRICS, TABLES, paper_numbers
from dynmap_rl.reporting.html import write_html
from dynmap_rl.reporting.run_page import markdown_row
from dynmap_rl.utils.cli import command_line
from dynmap_rl.utils.files import read_json

COLUMNS = {  # table: its columns, as (task, training, policy)
    "I": [key for key in TABLES if key[0] == "balance_reaching"],
    "II": [key for key in TABLES if key[0] == "balance_reaching_obstacle"],
    "III": [key for key in TABLES if key[0] == "bin_dropping"],
}
ROWS = list(TABLES["bin_dropping", "joint", "recurrent"])  # in the paper's order, End-to-End first


def read_cells(results: Path, world_model_seed: int = 0) -> dict[tuple, dict]:
    """The results of a folder by ``(task, training, policy, row)``, for one seed of the decoupled world models; those the
    paper has no cell for are left out."""
    cells = {}
    for path in sorted(results.glob("*.json")):
        result = read_json(path)
        if (
            "world_model" not in result
            or not paper_numbers(result)
            or result["settings"].get("world_model_seed", 0) != world_model_seed
        ):
            continue
        training = "decoupled" if result["world_model"]["training"] == "decoupled" else "joint"
        cells[result["task"], training, result["policy"], result["row"]] = result
    return cells


def table_rows(results: Path) -> list[dict]:
    """A dict for every cell: ``table``, ``row``, ``column``, by our protocol ``DR`` (%), ``PE`` (mm), ``SR`` (%), ``n``
    episodes, the 95 % ``interval`` of SR and SR of each of the ``policies``; by the paper's ``protocol`` of 50 the mean and standard deviation of each;
    the ``paper``'s own; ``seeds`` and ``command``."""
    cells, rows = read_cells(results), []
    for table, columns in COLUMNS.items():
        for row in ROWS:
            for column in columns:
                if result := cells.get((*column, row)):
                    test = result["test_protocol"]
                    rows.append(
                        {
                            "table": table,
                            "row": row,
                            "column": ", ".join(column[1:]),
                            **{name: test[name] for name in ("DR", "PE", "SR")},
                            "n": test["episodes"],
                            "interval": shared_interval(result_rows(result)),
                            "policies": [summarize(rows)["SR"] for rows in result_rows(result)],
                            "protocol": result["paper_protocol"],
                            "paper": paper_numbers(result),
                            "seeds": result["seeds"],
                            "command": result["command"],
                        }
                    )
    return rows


def markdown_overview(results: Path) -> str:
    """SR (%) of all three tables in one: the paper's, and ours on the 1,000 shared starts."""
    cells = read_cells(results)
    columns = [(table, column) for table, columns in COLUMNS.items() for column in columns]
    lines = [
        ["", *(f"{table}: {', '.join(column[1:])}" for table, column in columns)],
        ["---"] * (1 + len(columns)),
    ]
    for row in ROWS:
        line = [row]
        for _, column in columns:
            paper, result = TABLES[column].get(row), cells.get((*column, row))
            ours = f"**{result['test_protocol']['SR']:.1f}**" if result else "-"
            line.append(f"{paper[-1][0]} / {ours}" if paper else "")
        lines.append(line)
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def markdown_table(results: Path, column: tuple[str, str, str]) -> str:
    """One column of a table, with all metrics: the paper's numbers, ours by its protocol of 50 episodes, and ours on the
    1,000 shared starts."""
    cells, metrics = read_cells(results), [name for name in METRICS[column[0]] if name != "SR"]
    what = "SR (std)" + (f"; {', '.join(metrics)}" if metrics else "")
    head = [
        "",
        f"paper: {what}",
        f"here, paper's protocol: {what}",
        *metrics,
        "SR, same 1,000 starts",
        "each policy",
    ]
    found = [cells[*column, row] for row in ROWS if (*column, row) in cells]
    lines = [f"| {' | '.join(line)} |" for line in (head, ["---"] * len(head))]
    return "\n".join([*lines, *map(markdown_row, found)])


def markdown_tables(results: Path) -> str:
    """The overview, and every column of the three tables under its name."""
    parts = [f"SR in %, the paper's / ours on the 1,000 shared starts\n\n{markdown_overview(results)}"]
    for table, columns in COLUMNS.items():
        for column in columns:
            parts.append(f"Table {table}, {', '.join(column[1:])}\n\n{markdown_table(results, column)}")
    return "\n\n".join(parts)


def write_tables_page(folder: Path, results: Path, settings: dict) -> None:
    """``report.html`` in a folder: the tables so far, the settings of the recipe that ran them, and its command."""
    page = write_html(folder, "Tables I to III", markdown_tables(results), command_line(), settings)
    print(f"written: {page}")


def print_tables(results: Path, form: str) -> None:
    """Print all three as ``markdown`` or ``json``, or the ``findings``; ``ValueError`` for another form."""
    from .findings import markdown_findings, markdown_spread

    if form == "json":
        print(json.dumps(table_rows(results), indent=1))
    elif form == "findings":
        print(f"{markdown_findings(results)}\n\n{markdown_spread(results)}")
    elif form == "markdown":
        print(markdown_tables(results))
    else:
        raise ValueError(f"--print is markdown, json or findings, not {form!r}")
