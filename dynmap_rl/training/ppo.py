"""PPO on the entry ``state`` of an environment: of experts (paper, Sec. IV-C), or latents of a world model."""

from __future__ import annotations

import pickle
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import torch
from tensordict import TensorDictBase
from torch.nn.functional import smooth_l1_loss
from torchrl.envs import EnvBase
from torchrl.modules import MLP, IndependentNormal, ValueOperator
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value import GAE
from tqdm import tqdm

from dynmap_rl.envs.world import EPISODE_STEPS
from dynmap_rl.experts.network import ExpertNetwork, make_actor
from dynmap_rl.runs.folder import (
    compare_settings,
    load_training_state,
    plain_settings,
    save_training_state,
    truncate_metrics,
)
from dynmap_rl.runs.loggers import log_metrics
from dynmap_rl.utils.devices import seed_everything
from dynmap_rl.utils.files import write_json
from dynmap_rl.utils.processes import open_pool, share
from dynmap_rl.utils.weights import save_weights

from .loop import check_loss
from .settings import PPOTraining

GROUP = 48  # most worlds that a process rolls out together; larger groups are hardly faster
KEYS = (
    "state",
    "action",
    "action_log_prob",
    *(("next", k) for k in ("state", "reward", "done", "terminated", "dropped")),
)


def train_ppo(
    make_env: Callable[[int], EnvBase],
    network: ExpertNetwork,
    folder: Path,
    settings: PPOTraining,
    *,
    judge: Callable[[int], dict[str, float]],
    facts: dict,
    threads: int = 1,
    logger: str | None = None,
) -> None:
    """Train a network by PPO; a stopped run resumes from its last iteration, to the same weights.

    Args:
        make_env: picklable function that makes an environment of a number of worlds, with ``state``, ``is_success`` and
            ``dropped``, controlled by accelerations.
        network: changed in place.
        folder: run folder; gets ``metrics.jsonl`` and, in ``checkpoint``, the training state and every
            ``checkpoint_every`` iterations ``iteration_NNN`` as safetensors and JSON.
        settings: of PPO.
        judge: function of a number of scenes to the rates of the mean action, at least ``success`` and ``drop``.
        facts: entries of the JSON of each checkpoint, beside those of ``judge``.
        threads: number of processes that roll out worlds. With two or more, actor and critic learn at the same time,
            in threads of this process. The weights are the same for any number. A script that uses more than one must
            have the guard ``if __name__ == "__main__"``.
        logger: ``tensorboard``, ``wandb``, ``trackio`` or None.

    Raises:
        ValueError: the loss is not finite, or the training state is of an earlier release, of other settings or of
            more iterations; the state is kept.
        OSError: a process died.
    """
    folder = Path(folder)
    inputs, width = network.mlp[0].in_features, network.mlp[0].out_features
    actor = make_actor(network)
    critic = ValueOperator(
        MLP(inputs, 1, num_cells=[width, width], activation_class=torch.nn.Tanh), in_keys=["state"]
    )
    advantage = GAE(
        gamma=settings.gamma,
        lmbda=settings.gae_lambda,
        value_network=critic,
        average_gae=True,
        # One pass of the critic, where no time limit falls into a rollout.
        shifted=settings.steps <= EPISODE_STEPS,
    )
    policy_loss = ClipPPOLoss(
        actor,
        clip_epsilon=settings.clip,
        entropy_coeff=settings.entropy,
        critic_coeff=None,  # ``update`` computes that loss in another thread
        functional=False,  # a functional call per minibatch takes a fourth of the time
    )
    networks = torch.nn.ModuleList([network, critic])
    optimizer = torch.optim.Adam(networks.parameters(), settings.learning_rate, eps=1e-5, fused=True)

    start, seconds = 0, 0.0
    form = replace(settings, iterations=1)  # a training may go on for more
    state_path = folder / "checkpoint" / "training_state.pt"
    if state := load_training_state(state_path):
        if "networks" not in state:
            raise ValueError(f"{state_path} is of an earlier release; choose another --run")
        start, seconds = state["iteration"], state["seconds"]
        if compare_settings(state.get("form", plain_settings(form)), form):
            raise ValueError(f"{state_path} is of a training with other settings; choose another --run")
        if start > settings.iterations:
            raise ValueError(
                f"PPOTraining.iterations must be at least the {start} of {state_path}, got {settings.iterations}"
            )
        try:
            networks.load_state_dict(state["networks"])
        except RuntimeError as error:
            raise ValueError(f"{state_path} is of a network of another size; choose another --run") from error
        optimizer.load_state_dict(state["optimizer"])
    truncate_metrics(folder, start)

    frames = settings.num_envs * settings.steps
    progress = tqdm(
        range(start, settings.iterations), initial=start, total=settings.iterations, unit="iteration"
    )
    with open_pool(threads - 1, "the same command resumes") as pool:
        for iteration in progress:
            began = time.perf_counter()
            for group in optimizer.param_groups:
                group["lr"] = settings.learning_rate * (1 - 0.9 * iteration / settings.iterations)
            batch = collect(make_env, network, settings, iteration, pool)
            seed_everything(settings.seed + 1000 * (iteration + 1))
            losses = update(batch, policy_loss, critic, advantage, optimizer, settings, threads)
            seconds += time.perf_counter() - began
            metrics = {
                "frames": (iteration + 1) * frames,
                "seconds": seconds,
                "reward": batch["next", "reward"].mean(),
                "drop": batch["next", "dropped"].any(1).float().mean(),
                **losses,
            }
            log_metrics(folder, iteration + 1, logger, **metrics)
            progress.set_postfix(reward=f"{metrics['reward']:.2f}", drop=f"{metrics['drop']:.2f}")
            last = iteration + 1 == settings.iterations
            if last or (iteration + 1) % settings.checkpoint_every == 0:
                judged = judge(settings.final_episodes if last else settings.eval_episodes)
                path = folder / "checkpoint" / f"iteration_{iteration + 1:03d}"
                at = {"iteration": iteration + 1, "frames": metrics["frames"], "seconds": round(seconds, 1)}
                write_json(path.with_suffix(".json"), judged | facts | at)
                # Last: a checkpoint is listed by its weights.
                save_weights(path.with_suffix(".safetensors"), network)
                rates = f"success {judged['success']:.1%}, drop {judged['drop']:.1%}"
                progress.write(f"iteration {iteration + 1}: {rates}")
            save_training_state(
                state_path,
                networks=networks.state_dict(),
                optimizer=optimizer.state_dict(),
                iteration=iteration + 1,
                seconds=seconds,
                form=plain_settings(form),
            )


