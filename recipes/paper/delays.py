"""Measure success against the delay of the frames, and draw the figure and the table.

    python recipes/paper/delays.py --dry_run
    python recipes/paper/delays.py --runs balance_reaching --eval.episodes 100 --results runs/delays
    python recipes/paper/delays.py --runs runs/tables/A,runs/tables/B --conditions stale,imagined
    python recipes/paper/delays.py --write        # figure and table from the results alone

Each run is evaluated under each condition: on stale frames; with the world model rolled forward; with a delay that is
reported wrongly; with jitter, lost frames, and pushes that the policy is not told; and, in the place of its policy, with
a feed-forward policy that is trained to act on an old state of the run's world model and the actions since. A run and a
condition have one JSON file with an entry for each delay. The same command resumes a stopped grid. For a
LeRobot policy, such as ACT of recipes/baseline.py, the first actions of a chunk are skipped, one for a step of delay.
"""

import sys
from dataclasses import asdict, dataclass
from functools import cache
from pathlib import Path

from dynmap_rl.evaluation.settings import Evaluation
from dynmap_rl.training.settings import PolicyTraining
from dynmap_rl.utils.cli import command_line, refuse, run_recipe
from dynmap_rl.utils.devices import Compute

RESULTS = Path(__file__).resolve().parents[1] / "results"


@dataclass(frozen=True)
class Config:
    """Settings of the recipe."""

    # Runs with commas between: folders, hub ids, or balance_reaching (shipped); or folders of LeRobot policies.
    runs: str = "balance_reaching"
    # Seed of the runs' policies.
    seed: int = 0
    # Task; by default that of each run.
    task: str | None = None
    # Dataset of the policy with past actions: a folder or a hub id; by default datasets/TASK, recorded where missing.
    dataset: str | None = None
    # Conditions with commas between; by default all.
    conditions: str = ""
    # Delays in control steps, with commas between; by default 0 to 30.
    delays: str = ""
    # Folder of results and figures; the figures of the repository are in recipes/results/media.
    results: Path = RESULTS / "delays"
    # List the measurements and stop.
    dry_run: bool = False
    # Draw the figures and write the table, README.md in the folder of the results, from the results alone.
    write: bool = False
    # Training of the policy with past actions.
    policy: PolicyTraining = PolicyTraining(kind="feedforward")
    # Evaluation in closed loop, here without the paper's protocol.
    eval: Evaluation = Evaluation(paper_episodes=0)
    # Device and cores.
    compute: Compute = Compute()


def main(config: Config) -> None:
    """Evaluate what has no result yet; draw and write."""
    import torch

    from dynmap_rl.envs.tasks import get_task
    from dynmap_rl.paper.delays import CONDITIONS, DELAYS, frame_delay
    from dynmap_rl.runs.lookup import find_run, has_world_model

    recipe, baseline = "recipes/paper/delays.py", PolicyTraining(kind="feedforward")
    refuse(config.eval, Evaluation(paper_episodes=0), ["paper_episodes"], recipe, "eval.")
    refuse(config.policy, baseline, ["kind", "copies", "corrections"], recipe, "policy.")
    if config.write:
        return write(config)
    conditions = config.conditions.split(",") if config.conditions else list(CONDITIONS)
    if unknown := ",".join(sorted(set(conditions) - set(CONDITIONS))):
        raise ValueError(f"--conditions must be any of {','.join(CONDITIONS)}, got {unknown}")
    if not all(text.isdigit() for text in config.delays.split(",") if config.delays):
        raise ValueError(f"--delays must be numbers of steps with commas between, got {config.delays}")
    delays = [int(text) for text in config.delays.split(",")] if config.delays else DELAYS
    torch.set_num_threads(config.compute.threads)
    for run in config.runs.split(","):
        for condition in conditions:
            path, result = open_result(config, run, condition)
            stateless = condition == "past_actions" and not has_world_model(find_run(run))
            if stateless or (CONDITIONS[condition][2] and not get_task(result["task"]).planar):
                continue  # policies of LeRobot have no world model, and only carts can be pushed
            for steps in delays:
                if frame_delay(condition, steps) is None or str(steps) in result["cells"]:
                    continue
                print(f"{path.stem}, {steps} steps", flush=True)
                if not config.dry_run:
                    evaluate_cell(config, path, result, steps)
    if not config.dry_run:
        write(config)


def open_result(config: Config, run: str, condition: str) -> tuple[Path, dict]:
    """Return file and content of the result of a run under a condition, which may be there in part."""
    from dynmap_rl.envs.tasks import get_task
    from dynmap_rl.paper.delays import find_training
    from dynmap_rl.runs.lookup import find_run, has_world_model, task_of_run
    from dynmap_rl.utils.files import read_json

    folder = find_run(run)
    if not folder.exists():
        raise ValueError(f"--runs must be runs or policies, got {run}; train one with recipes/decoupled.py")
    task = config.task or task_of_run(folder) or "balance_reaching"
    name = get_task(task, from_file=not config.task).name
    name = "_".join([name, *Path(run).parts[-4:], f"seed_{config.seed}", condition]).replace("/", "")
    path = config.results / f"{name}.json"
    facts = {"run": run, "seed": config.seed, "task": task, "condition": condition}
    facts |= {"split": config.eval.split, "episodes": config.eval.episodes}
    if condition == "past_actions":
        facts |= {"dataset": config.dataset, "training": asdict(config.policy)}
    trained = {"trained": find_training(folder)}
    result = read_json(path) if path.exists() else facts | trained | {"cells": {}}
    if "training" in result:  # settings that are younger than the result had their defaults
        result["training"] = asdict(PolicyTraining()) | result["training"]
    facts |= trained if has_world_model(folder) else {}
    if other := [key for key, value in facts.items() if result.get(key) != value]:
        names = ", ".join(other).replace("trained", "training of the run")
        raise ValueError(f"{path} has another {names}; choose another --results or remove the file")
    return path, result


