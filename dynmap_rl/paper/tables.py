"""The paper's three tables with our results beside the paper's."""

from __future__ import annotations

from pathlib import Path

from dynmap_rl.evaluation.protocol import result_rows
from dynmap_rl.evaluation.statistics import shared_interval, summarize

from .published import METRICS, TABLES, paper_numbers
from .results import COLUMNS, ROWS, read_cells


def table_rows(results: Path) -> list[dict]:
    """Return a dict for every cell of a folder of results.

    Returns:
        Dicts with ``table``, ``row``, ``column``; on the shared start states ``DR`` (%), ``PE`` (mm), ``SR`` (%), the
        number ``n`` of episodes, the 95 % ``interval`` of SR and the SR of each of the ``policies``; mean and standard
        deviation by the paper's ``protocol`` (None where it was not run) and in the ``paper``; ``seeds``; ``command``.
    """
    cells = read_cells(results)
    return [
        {"table": table, "row": row, "column": _name(column), **_describe(cells[*column, row])}
        for table, columns in COLUMNS.items()
        for row in ROWS
        for column in columns
        if (*column, row) in cells
    ]


def _describe(result: dict) -> dict:
    test, rows = result["test_protocol"], result_rows(result)
    return {
        **{name: test[name] for name in ("DR", "PE", "SR")},
        "n": test["episodes"],
        "interval": shared_interval(rows),
        "policies": [summarize(of_seed)["SR"] for of_seed in rows],
        "protocol": result.get("paper_protocol"),
        "paper": paper_numbers(result),
        "seeds": result["seeds"],
        "command": result["command"],
    }


def markdown_overview(results: Path) -> str:
    """Return SR (%) of all three tables as one table: the paper's / ours on the 1,000 shared start states."""
    cells = read_cells(results)
    columns = [column for columns in COLUMNS.values() for column in columns]
    lines = []
    for row in ROWS:
        line = [row]
        for column in columns:
            paper, result = TABLES[column].get(row), cells.get((*column, row))
            ours = f"**{result['test_protocol']['SR']:.1f}**" if result else "-"
            line.append(f"{paper[-1][0]} / {ours}" if paper else "")
        lines.append(line)
    names = [f"{table}: {_name(column)}" for table, columns in COLUMNS.items() for column in columns]
    return join_table(["", *names], lines)


def markdown_column(results: Path, column: tuple[str, str, str]) -> str:
    """Return one column of a table with all metrics.

    Args:
        results: folder of results.
        column: task, training and policy.

    Returns:
        The paper's numbers, ours by its protocol, and ours on the 1,000 shared start states.
    """
    cells, others = read_cells(results), [name for name in METRICS[column[0]] if name != "SR"]
    what = "SR (std)" + (f"; {', '.join(others)}" if others else "")
    head = [
        "",
        f"paper: {what}",
        f"here, paper's protocol: {what}",
        *others,
        "SR, shared starts",
        "SR of each policy",
    ]
    found = [cells[*column, row] for row in ROWS if (*column, row) in cells]
    return join_table(head, [_column_row(result, others) for result in found])


def markdown_tables(results: Path) -> str:
    """Return the overview, and every column of the three tables under its name."""
    parts = [f"SR in %, the paper's / ours on the 1,000 shared start states\n\n{markdown_overview(results)}"]
    for table, columns in COLUMNS.items():
        for column in columns:
            parts.append(f"Table {table}, {_name(column)}\n\n{markdown_column(results, column)}")
    return "\n\n".join(parts)


def join_table(head: list[str], rows: list[list[str]]) -> str:
    """Return a table in Markdown."""
    return "\n".join(f"| {' | '.join(line)} |" for line in (head, ["---"] * len(head), *rows))


def _name(column: tuple[str, str, str]) -> str:
    return ", ".join(column[1:])


def _column_row(result: dict, others: list[str]) -> list[str]:
    cell = _describe(result)
    low, high = cell["interval"]
    rate = f"**{cell['SR']:.1f}** [{low:.1f}, {high:.1f}]"
    each = ", ".join(f"{rate:.1f}" for rate in cell["policies"])
    ours = _short(cell["protocol"], others) if cell["protocol"] else "-"
    return [
        result["row"],
        _short(cell["paper"], others),
        ours,
        *(f"{cell[k]:.1f}" for k in others),
        rate,
        each,
    ]


def _short(numbers: dict, others: list[str]) -> str:
    mean, std = numbers["SR"]
    rest = ", ".join(f"{numbers[name][0]:.0f}" for name in others)
    return f"{mean:.0f} ({std:.1f})" + (f"; {rest}" if rest else "")
