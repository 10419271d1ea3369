"""The paper's three tables with our results beside the paper's, and tables of our own."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from statistics import fmean

from dynmap_rl.evaluation.failures import CAUSES
from dynmap_rl.evaluation.statistics import outcome_gap, summarize, welch_interval

from .cells import TASKS, Key
from .published import METRICS, TABLES
from .results import COLUMNS, ROWS, Cell, count_commits, count_devices

OWN = {  # tables that the paper does not have: what they show
    "extra": "World models with plain CNNs beside the default, on the shared test scenes",
    "ablations": "RGB+[P+V] with recurrent policies, on validation scenes: the default, and rows that differ from it",
}


def table_rows(cells: Mapping[Key, Cell]) -> list[dict]:
    """Return a dict for every cell that has a complete run.

    Returns:
        Dicts with ``table``, ``row``, ``column``, ``n`` (number of episodes), ``missing`` (runs without a result) and the
        entries of :attr:`dynmap_rl.paper.results.Cell.summary`; SR of each of the ``policies``; mean and standard
        deviation by the paper's ``protocol`` (None where it was not run) and in the ``paper``; ``commands``; the number
        of runs of each of the ``commits``.
    """
    return [
        {
            "table": cell.table,
            "row": cell.row,
            "column": _name(cell.key[:-1]),
            "n": cell.summary["episodes"],
            "missing": cell.missing,
            **cell.summary,
            "policies": [summarize(rows)["SR"] for rows in cell.policies],
            "protocol": cell.protocol,
            "paper": cell.published,
            "commands": [result["command"] for result in cell.results],
            "commits": count_commits([cell]),
        }
        for cell in cells.values()
        if cell.results
    ]


def markdown_overview(cells: Mapping[Key, Cell]) -> str:
    """Return SR (%) of the paper's tables as one table: the paper's / ours on the 1,000 test scenes."""
    columns = [column for columns in COLUMNS.values() for column in columns]
    lines = []
    for row in ROWS:
        line = [row]
        for column in columns:
            paper, cell = TABLES[column].get(row), cells.get((*column, row))
            ours = f"**{cell.summary['SR']:.1f}**" if cell and cell.results else "-"
            if cell and cell.missing and cell.results:
                ours += f" ({len(cell.world_models)})"
            line.append(f"{paper[-1][0]} / {ours}" if paper else "")
        lines.append(line)
    names = [f"{table}: {_name(column)}" for table, columns in COLUMNS.items() for column in columns]
    paper = [cells[*column, row] for column in columns for row in ROWS if (*column, row) in cells]
    return f"{join_table(['', *names], lines)}\n\n{_notes(paper)}"


def markdown_column(cells: Mapping[Key, Cell], column: tuple[str, str, str]) -> str:
    """Return one column of a table of the paper with all metrics.

    Args:
        cells: result of :func:`dynmap_rl.paper.results.read_cells`.
        column: task, training and policy.

    Returns:
        The paper's numbers, ours by its protocol, and ours on the 1,000 test scenes, with what is missing and
        the commits below.
    """
    own, others = [cells[*column, row] for row in ROWS if (*column, row) in cells], _others(column[0])
    what = "SR (std)" + (f"; {', '.join(others)}" if others else "")
    head = ["", f"paper: {what}", f"here, paper's protocol: {what}", *_head(others)]
    lines = [
        [
            cell.row,
            _short(cell.published, others),
            _short(cell.protocol, others) if cell.results and cell.protocol else "-",
            *_numbers(cell, others),
        ]
        for cell in own
    ]
    return f"{join_table(head, lines)}\n\n{_notes(own)}"


def markdown_own(cells: Mapping[Key, Cell], table: str) -> str:
    """Return a table that the paper does not have.

    Args:
        cells: result of :func:`dynmap_rl.paper.results.read_cells` for this table and Table I.
        table: ``extra``, whose rows stand below those of Table I with the default world model, or ``ablations``, whose
            first row of each task is the default.
    """
    own, numbers, lines = [cell for cell in cells.values() if cell.table == table], ["DR", "PE"], []
    ablations = table == "ablations"
    for cell in own:
        row = "default" if ablations else cell.row.removesuffix(", plain CNN")
        default = cells.get((*cell.key[:-1], row))
        for c in [cell] if ablations or not default else [default, cell]:
            name = str(1 + TASKS.index(c.key[0])) if ablations else c.key[2]
            lines.append([c.row, name, *_numbers(c, numbers), _difference(c, default)])
    head = ["", "task" if ablations else "policy", *_head(numbers), "SR minus the default's [scenes], p"]
    return f"{join_table(head, lines)}\n\n{_notes(own)}"


def markdown_tables(cells: Mapping[Key, Cell]) -> str:
    """Return the overview, every column of the paper's tables under its name, and the tables of our own."""
    parts = [f"SR in %, the paper's / ours on the 1,000 test scenes\n\n{markdown_overview(cells)}"]
    for table, columns in COLUMNS.items():
        for column in columns:
            parts.append(f"Table {table}, {_name(column)}\n\n{markdown_column(cells, column)}")
    for table, what in OWN.items():
        parts.append(f"{what}\n\n{markdown_own(cells, table)}")
    return "\n\n".join(parts)


