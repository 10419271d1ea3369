"""Play a task, watch an expert or a policy, look into a world model, record demonstrations of a person.

    python recipes/play.py --task bin_dropping
    python recipes/play.py --task mujoco:PlateSlide --driver expert
    python recipes/play.py --policy balance_reaching    # ships with the package; or a run folder
    python recipes/play.py --policy balance_reaching --imagine_from 20 --steps 120 --gif play.gif
    python recipes/play.py --record datasets/mine

Arrows or WASD move the cart, Q and E tilt it, and it follows the pointer while a mouse button is held. In a MuJoCo task the
keys move the hand as the first camera sees it, Q and E up and down. TAB changes the driver: person, expert or policy. With
a policy, the window also shows the world model's prediction, one step ahead; I switches the frames off and on
(imagination). PAGE UP and PAGE DOWN make the policy's frames late; cart and block are then also drawn translucent, where
the model predicts them. B shows the traces of the next body, R starts the next scene, SPACE pauses, ESC ends.

With --record, every successful episode that the person alone drove is kept at once. At the end, the episodes become a
LeRobot dataset with a page in runs/play; the next session adds to it.
"""

import sys
from dataclasses import dataclass
from pathlib import Path

from dynmap_rl.utils.cli import command_line, refuse, run_recipe


@dataclass(frozen=True)
class Config:
    """Settings of the recipe."""

    # Task: balance_reaching, balance_reaching_obstacle, bin_dropping, mujoco:FetchPush (FetchSlide, PlateSlide, Soccer),
    # or module:Class of your own; by default the policy's.
    task: str | None = None
    # Run with world model and policy: a folder, a hub id, or balance_reaching (shipped).
    policy: str | None = None
    # Seed of the run's policy.
    seed: int = 0
    # Expert: a task whose expert ships, or a folder of checkpoints; by default the task's own.
    expert: str | None = None
    # Step of every episode from which the world model continues without frames, as if the key I were pressed.
    imagine_from: int | None = None
    # Delay of the policy's frames in control steps, at most 20.
    delay: int = 0
    # First driver: person, expert or policy; by default the policy where there is one.
    driver: str | None = None
    # Number of the first scene.
    scene: int = 0
    # Folder of a LeRobot dataset for your demonstrations.
    record: Path | None = None
    # Id on the Hugging Face hub (user/name) to upload that dataset to, at the end.
    push_to_hub: str | None = None
    # Side of the scene on the screen, in pixels.
    size: int = 384
    # Number of steps after which the window closes.
    steps: int | None = None
    # File of an animation of the window (GIF); needs --steps.
    gif: Path | None = None