def evaluate_cell(config: Config, path: Path, result: dict, steps: int) -> None:
    """Evaluate a run under a condition with one delay, and add the cell to the file."""
    from dynmap_rl.evaluation.protocol import evaluate
    from dynmap_rl.paper.delays import CONDITIONS, frame_delay
    from dynmap_rl.runs.lookup import find_run, has_world_model
    from dynmap_rl.utils.devices import device_name
    from dynmap_rl.utils.files import read_json, write_json
    from dynmap_rl.utils.version import find_commit

    _, _, pushed, stale = CONDITIONS[result["condition"]]
    delay = frame_delay(result["condition"], steps)
    actor, facts = load_actor(config, result, None if stale else delay)
    if result["cells"] and result.get("weights_sha256", facts["weights_sha256"]) != facts["weights_sha256"]:
        raise ValueError(f"{path} is of other weights; choose another --results or remove the file")
    workers = config.compute.threads if has_world_model(find_run(result["run"])) else 1
    found = evaluate(actor, result["task"], config.eval, delay, pushed, workers)["test"]
    cell = {name: found["summary"][name] for name in ("SR", "SR_interval", "DR", "DR_interval", "PE")}
    cell |= {"success": found["rows"]["success"], "command": command_line(sys.argv), "commit": find_commit()}
    cell |= {"device": device_name(config.compute.device)}
    if path.exists():  # another process may have added cells
        result["cells"] |= read_json(path)["cells"]
    result["cells"][str(steps)] = cell
    write_json(path, result | facts)
    print(f"    SR {cell['SR']:.1f} %   DR {cell['DR']:.1f} %   PE {cell['PE']:.1f} mm", flush=True)


def load_actor(config: Config, result: dict, delay) -> tuple:
    """Return the actor of a result, which bridges a delay where one is given, and the names of its row, policy and weights."""
    from dynmap_rl.envs.tasks import get_task
    from dynmap_rl.modules.delayed_actor import DelayedActor
    from dynmap_rl.paper.delays import name_row
    from dynmap_rl.runs.lookup import find_run, has_world_model, load_actor
    from dynmap_rl.training.dataset import find_or_record
    from dynmap_rl.utils.devices import choose_device
    from dynmap_rl.utils.weights import fingerprint

    folder, device = find_run(result["run"]), choose_device(config.compute.device)
    if not has_world_model(folder):
        from dynmap_rl.integrations.lerobot import LeRobotActor

        actor = LeRobotActor(folder, device, get_task(result["task"]), cut=delay is not None)
        weights = fingerprint(actor.policy)
        return actor, {"row": actor.policy.config.type, "policy": "LeRobot", "weights_sha256": weights}
    actor = load_actor(folder, config.seed).to(device)
    facts = {"row": name_row(folder, actor.world_model), "policy": actor.policy.kind}
    facts |= {"weights_sha256": fingerprint(actor)}
    if result["condition"] == "past_actions":
        facts["policy"], dataset = "feedforward", find_or_record(result["task"], config.dataset)
        return train_past_actions(folder, dataset, config.policy, config.seed), facts
    return (DelayedActor(actor, max_delay=delay.longest) if delay else actor), facts


@cache
def train_past_actions(folder: Path, dataset: str | Path, settings: PolicyTraining, seed: int):
    """Train the policy with past actions on the world model of a run; one policy serves all delays."""
    from dynmap_rl.paper.past_actions import make_past_actions_actor
    from dynmap_rl.runs.lookup import load_actor

    world_model = load_actor(folder, seed).world_model.requires_grad_(False)
    return make_past_actions_actor(world_model, dataset, settings, seed)


def write(config: Config) -> None:
    """Draw the figures and write the table from the results."""
    from dynmap_rl.paper.delays import delay_page, plot_conditions, plot_delays, read_delays
    from dynmap_rl.utils.files import write_bytes

    if not (results := read_delays(config.results)):
        raise ValueError(f"{config.results} must have results; run recipes/paper/delays.py first")
    media = RESULTS / "media" if config.results.resolve() == RESULTS / "delays" else config.results
    plot_delays(results, media / "delays.png")
    plot_conditions(results, media / "delays_conditions.png")
    write_bytes(config.results / "README.md", delay_page(results).encode())
    print(f"written: {config.results}/README.md; delays.png and delays_conditions.png in {media}")


if __name__ == "__main__":
    run_recipe(main, Config, sys.argv)
