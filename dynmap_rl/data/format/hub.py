"""Upload of recordings to the Hugging Face hub, with a card, a picture and the tag by which LeRobot finds them."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from tensordict import TensorDict

from dynmap_rl.envs.protocol import Layout
from dynmap_rl.envs.task import LAYOUT
from dynmap_rl.envs.world import CONTROL_DT, EPISODE_STEPS
from dynmap_rl.utils.files import read_json
from dynmap_rl.utils.hub import first_line

from ..demonstrations import DERIVED, META, find_layout, load_dataset, load_meta
from .quiet import quiet

PICTURE = "picture.png"
FOLDERS = ["data/", "meta/", "videos/", "images/"]  # all that a LeRobot dataset can have
PAPER = "Visual Imitation Learning of Non-Prehensile Manipulation Tasks with Dynamics-Supervised Models"
CITATION = f"""\
@misc{{mustafa_dynamics_mapping,
  title  = {{{PAPER}}},
  author = {{Mustafa, Abdullah and Hanai, Ryo and Ramirez-Alpizar, Ixchel G. and Erich, Floris and
            Nakajo, Ryoichi and Domae, Yukiyasu and Ogata, Tetsuya}},
  url    = {{https://github.com/Automation-Research-Team/DynamicsMapping-2D}}
}}"""
DESCRIPTION = """\
{kind} of the task `{task}` of dynmap_rl, for world models that are supervised on the dynamics of the scene:
"{instruction}" A cart carries a free-standing block over a scene of 1 m x 1 m: {episodes} episodes of {steps} steps
at {fps} Hz.

![The first episodes, one in each row]({picture})

How it was made: PyMunk simulates, pygame draws, {maker}. The command was
`python recipes/{command}`.

| column | shape | content |
|---|---|---|
| `observation.images.front` | 64, 64, 3 | the frame, lossless |
| `observation.state` | 5 | commanded cart pose x, y, theta (m, m, rad) and goal x, y (m) |
| `action` | 3 | change of the commanded cart pose in one step (m, m, rad) |
| `next.reward`, `next.done`, `next.success` | 1 | after the action |
| `expert_action` | 3 | what the expert would have done, without noise and pushes: to be imitated |
| `disturbed` | 1 | a push acted in this step in the place of the expert |
{dynamics}

{origin}

`{meta}` holds the splits ({splits}), constants of normalisation, and scene, seed and expert of every episode."""

SIMULATED = f"""\
The dynamics are the simulator's. The acceleration is the change of the velocity since the last step over {CONTROL_DT} s, and
0 at the start."""
CONTENTS = {
    "position": "{names} (m, angles in rad)",
    "velocity": "its rate (m/s, rad/s)",
    "acceleration": "change of the velocity (m/s^2, rad/s^2)",
    "found": "whether what an entry belongs to was found in the frame",
}
DERIVATION = """\
The dynamics were derived with `python recipes/add_dynamics.py --source {source}`, and are judged {verdict}. All options and
checks are in `meta/dynamics.json`."""


def check_uploadable(task: str, layout: Layout) -> None:
    """Raise ``ValueError`` for a recording that :func:`push_dataset` refuses, by its task and layout."""
    if layout != LAYOUT:
        raise ValueError(
            f"--push_to_hub needs a recording of cart and block, whose card is written here, got {task}; upload it with "
            "LeRobotDataset.push_to_hub"
        )


def check_login() -> None:
    """Raise ``ValueError`` where nothing could be uploaded, so that it is known before a recording."""
    from huggingface_hub import constants, get_token

    if constants.HF_HUB_OFFLINE:
        raise ValueError("--push_to_hub needs the hub, but HF_HUB_OFFLINE is set; unset it")
    if get_token() is None:
        raise ValueError("--push_to_hub needs an account on the hub; log in with `hf auth login`")


def push_dataset(root: str | Path, repo_id: str) -> None:
    """Upload a recording to the Hugging Face hub, with a card and a picture.

    Files that are there already are not sent again. Files of an earlier recording under the same id are deleted. The
    card has the content, the columns with units, the license and the paper.

    Args:
        root: folder of the recording.
        repo_id: id on the hub (``user/name``).

    Raises:
        ValueError: the folder is not a recording of a task of cart and block.
        OSError: the hub refuses the upload or cannot be reached.
    """
    meta = load_meta(root)
    check_uploadable(meta["task"], find_layout(meta))
    derived = read_json(path) if (path := Path(root) / DERIVED).exists() else None
    with quiet():
        from huggingface_hub import HfApi
        from lerobot.datasets import LeRobotDataset

        hub = {"repo_id": repo_id, "repo_type": "dataset"}
        try:
            dataset = LeRobotDataset(repo_id, root=root, video_backend="pyav")
            draw_episodes(load_dataset(root, "train"), Path(root) / PICTURE)
            HfApi().create_repo(**hub, exist_ok=True)
            # LeRobot's own upload would leave stale files. After this upload it only adds the card and the tag.
            HfApi().upload_folder(
                **hub, folder_path=root, ignore_patterns=["images/"], delete_patterns=FOLDERS
            )
            dataset.push_to_hub(
                tags=["dynamics", "world-model", "imitation-learning"],
                license="mit",
                dataset_description=_describe(
                    meta, dataset.meta.features, dataset.meta.tasks.index[0], derived
                ),
                paper=PAPER,
                url="https://github.com/Automation-Research-Team/DynamicsMapping-2D (the paper's)",
                citation_bibtex=CITATION,
            )
        except Exception as error:  # the hub's client and the HTTP library below it raise many kinds
            reason = first_line(error)
            raise OSError(
                f"cannot push {root} to {repo_id} ({reason}); check the name, the network, and `hf auth login`"
            ) from error


def draw_episodes(episodes: TensorDict, path: Path, rows: int = 3, columns: int = 8, zoom: int = 2) -> None:
    """Draw frames of the first episodes ``[E, T]``, evenly spaced in time, one episode in each row.

    Args:
        episodes: ``[E, T]`` with ``pixels``.
        path: image file to write.
        rows: number of episodes.
        columns: number of frames of each.
        zoom: pixels of the image for each pixel of a frame.

    Raises:
        OSError: the file cannot be written.
    """
    steps = np.linspace(0, episodes.shape[1] - 1, columns).round().astype(int)
    frames = episodes["pixels"][:rows, steps].permute(0, 3, 1, 4, 2)  # row, y, column, x, RGB
    picture = frames.flatten(2, 3).flatten(0, 1).numpy().repeat(zoom, 0).repeat(zoom, 1)
    if not cv2.imwrite(str(path), picture[..., ::-1]):
        raise OSError(f"{path} cannot be written; is there space, and may the folder be written?")


KINDS = {"human": "Demonstrations of a person", "undisturbed": "Undisturbed demonstrations"}


def _describe(meta: dict, features: dict, instruction: str, derived: dict | None) -> str:
    splits, task, kind = meta["splits"], meta["task"], meta["kind"]
    train, test = (end - first for first, end in (splits["train"], splits["eval"]))
    collect = f"collect.py --task {task} --kind {kind} --episodes {train} --eval_episodes {test}"
    collect += f" --expert {meta['expert']}" if meta["expert"] != task else ""
    maker, command = {
        "demonstrations": (
            "state-based PPO experts act; all episodes succeed, two of three with noise, some with short pushes",
            collect,
        ),
        "undisturbed": (
            "state-based PPO experts act; all episodes succeed, without noise and pushes",
            collect,
        ),
        "exploration": ("state-based PPO experts act, with noise and detours", collect),
        "human": ("a person drives; all episodes succeed", f"play.py --task {task} --record FOLDER"),
    }[kind]
    return DESCRIPTION.format(
        kind=KINDS.get(kind, kind.capitalize()),
        task=task,
        instruction=instruction,
        episodes=len(meta["episodes"]),
        steps=EPISODE_STEPS,
        fps=round(1 / CONTROL_DT),
        picture=PICTURE,
        maker=maker,
        command=command,
        dynamics="\n".join(
            f"| `{column}` | {feature['shape'][0]} | {content.format(names=', '.join(feature['names']))} |"
            for name, content in CONTENTS.items()
            if (feature := features.get(column := f"dynamics.{name}"))
        ),
        origin=DERIVATION.format(**derived) if derived else SIMULATED,
        meta=META,
        splits=", ".join(f"{name} {first} to {end - 1}" for name, (first, end) in splits.items()),
    )
