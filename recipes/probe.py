"""Look into world models: how far they predict without frames, and which of their states tell which dynamics.

    python recipes/probe.py --runs runs/decoupled/balance_reaching/position_velocity_recurrent
    python recipes/probe.py --runs runs/tables/balance_reaching_decoupled_none_recurrent,runs/tables/...

Held-out demonstrations with their actions: after a second of frames each world model that decodes positions predicts
two more without (mm and degrees, beside standing still). And a linear map of each state, fitted to the demonstrations
of training, tells position, velocity and acceleration (R^2). Writes two figures, ``probe.json`` and
``report.html``.
"""

import dataclasses
from dataclasses import dataclass
from pathlib import Path

from dynmap_rl.utils.cli import command_line
from dynmap_rl.utils.cli import run_recipe


@dataclass
class Config:
    # Run folders with world models, ids on the hub, or balance_reaching, which ships; separated by commas.
    runs: str = "runs/decoupled/balance_reaching/position_velocity_recurrent"
    # Recorded dataset: a folder or a hub id; by default datasets/balance_reaching, recorded where it is not there.
    dataset: str | None = None
    # Demonstrations that the linear maps are fitted to.
    train_episodes: int = 100
    # Held-out demonstrations that all is measured on.
    test_episodes: int = 50
    # Steps of 50 ms with frames, at first.
    context: int = 20
    # Steps that are then predicted without.
    horizon: int = 40
    # Folder of the results.
    output: Path = Path("runs/probe")


def main(config: Config) -> None:
    from dynmap_rl.data.demonstrations import load_dataset
    from dynmap_rl.data.recording.shards import record_dataset
    from dynmap_rl.evaluation.open_loop import open_loop_errors
    from dynmap_rl.modules.supervision import row_name
    from dynmap_rl.reporting.html import write_html
    from dynmap_rl.reporting.figures import plot_open_loop
    from dynmap_rl.reporting.figures import plot_probes
    from dynmap_rl.evaluation.probing import probe
    from dynmap_rl.runs.lookup import load_source
    from dynmap_rl.utils.files import write_json

    if min(config.train_episodes, config.test_episodes) < 1:
        raise ValueError("--train_episodes and --test_episodes must be at least 1")
    models = {}
    for run in config.runs.split(","):
        world_model, source = load_source(run.strip())
        name = f"{row_name(world_model.supervision, source['training'])}, {source['training']}"
        if name in models:
            raise ValueError(f"--runs has {name} twice")
        models[name] = world_model
    dataset = config.dataset or record_dataset(Path("datasets/balance_reaching"))
    train = load_dataset(dataset, "train")[: config.train_episodes]
    test = load_dataset(dataset, "eval")[: config.test_episodes]
    open_loop = {
        name: open_loop_errors(model, test, config.context, config.horizon)
        for name, model in models.items()
        if "position" in model.supervision
    }
    probes = {name: probe(model, train, test) for name, model in models.items()}
    lines = []
    for name, errors in open_loop.items():
        last = {key: values[-1] for key, values in errors["model"].items()}
        cart, block, seconds = last["cart_mm"], last["block_mm"], 0.05 * config.horizon
        off = f"the cart is {cart:.0f} mm off, the block {block:.0f} mm"
        lines.append(f"{name}: after {seconds:.1f} s without frames {off}")
    for name, states in probes.items():
        for state, quantities in states.items():
            values = "  ".join(f"{q} {sum(r2) / len(r2):5.2f}" for q, r2 in quantities.items())
            lines.append(f"{name}: R^2 of {state:8} {values}")
    text = "\n".join(lines)
    print(text)
    (config.output / "open_loop.png").unlink(missing_ok=True)  # of another --runs
    if open_loop:
        plot_open_loop(open_loop, config.output / "open_loop.png")
    plot_probes(probes, config.output / "probes.png")
    settings = dataclasses.asdict(config)
    write_html(config.output, "What world models know", text, command_line(), settings)
    facts = {"command": command_line(), "train_episodes": len(train), "test_episodes": len(test)}
    write_json(config.output / "probe.json", facts | {"open_loop": open_loop, "probes": probes})
    print(f"written: {config.output}")


if __name__ == "__main__":
    run_recipe(main, Config)
