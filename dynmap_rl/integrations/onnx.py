"""World model and policy as ONNX files, and an actor that runs them with onnxruntime and NumPy alone."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from dynmap_rl.modules.actor import Actor

PARTS = "encoder", "transition", "policy"


def export_to_onnx(run: str | Path, folder: str | Path, seed: int = 0) -> Path:
    """Write world model and policy of a run for onnxruntime.

    Of every input and output, the first axis is the batch, of any size. Memories are zeros at the start of an episode.

    ==================== ============================================= ===================================
    file                 inputs                                        outputs
    ==================== ============================================= ===================================
    ``encoder.onnx``     ``pixels`` uint8 ``[B, 3, S, cameras * S]``   ``latent`` ``[B, Z]``
    ``transition.onnx``  ``latent``, ``action`` ``[B, A]``,            ``predicted_latent``,
                         ``hidden1``, ``cell1``, ``hidden2``,          ``next_hidden1``, and so on
                         ``cell2`` ``[B, H]``
    ``policy.onnx``      ``latent``, ``hidden1``, ``hidden2``,         ``action`` (SI units),
                         ``goal`` ``[B, G]`` (SI units) and, of a      ``next_policy_hidden1``, and so on
                         recurrent policy, ``policy_hidden1``, ...
    ==================== ============================================= ===================================

    Args:
        run: a run (see :func:`dynmap_rl.runs.find_run`).
        folder: gets the three files.
        seed: seed of the policy.

    Returns:
        The folder.

    Raises:
        ValueError: the run has no policy of that seed.
        ImportError: the extra ``onnx`` is missing.
    """
    import onnx  # noqa: F401 (before anything is loaded)
    import onnxscript  # noqa: F401
    import torch

    from dynmap_rl.runs.lookup import load_actor

    actor, folder, batch = load_actor(run, seed).eval(), Path(folder).expanduser(), torch.export.Dim("batch")
    folder.mkdir(parents=True, exist_ok=True)
    with TemporaryDirectory(dir=folder) as temporary:  # parts of two exports would fit together
        for part, (function, sizes, outputs) in _list_parts(actor).items():
            size, cameras = actor.world_model.image_size, actor.world_model.cameras
            pixels = torch.zeros(2, 3, size, cameras * size, dtype=torch.uint8)
            inputs = tuple(pixels if size is None else torch.zeros(2, size) for size in sizes.values())
            with warnings.catch_warnings(), torch.no_grad():
                warnings.simplefilter("ignore")
                program = torch.onnx.export(
                    _as_module(actor, function),
                    inputs,
                    dynamo=True,
                    verbose=False,
                    input_names=list(sizes),
                    output_names=outputs,
                    dynamic_shapes=(tuple({0: batch} for _ in inputs),),
                )
            program.save(Path(temporary) / f"{part}.onnx")
        for path in Path(temporary).iterdir():
            path.replace(folder / path.name)
    return folder


def _list_parts(actor: Actor) -> dict[str, tuple[Callable, dict[str, int | None], list[str]]]:
    """Return for each part a function of tensors, the sizes of its inputs (None: frames), and the outputs' names."""
    model, policy = actor.world_model, actor.policy
    memory = dict.fromkeys(actor.memory, model.hidden_size)
    policy_memory = dict.fromkeys(actor.latent_actor.policy_memory, policy.width)
    states = {"latent": model.latent_size, "hidden1": model.hidden_size, "hidden2": model.hidden_size}
    action, goal = model.transition.action.size, policy.goal.size

    def encode(pixels):
        return model.encoder.encode(pixels.float())

    def predict(latent, action, *state):
        predicted, state = model.step(latent, action, state)
        return predicted, *state

    def act(latent, hidden1, hidden2, goal, *state):
        action, state = policy.step(latent, hidden1, hidden2, goal, state)
        return action, *(state or ())

    return {
        "encoder": (encode, {"pixels": None}, ["latent"]),
        "transition": (
            predict,
            {"latent": model.latent_size, "action": action, **memory},
            ["predicted_latent", *(f"next_{name}" for name in memory)],
        ),
        "policy": (
            act,
            {**states, "goal": goal, **policy_memory},
            ["action", *(f"next_{name}" for name in policy_memory)],
        ),
    }


def _as_module(actor: Actor, function: Callable):
    """Return a module that is a function of tensors and has the weights of an actor."""
    from torch import nn

    class Function(nn.Module):
        def __init__(self):
            super().__init__()
            self.actor = actor

        def forward(self, *inputs):
            return function(*inputs)

    return Function().eval()


class OnnxActor:
    """Exported world model and policy in a control loop, without PyTorch.

    .. code-block:: python

        actor = OnnxActor(export_to_onnx("balance_reaching", "exported"))
        actor.reset()  # as an episode begins
        action = actor.act(frame[None].transpose(0, 3, 1, 2), goal[None])[0]  # once in each control step

    Args:
        folder: written by :func:`export_to_onnx`.
        threads: threads of onnxruntime.

    Raises:
        ValueError: the folder does not have the three files.
    """

    def __init__(self, folder: str | Path, threads: int = 1):
        import onnxruntime

        options = onnxruntime.SessionOptions()
        options.log_severity_level = 3  # without warnings about shapes that are merged
        options.intra_op_num_threads = options.inter_op_num_threads = threads
        files = {part: Path(folder).expanduser() / f"{part}.onnx" for part in PARTS}
        if missing := [file.name for file in files.values() if not file.exists()]:
            raise ValueError(f"{folder} must have {', '.join(missing)}; write them with export_to_onnx")
        self._parts = {
            part: onnxruntime.InferenceSession(file, options, providers=["CPUExecutionProvider"])
            for part, file in files.items()
        }
        self.reset()

    def reset(self) -> None:
        """Clear the memory, as an episode begins in every row of the batch."""
        self._memory: dict[str, np.ndarray] = {}

    def act(self, pixels: np.ndarray, goal: np.ndarray) -> np.ndarray:
        """Return the actions ``[B, A]`` of this step.

        Args:
            pixels: frames uint8 ``[B, 3, S, cameras * S]``.
            goal: goals ``[B, G]`` (SI units).

        Raises:
            ValueError: the batch has another size than in the last call.
        """
        if any(len(memory) != len(pixels) for memory in self._memory.values()):
            raise ValueError(
                f"pixels must have the batch of the last call, got {len(pixels)}; call reset for another"
            )
        values = self._memory | {"pixels": pixels, "goal": goal.astype(np.float32)}
        found = {}
        for part in ("encoder", "policy", "transition"):
            found |= self._run(part, values | found)
        self._memory = {name.removeprefix("next_"): found[name] for name in found if name.startswith("next_")}
        return found["action"]

    def _run(self, part: str, values: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        """Return the outputs of a part by name; what is missing among its inputs is memory at its start."""
        session, batch = self._parts[part], len(values["pixels"])
        inputs = {
            each.name: values[each.name]
            if each.name in values
            else np.zeros((batch, each.shape[1]), np.float32)
            for each in session.get_inputs()
        }
        names = [each.name for each in session.get_outputs()]
        return dict(zip(names, session.run(names, inputs), strict=True))
