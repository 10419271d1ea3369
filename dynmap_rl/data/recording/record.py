"""Recording of expert rollouts as a LeRobot v3.0 dataset with dynamics columns.

A recording is made of shards in ``<root>.parts``, which are merged into ``<root>`` at the end. A killed recording keeps
its finished shards, and the same call resumes. The result depends neither on interruptions nor on the number of workers.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

from tqdm import tqdm

from dynmap_rl.envs.tasks import get_task
from dynmap_rl.experts.network import find_expert, task_of_expert
from dynmap_rl.utils.cluster import check_launcher, run_by_ray
from dynmap_rl.utils.files import read_json, write_json
from dynmap_rl.utils.processes import open_pool, share

from ..demonstrations import DERIVED, FORMAT, META, load_meta
from .plans import find_checkpoints
from .shards import Shard, merge_shards, parts_folder, record_shard

KINDS = ("demonstrations", "undisturbed", "exploration")
SHARD_EPISODES = 25


def record_dataset(
    root: str | Path,
    task: str = "balance_reaching",
    kind: str = "demonstrations",
    episodes: int = 300,
    eval_episodes: int = 50,
    workers: int = 2,
    expert: str | Path | None = None,
    launcher: str = "local",
) -> Path:
    """Record training and held-out episodes, or resume an interrupted recording.

    Args:
        root: folder of the dataset; a complete recording with the same settings is left as it is.
        task: name of the task, or ``module:Class`` of your own.
        kind: ``demonstrations`` (successful episodes only), ``undisturbed`` (such demonstrations without noise and
            pushes) or ``exploration`` (noise and detours, all episodes).
        episodes: number of episodes of the split ``train``.
        eval_episodes: number of episodes of the split ``eval``.
        workers: number of processes, this one included. A script that uses more must have the guard
            ``if __name__ == "__main__"``.
        expert: folder of the expert's checkpoints; by default the expert that ships for the task.
        launcher: ``local``, or ``ray`` for one CPU of a Ray cluster a shard; the folder must be shared by its machines.

    Returns:
        The folder of the dataset.

    Raises:
        ValueError: an argument is wrong, the expert is of another task, the folder holds something else or is being
            recorded to, or too few episodes succeed.
        OSError: the folder cannot be written, or a worker died. Finished shards are kept.
    """
    from filelock import FileLock, Timeout

    check_launcher(launcher)
    if workers < 1:
        raise ValueError(f"workers must be at least 1, got {workers}")
    root = Path(root).expanduser().absolute()
    settings = {"task": task, "kind": kind, "episodes": episodes, "eval_episodes": eval_episodes}
    settings |= {"expert": str(expert or task), "format": FORMAT}
    _check_settings(root, settings)
    parts = parts_folder(root)
    if (root / META).exists() and not parts.exists():
        return root
    try:
        parts.mkdir(parents=True, exist_ok=True)
        with FileLock(parts / ".lock", timeout=0):
            if not (root / META).exists():
                _record(root, parts, settings, workers, launcher)
            shutil.rmtree(parts)
    except ValueError:  # a mistake in the task
        if not _has_episodes(parts):
            shutil.rmtree(parts)
        raise
    except Timeout as error:
        raise ValueError(
            f"{root} is being recorded by another process; wait for that process or stop it"
        ) from error
    except ChildProcessError as error:
        raise OSError(
            f"a worker died while recording {root}; repeat the call with fewer workers, finished episodes are kept (a "
            'script must call it below if __name__ == "__main__")'
        ) from error
    except OSError as error:
        raise OSError(
            f"cannot record {root} ({error}); is there space, and may the folder be written? The same call resumes"
        ) from error
    return root


def _check_settings(root: Path, settings: dict) -> None:
    task = get_task(settings["task"])
    find_checkpoints(settings["task"], settings["expert"])
    if settings["kind"] not in KINDS:
        raise ValueError(f"kind must be one of {', '.join(KINDS)}, got {settings['kind']!r}")
    for name in ("episodes", "eval_episodes"):
        if settings[name] < 1:
            raise ValueError(f"{name} must be at least 1, got {settings[name]}")
    stored = _stored_settings(root)
    if stored not in (None, settings):
        changed = ", ".join(
            f"{name} {stored.get(name)} instead of {value}"
            for name, value in settings.items()
            if stored.get(name) != value
        )
        where = root if (root / META).exists() else parts_folder(root)
        raise ValueError(f"{where} holds another recording ({changed}); choose another folder or delete it")
    if not task.has_demonstrator:
        task_of_expert(settings["expert"], task)


def _stored_settings(root: Path) -> dict | None:
    """Return the settings of the recording in a folder, complete or not; None where there is none."""
    if (root / DERIVED).exists():
        raise ValueError(
            f"{root} must be a recording or a new folder, got a dataset with derived dynamics; choose another folder"
        )
    if (root / META).exists():
        meta = load_meta(root)
        sizes = {name: end - first for name, (first, end) in meta["splits"].items()}
        stored = {name: meta.get(name) for name in ("task", "kind", "expert", "format")}
        return stored | {"episodes": sizes["train"], "eval_episodes": sizes["eval"]}
    if root.exists() and (not root.is_dir() or any(root.iterdir())):
        raise ValueError(
            f"{root} must be a recording or a new folder, got something else; choose another folder or delete it"
        )
    parts = parts_folder(root)
    return read_json(parts / "settings.json") if _has_episodes(parts) else None


def _has_episodes(parts: Path) -> bool:
    return any(path.is_dir() and path.suffix != ".tmp" for path in parts.glob("*"))


def _record(root: Path, parts: Path, settings: dict, workers: int, launcher: str) -> None:
    write_json(parts / "settings.json", settings)
    for leftover in parts.glob("*.tmp"):
        shutil.rmtree(leftover)
    shards = _plan_shards(parts.absolute(), settings)  # a worker of Ray may run in another folder
    todo = [shard for shard in shards if not shard.folder.exists()]
    total, left = (sum(shard.count for shard in s) for s in (shards, todo))
    with tqdm(total=total, initial=total - left, unit="episode", desc=f"recording {root.name}") as progress:
        _run_shards(todo, workers, launcher, lambda shard: progress.update(shard.count))
    merged = parts / "merged.tmp"
    merge_shards(shards, merged, settings)
    merged.replace(root)


def _plan_shards(parts: Path, settings: dict) -> list[Shard]:
    expert = settings["expert"]
    if (path := find_expert(expert)) == Path(expert).expanduser() and path.is_dir():
        expert = str(path.absolute())
    return [
        Shard(
            folder=parts / f"{split}_{number:04d}",
            task=settings["task"],
            expert=expert,
            kind=settings["kind"],
            split=split,
            number=number,
            count=min(SHARD_EPISODES, total - number * SHARD_EPISODES),
        )
        for split, total in (("train", settings["episodes"]), ("eval", settings["eval_episodes"]))
        for number in range(-(-total // SHARD_EPISODES))
    ]


def _run_shards(shards: list[Shard], workers: int, launcher: str, done: Callable[[Shard], object]) -> None:
    """Record shards, and call ``done`` with each that is complete."""
    if launcher == "ray":
        for shard, end in run_by_ray(record_shard, shards):
            end()
            done(shard)
        return
    with open_pool(min(workers, len(shards)) - 1, "use fewer workers") as pool:
        share(pool, record_shard, shards, done)
