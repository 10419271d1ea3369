"""Numbers of the paper's Tables I, II and III: mean (std) over three policy seeds of DR (%), PE (mm) and SR (%)."""

from __future__ import annotations

METRICS = {  # reported metrics of each task
    "balance_reaching": ("DR", "PE", "SR"),
    "balance_reaching_obstacle": ("DR", "SR"),
    "bin_dropping": ("SR",),
}

# (task, training, policy) to rows; the world models of tasks 2 and 3 are frozen ones of task 1.
TABLES = {
    ("balance_reaching", "decoupled", "feedforward"): {
        "Only-RGB": ((55, 2.5), (69, 15.6), (21, 5.7)),
        "RGB+[P]": ((31, 8.4), (33, 2.8), (62, 9.1)),
        "RGB+[V]": ((11, 2.5), (41, 5.8), (79, 1.9)),
        "RGB+[A]": ((15, 3.4), (80, 21.2), (53, 5.7)),
        "RGB+[P+V]": ((7, 5.0), (25, 2.2), (85, 5.2)),
        "RGB+[P+A]": ((34, 4.3), (56, 4.7), (42, 8.6)),
        "RGB+[V+A]": ((9, 2.5), (31, 7.0), (80, 1.6)),
        "RGB+[P+V+A]": ((9, 5.0), (25, 1.6), (84, 7.5)),
    },
    ("balance_reaching", "decoupled", "recurrent"): {
        "Only-RGB": ((14, 1.6), (31, 1.3), (73, 3.8)),
        "RGB+[P]": ((4, 3.3), (21, 2.7), (92, 4.3)),
        "RGB+[V]": ((7, 1.9), (29, 5.0), (85, 3.8)),
        "RGB+[A]": ((5, 0.9), (36, 3.5), (79, 4.1)),
        "RGB+[P+V]": ((5, 2.5), (23, 3.7), (89, 0.9)),
        "RGB+[P+A]": ((2, 1.6), (32, 6.1), (84, 1.6)),
        "RGB+[V+A]": ((8, 4.3), (28, 7.0), (82, 7.1)),
        "RGB+[P+V+A]": ((5, 0.9), (25, 2.2), (87, 1.9)),
    },
    ("balance_reaching", "joint", "recurrent"): {
        "End-to-End": ((19, 9.0), (71, 21.9), (57, 10.6)),
        "Only-RGB": ((17, 5.0), (92, 31.4), (64, 5.9)),
        "RGB+[P]": ((5, 0.9), (58, 17.1), (67, 8.1)),
        "RGB+[V]": ((22, 6.5), (84, 31.6), (51, 10.9)),
        "RGB+[A]": ((15, 3.8), (43, 4.1), (65, 3.8)),
        "RGB+[P+V]": ((9, 1.9), (54, 11.0), (59, 9.6)),
        "RGB+[P+A]": ((6, 4.3), (34, 2.1), (79, 6.2)),
        "RGB+[V+A]": ((19, 0.9), (48, 6.1), (57, 5.7)),
        "RGB+[P+V+A]": ((7, 2.5), (43, 7.2), (70, 8.6)),
    },
    ("balance_reaching_obstacle", "decoupled", "recurrent"): {
        "Only-RGB": ((1, 0.9), (80, 5.9)),
        "RGB+[P]": ((0, 0.0), (91, 3.8)),
        "RGB+[V]": ((2, 1.6), (80, 4.3)),
        "RGB+[A]": ((2, 1.6), (82, 4.9)),
        "RGB+[P+V]": ((1, 0.9), (90, 3.3)),
        "RGB+[P+A]": ((0, 0.0), (87, 2.5)),
        "RGB+[V+A]": ((1, 0.9), (83, 8.1)),
        "RGB+[P+V+A]": ((2, 1.6), (84, 3.3)),
    },
    ("balance_reaching_obstacle", "joint", "recurrent"): {
        "End-to-End": ((4, 1.6), (72, 4.3)),
        "Only-RGB": ((4, 1.6), (73, 4.7)),
        "RGB+[P]": ((1, 0.9), (86, 4.9)),
        "RGB+[V]": ((3, 2.5), (79, 6.6)),
        "RGB+[A]": ((3, 2.5), (77, 6.6)),
        "RGB+[P+V]": ((4, 3.3), (75, 6.2)),
        "RGB+[P+A]": ((0, 0.0), (76, 7.1)),
        "RGB+[V+A]": ((3, 0.9), (83, 4.1)),
        "RGB+[P+V+A]": ((1, 1.9), (87, 6.6)),
    },
    ("bin_dropping", "decoupled", "recurrent"): {
        "Only-RGB": ((44, 0.0),),
        "RGB+[P]": ((46, 4.3),),
        "RGB+[V]": ((52, 1.6),),
        "RGB+[A]": ((55, 6.2),),
        "RGB+[P+V]": ((53, 3.4),),
        "RGB+[P+A]": ((46, 2.8),),
        "RGB+[V+A]": ((41, 3.4),),
        "RGB+[P+V+A]": ((54, 2.8),),
    },
    ("bin_dropping", "joint", "recurrent"): {
        "End-to-End": ((47, 4.1),),
        "Only-RGB": ((46, 1.6),),
        "RGB+[P]": ((51, 4.1),),
        "RGB+[V]": ((40, 2.8),),
        "RGB+[A]": ((41, 12.3),),
        "RGB+[P+V]": ((42, 8.2),),
        "RGB+[P+A]": ((39, 4.1),),
        "RGB+[V+A]": ((46, 9.1),),
        "RGB+[P+V+A]": ((45, 5.2),),
    },
}


def paper_numbers(result: dict) -> dict[str, tuple[float, float]] | None:
    """Return the paper's mean and standard deviation of each metric for the same row; None where it has no such row.

    Args:
        result: an ``eval.json`` of a run in closed loop.
    """
    source = result["world_model"]
    if source.get("task") != "balance_reaching":  # a robot dataset is of no task
        return None
    column = (
        "decoupled" if source["training"] == "decoupled" else "joint"
    )  # the latter has the row End-to-End
    return find_numbers(result["task"], column, result["policy"], result["row"])


def find_numbers(task: str, training: str, policy: str, row: str) -> dict[str, tuple[float, float]] | None:
    """Return the paper's mean and standard deviation of each metric of a cell; None where it has no such cell."""
    numbers = TABLES.get((task, training, policy), {}).get(row)
    return numbers and dict(zip(METRICS[task], numbers, strict=True))