def p_text(p: float) -> str:
    """Return a probability with three digits."""
    return f"{p:.3f}" if p >= 0.001 else "< 0.001"


def join_table(head: list[str], rows: list[list[str]]) -> str:
    """Return a table in Markdown.

    Raises:
        ValueError: a row has not as many entries as the head.
    """
    if wrong := [row for row in rows if len(row) != len(head)]:
        raise ValueError(f"rows must have {len(head)} entries, got {wrong[0]}")
    return "\n".join(f"| {' | '.join(line)} |" for line in (head, ["---"] * len(head), *rows))


def _name(column: tuple[str, ...]) -> str:
    return ", ".join(column[1:])


def _others(task: str) -> list[str]:
    return [name for name in METRICS[task] if name != "SR"]


def _head(others: list[str]) -> list[str]:
    return [
        *others,
        "SR [scenes]",
        "SR of each world model",
        "their mean [world models]",
        "world models, policies",
    ]


def _numbers(cell: Cell, others: list[str]) -> list[str]:
    """Return the entries of a cell under :func:`_head`."""
    if not cell.results:
        return ["-"] * len(_head(others))
    summary = cell.summary
    rates, interval = summary["world_models"], summary["world_model_interval"]
    mean = f"{sum(rates) / len(rates):.1f} {_brackets(interval)}" if interval else "-"
    return [
        *(f"{summary[name]:.1f}" for name in others),
        f"**{summary['SR']:.1f}** {_brackets(summary['SR_interval'])}",
        ", ".join(f"{rate:.1f}" for rate in rates),
        mean,
        f"{len(rates)}, {len(cell.policies)}",
    ]


def _brackets(interval: tuple[float, float]) -> str:
    low, high = interval
    return f"[{low:.1f}, {high:.1f}]"


def _difference(cell: Cell, default: Cell | None) -> str:
    """Return the difference of two success rates in points, with its interval over the scenes, and p."""
    if cell is default:
        return ""
    if default is None or not (cell.results and default.results):
        return "-"
    found = outcome_gap([(1, cell.policies), (-1, default.policies)])
    return f"{scene_gap_text(found)}, {p_text(found['p'])}"


def _short(numbers: dict, others: list[str]) -> str:
    mean, std = numbers["SR"]
    rest = ", ".join(f"{numbers[name][0]:.0f}" for name in others)
    return f"{mean:.0f} ({std:.1f})" + (f"; {rest}" if rest else "")


def cause_table(rows: Iterable[tuple[str, int, Mapping[str, int]]]) -> str:
    """Return failed episodes by cause (% of the episodes) in Markdown.

    Args:
        rows: title, number of episodes, and number of failed episodes by cause.
    """
    rows = list(rows)
    found = {cause for *_, counts in rows for cause in counts}
    causes = [*(cause for cause in CAUSES if cause in found), *sorted(found - set(CAUSES))]
    lines = [
        [
            title,
            f"{100 * sum(counts.values()) / episodes:.1f}",
            *(f"{100 * counts[cause] / episodes:.1f}" if cause in counts else "" for cause in causes),
        ]
        for title, episodes, counts in rows
    ]
    return join_table(["% of the episodes", "fail", *causes], lines)


def scene_gap_text(gap: Mapping) -> str:
    """Return a result of :func:`dynmap_rl.evaluation.outcome_gap` with its interval over the scenes, if it has one."""
    text = f"{round(gap['gap'], 1) + 0.0:+.1f}"  # no -0.0
    if gap["interval"] is None:
        return text
    low, high = (round(end, 1) + 0.0 for end in gap["interval"])
    return f"{text} [{low:.1f}, {high:.1f}]"


def gap_text(ours: Sequence[float] | None, theirs: Sequence[float] | None) -> str:
    """Return the difference of two means of rates (%), with its interval where there is one; empty without rates."""
    if not (ours and theirs):
        return ""
    gap, interval = f"{fmean(ours) - fmean(theirs):+.1f}", welch_interval(ours, theirs)
    return f"{gap} [{interval[0]:+.1f}, {interval[1]:+.1f}]" if interval else gap


def commits_text(commits: Counter[str]) -> str:
    """Return how many runs each commit has made."""
    return ", ".join(f"{count} of `{commit}`" for commit, count in commits.most_common())


def devices_text(devices: Counter[str]) -> str:
    """Return how many results are of each GPU, as a sentence; empty if all are of a CPU."""
    gpus = [f"{count} on one {device}" for device, count in devices.most_common() if device != "cpu"]
    others = ", the others without a GPU" if devices["cpu"] else ""
    return f" Of {devices.total()} runs, {' and '.join(gpus)}{others}." if gpus else ""


def _notes(cells: Iterable[Cell]) -> str:
    """Return what is missing of some cells, and how many runs are of which commit where there are several."""
    cells = list(cells)
    missing, runs = sum(cell.missing for cell in cells), sum(len(cell.results) for cell in cells)
    complete = sum(not cell.missing for cell in cells)
    text = f"{len(cells)} cells of {runs} runs."
    if missing:
        text = (
            f"{complete} of {len(cells)} cells are complete; {missing} of {missing + runs} runs are missing."
        )
    commits = count_commits(cells)
    if len(commits) > 1:
        text += f" Runs of different code: {commits_text(commits)}."
    return text + devices_text(count_devices(result for cell in cells for result in cell.results))