def collect(
    make_env: Callable[[int], EnvBase],
    network: ExpertNetwork,
    settings: PPOTraining,
    iteration: int,
    pool: ProcessPoolExecutor | None = None,
) -> TensorDictBase:
    """Roll out the worlds of an iteration in groups, by the processes of a pool and this one, ``[N, T]``."""
    count = -(-settings.num_envs // GROUP)
    sizes = [len(group) for group in torch.arange(settings.num_envs).tensor_split(count)]
    # Everything random follows from seed, iteration and group, so that a resumed run equals an uninterrupted one.
    draws = np.random.SeedSequence((settings.seed, iteration)).generate_state(count).tolist()
    work = partial(explore, pickle.dumps((make_env, network)), settings.steps)
    return torch.cat([pickle.loads(part) for part in share(pool, work, list(zip(sizes, draws, strict=True)))])


@torch.no_grad()
def explore(pickled: bytes, steps: int, group: tuple[int, int]) -> bytes:
    """Roll out a group, its number of worlds and its seed, from new scenes with actions drawn from the network.

    Environment, network and result are pickled: as values of another process, each of their tensors would hold a file open.
    """
    (worlds, seed), (make_env, network) = group, pickle.loads(pickled)
    threads = torch.get_num_threads()
    torch.set_num_threads(1)  # processes share the cores, and a sum's last bit may depend on the threads
    try:
        env = make_env(worlds)
        env.set_seed(seed)
        generator = torch.Generator().manual_seed(seed)

        def act(td: TensorDictBase) -> TensorDictBase:
            return td.set("action", torch.normal(*network(td["state"]), generator=generator))

        batch = env.rollout(steps, act, break_when_any_done=False)
        # All probabilities at once: one distribution a step takes longer than the network.
        distribution = IndependentNormal(*network(batch["state"]))
        batch["action_log_prob"] = distribution.log_prob(batch["action"])
        return pickle.dumps(batch.select(*KEYS))
    finally:
        torch.set_num_threads(threads)


def update(
    batch: TensorDictBase,
    policy_loss: ClipPPOLoss,
    critic: ValueOperator,
    advantage: GAE,
    optimizer,
    settings: PPOTraining,
    threads: int = 1,
) -> dict[str, float]:
    """Run the epochs of minibatches over one batch ``[N, T]`` and return the last losses.

    Raises:
        ValueError: a loss is not finite.
    """
    with torch.no_grad():
        batch = advantage(batch)
    batch = batch.select("state", "action", "action_log_prob", "advantage", "value_target").reshape(-1)
    parameters = [p for group in optimizer.param_groups for p in group["params"]]

    def learn_values(part: TensorDictBase) -> torch.Tensor:
        loss = smooth_l1_loss(critic.module(part["state"]), part["value_target"])
        loss.backward()
        return loss.detach()

    def learn_actions(part: TensorDictBase) -> TensorDictBase:
        losses = policy_loss(part)
        (losses["loss_objective"] + losses["loss_entropy"]).backward()
        return losses.detach()

    # The two networks share no weights: with two threads each learns in a thread of its own.
    with ThreadPoolExecutor(1) as other:
        for _ in range(settings.epochs):
            for part in batch[torch.randperm(len(batch))].split(settings.minibatch):
                optimizer.zero_grad()
                values = other.submit(learn_values, part) if threads > 1 else None
                losses = learn_actions(part)
                losses["loss_critic"] = values.result() if values else learn_values(part)
                norm = torch.nn.utils.clip_grad_norm_(parameters, 0.5)
                optimizer.step()
    # Weights that are not finite stay so: the last loss suffices. There is no first loss to compare with, since the
    # critic's rises with the returns.
    check_loss((losses["loss_objective"] + losses["loss_critic"] + losses["loss_entropy"]).item(), norm)
    return {k: losses[k].item() for k in ("loss_objective", "loss_critic", "entropy")}
