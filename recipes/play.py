"""Play a task, watch an expert or a policy at it, look into its world model, record demonstrations of your own.

    python recipes/play.py --task bin_dropping
    python recipes/play.py --policy balance_reaching    # ships with the package; or a run folder
    python recipes/play.py --policy balance_reaching --imagine_from 20 --steps 120 --gif play.gif
    python recipes/play.py --record datasets/mine

Arrows or WASD move the cart, Q and E tilt it, a pressed mouse button calls it; TAB changes who drives: you, the expert
or the policy. With a policy the window shows what its world model predicts, one step ahead or, in imagination (I), on
and on without frames, beside the simulator. B shows the dynamics of cart or block, R takes the next scene, SPACE
pauses, ESC ends.

With --record, every successful episode that you alone drove is kept at once; at the end they become a LeRobot dataset with
dynamics columns, shown on a page in runs/play, and the next session adds to it.
"""

import dataclasses
from dataclasses import dataclass
from pathlib import Path

from dynmap_rl.utils.cli import run_recipe


@dataclass
class Config:
    # Name of the task: balance_reaching, balance_reaching_obstacle, bin_dropping, or module:Class of your own; by
    # default the one that the policy was trained on, otherwise balance_reaching.
    task: str | None = None
    # Run folder of ours with world model and policy, its id on the hub, or balance_reaching, which ships with the
    # package.
    policy: str | None = None
    # Which of the run's policies.
    seed: int = 0
    # Expert: the name of the task that it ships for, or a folder of checkpoints; by default the task's own.
    expert: str | None = None
    # From this step of every episode on the world model goes on without frames, as if I were pressed; with a policy.
    imagine_from: int | None = None
    # Who drives at first: hand, expert or policy; by default the policy where there is one.
    driver: str | None = None
    # Number of the first scene.
    scene: int = 0
    # Folder of a LeRobot dataset for your demonstrations.
    record: Path | None = None
    # Id on the Hugging Face hub (user/name) to upload that dataset to, at the end.
    push_to_hub: str | None = None
    # Side of the scene on the screen, in pixels.
    size: int = 384
    # End after so many steps (for films).
    steps: int | None = None
    # An animation of the window, as a GIF.
    gif: Path | None = None


def main(config: Config) -> None:
    from dynmap_rl.data.format.hub import push_dataset
    from dynmap_rl.data.recording.human import list_shards
    from dynmap_rl.data.recording.human import next_scene
    from dynmap_rl.data.recording.human import open_folder
    from dynmap_rl.data.recording.human import publish_episodes
    from dynmap_rl.envs.tasks import get_task
    from dynmap_rl.envs.world import CONTROL_DT
    from dynmap_rl.envs.world import EPISODE_STEPS
    from dynmap_rl.reporting.dataset_page import write_dataset_page
    from dynmap_rl.runs.lookup import find_run
    from dynmap_rl.runs.lookup import load_actor
    from dynmap_rl.runs.lookup import task_of_run
    from dynmap_rl.play.window import PlayWindow
    from dynmap_rl.play.session import Session

    run = find_run(config.policy) if config.policy else None
    task = config.task or (run and task_of_run(run)) or "balance_reaching"
    actor = load_actor(run, config.seed) if run else None
    get_task(task, from_file=not config.task)
    if config.size < 64 or (config.steps is not None and config.steps < 1):
        raise ValueError("--size must be at least 64 and --steps at least 1")
    if config.imagine_from is not None and not (actor and 1 <= config.imagine_from < EPISODE_STEPS):
        raise ValueError(
            f"--imagine_from is a step of 1 to {EPISODE_STEPS - 1}, and needs --policy, whose world model imagines"
        )
    if config.gif and not config.steps:
        raise ValueError("--gif needs --steps, the number of steps that the film shows")
    if config.push_to_hub and not config.record:
        raise ValueError("--push_to_hub needs --record, the folder of the demonstrations")
    kept, first = 0, config.scene
    if config.record:
        open_folder(config.record, task)
        kept, first = len(list_shards(config.record, task)), first + next_scene(config.record, task)
    # Demonstrations are of scenes for training, and every session begins with new ones.
    session = Session(task, actor, config.expert, first, split="train" if config.record else "validation")
    if config.driver:
        if config.driver not in session.drivers:
            raise ValueError(f"--driver is one of {', '.join(session.drivers)}, not {config.driver!r}")
        session.driver = config.driver
    window, frames = PlayWindow(session, config.size), []
    try:
        play(config, task, session, window, frames, CONTROL_DT)
    finally:
        window.close()
        count = len(list_shards(config.record, task)) if config.record else 0
        if count > max(kept, 1) or (count > 1 and not config.record.exists()):
            print(f"{count} episodes: {publish_episodes(config.record, task)}")
            folder = Path("runs/play") / config.record.name
            write_dataset_page(folder, config.record, dataclasses.asdict(config))
    if config.gif:
        save_film(frames, config.gif)
    if config.push_to_hub:
        if not config.record.exists():
            raise ValueError(
                f"{config.record} needs two episodes at least to be a dataset, and to be uploaded"
            )
        push_dataset(config.record, config.push_to_hub)
        print(f"pushed: {config.push_to_hub}")


def play(config: Config, task: str, session, window, frames: list, dt: float) -> None:
    """Until the window is closed, or for a number of steps."""
    from dynmap_rl.data.recording.human import keep_episode
    from dynmap_rl.envs.renderer import pygame

    clock, step, waited = pygame.time.Clock(), 0, 0
    while window.open and step != config.steps:
        window.handle()
        was_over = session.over
        if not window.paused:
            session.imagining |= session.world.steps == config.imagine_from
            session.step()
            step += 1
        picture = window.draw()
        if config.gif:
            frames.append(picture)
        if (
            session.over
            and not was_over
            and config.record
            and session.drove == {"hand"}
            and session.succeeded
        ):
            count = keep_episode(config.record, task, session.episode(), session.scene_seed)
            print(f"kept: {count} episodes in {config.record}.parts", flush=True)
        waited = waited + 1 if session.over and not window.paused else 0
        if waited > 1 / dt:  # a second to see how it ended
            session.restart()
        clock.tick(1 / dt if config.steps is None else 0)


def save_film(frames: list, path: Path) -> None:
    """One picture in two, at half size, in real time, all with the same 128 colours, or they would flicker."""
    import numpy as np
    from PIL import Image

    images = [Image.fromarray(frame) for frame in frames[::2]]
    images = [image.resize((image.width // 2, image.height // 2)) for image in images]
    some = np.concatenate([np.asarray(image) for image in images[:: len(images) // 16 + 1]])
    colors = Image.fromarray(some).quantize(128)
    images = [image.quantize(palette=colors, dither=Image.Dither.NONE) for image in images]
    path.parent.mkdir(parents=True, exist_ok=True)
    images[0].save(path, save_all=True, append_images=images[1:], duration=100, loop=0)
    print(f"written: {path}")


if __name__ == "__main__":
    run_recipe(main, Config)