def main(config: Config) -> None:
    """Play, record and upload."""
    import torch

    from dynmap_rl.data.demonstrations import META, load_meta
    from dynmap_rl.data.format.hub import check_login, check_uploadable, push_dataset
    from dynmap_rl.data.recording.human import list_shards, next_scene, open_folder, publish_episodes
    from dynmap_rl.envs.tasks import get_task
    from dynmap_rl.play.session import MAX_DELAY, Session
    from dynmap_rl.play.window import PlayWindow
    from dynmap_rl.reporting.dataset_page import write_dataset_page
    from dynmap_rl.runs.folder import plain_settings
    from dynmap_rl.runs.lookup import find_run, load_actor, task_of_run

    torch.set_num_threads(1)  # networks are small, and threads would wait for each other
    run = find_run(config.policy) if config.policy else None
    task = config.task or (run and task_of_run(run)) or "balance_reaching"
    if not run:
        refuse(config, Config(), ["seed"], "no --policy")
    actor = load_actor(run, config.seed) if run else None
    layout = get_task(task, from_file=not config.task).layout
    if config.size < 64 or (config.steps is not None and config.steps < 1):
        raise ValueError(
            f"--size must be at least 64 and --steps at least 1, got {config.size} and {config.steps}"
        )
    if config.imagine_from is not None and not (actor and 1 <= config.imagine_from < layout.steps):
        raise ValueError(
            f"--imagine_from must be a step of 1 to {layout.steps - 1}, with --policy, got {config.imagine_from}"
        )
    if not 0 <= config.delay <= (MAX_DELAY if actor else 0):
        raise ValueError(f"--delay must be 0 to {MAX_DELAY} steps, with --policy, got {config.delay}")
    if config.gif and config.gif.suffix != ".gif":
        raise ValueError(f"--gif must end with .gif, got {config.gif}")
    if config.gif and not config.steps:
        raise ValueError("--gif needs --steps, the length of the animation")
    if config.push_to_hub and not config.record:
        raise ValueError("--push_to_hub needs --record, the folder of the demonstrations")
    if config.push_to_hub:
        check_uploadable(task, layout)
        check_login()
    published, first = 0, config.scene
    if config.record:
        open_folder(config.record, task)
        first += next_scene(config.record, task)
        if (config.record / META).exists():
            published = len(load_meta(config.record)["episodes"])
    # Demonstrations are of scenes for training, and every session begins with new ones.
    split = "train" if config.record else "validation"
    session = Session(task, actor, config.expert, first, split, config.delay)
    if config.driver:
        if config.driver not in session.drivers:
            needs = {"expert": "; give --expert", "policy": "; give --policy"}.get(config.driver, "")
            raise ValueError(
                f"--driver must be one of {', '.join(session.drivers)}, got {config.driver!r}{needs}"
            )
        session.driver = config.driver
    window, frames = PlayWindow(session, config.size), []
    try:
        play(config, task, session, window, frames, layout.dt)
    finally:
        window.close()
        session.env.close()
        count = len(list_shards(config.record, task)) if config.record else 0
        if count > max(published, 1):
            print(f"{count} episodes: {publish_episodes(config.record, task)}")
            folder = Path("runs/play") / config.record.name
            write_dataset_page(folder, config.record, plain_settings(config), command_line(sys.argv))
    if config.gif:
        save_film(frames, config.gif, layout.dt)
    if config.push_to_hub:
        if not config.record.exists():
            raise ValueError(
                f"{config.record} needs two episodes at least to be a dataset, and to be uploaded"
            )
        push_dataset(config.record, config.push_to_hub)
        print(f"pushed: {config.push_to_hub}")


def play(config: Config, task: str, session, window, frames: list, dt: float) -> None:
    """Play until the window is closed, or for a number of steps."""
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
            and session.drove == {"person"}
            and session.succeeded
        ):
            count = keep_episode(config.record, task, session.episode(), session.scene_seed)
            print(f"kept: {count} episodes in {config.record}.parts", flush=True)
        waited = waited + 1 if session.over and not window.paused else 0
        if waited > 1 / dt:  # a second to see how it ended
            session.restart()
        clock.tick(1 / dt if config.steps is None else 0)


def save_film(frames: list, path: Path, dt: float) -> None:
    """Write every other picture at half size, all with the same 128 colours, against flicker."""
    import numpy as np
    from PIL import Image

    from dynmap_rl.reporting.media import frame_durations

    images = [Image.fromarray(frame) for frame in frames[::2]]
    images = [image.resize((image.width // 2, image.height // 2)) for image in images]
    some = np.concatenate([np.asarray(image) for image in images[:: len(images) // 16 + 1]])
    # The median cut, which is the default, has no colour left for few pixels such as the goal's.
    colors = Image.fromarray(some).quantize(128, Image.Quantize.FASTOCTREE)
    images = [image.quantize(palette=colors, dither=Image.Dither.NONE) for image in images]
    path.parent.mkdir(parents=True, exist_ok=True)
    durations = frame_durations(len(images), 2 * dt)
    images[0].save(path, save_all=True, append_images=images[1:], duration=durations, loop=0)
    print(f"written: {path}")


if __name__ == "__main__":
    run_recipe(main, Config, sys.argv, stopped="repeat the command")
