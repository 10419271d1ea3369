"""PPO, from states for the experts (paper, Sec. IV-C) and from whatever else an environment's ``state`` holds."""

from __future__ import annotations

import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

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
from dynmap_rl.runs.folder import load_training_state, save_training_state, truncate_metrics
from dynmap_rl.runs.loggers import log_metrics
from .loop import check_loss
from dynmap_rl.utils.devices import seed_everything
from dynmap_rl.utils.files import write_json
from dynmap_rl.utils.weights import save_weights

POSITIVE = (  # settings
    "num_envs", "iterations", "epochs", "minibatch", "checkpoint_every", "eval_episodes", "final_episodes", "threads",
)  # fmt: skip


def train_ppo(
    env: EnvBase,
    network: ExpertNetwork,
    folder: Path,
    settings,
    judge: Callable[[int], dict[str, float]],
    facts: dict,
) -> None:
    """Train a network on ``state``; a stopped run goes on from its last iteration, to the same weights.

    Args:
        env: ``[N]`` worlds with ``state``, ``is_success`` and ``dropped``, controlled by accelerations.
        network: changed in place.
        folder: run folder; gets ``metrics.jsonl`` and, in ``checkpoint``, ``iteration_NNN`` as safetensors and JSON
            every ``checkpoint_every`` iterations, and the training state.
        settings: with ``seed``, ``iterations``, ``epochs``, ``minibatch``, ``learning_rate``, ``gamma``,
            ``gae_lambda``, ``clip``, ``entropy``, ``checkpoint_every``, ``eval_episodes``, ``final_episodes`` and ``threads``.
        judge: rates of the network's mean action on so many fresh scenes, at least ``success`` and ``drop``.
        facts: about the run, written to the JSON of each checkpoint with what ``judge`` says.

    Raises:
        ValueError: the loss is not finite; the last training state, from before, is kept. Or that is of an earlier release.
    """
    inputs, width = network.mlp[0].in_features, network.mlp[0].out_features
    actor = make_actor(network)
    critic = ValueOperator(
        MLP(inputs, 1, num_cells=[width, width], activation_class=torch.nn.Tanh), in_keys=["state"]
    )
    advantage = GAE(
        gamma=settings.gamma, lmbda=settings.gae_lambda, value_network=critic, average_gae=True, shifted=True
    )
    policy_loss = ClipPPOLoss(
        actor,
        clip_epsilon=settings.clip,
        entropy_coeff=settings.entropy,
        critic_coeff=None,  # `update` does it, at the same time
        functional=False,  # which would put parameters in and out, a fourth of the time
    )
    networks = torch.nn.ModuleList([network, critic])
    optimizer = torch.optim.Adam(networks.parameters(), settings.learning_rate, eps=1e-5, fused=True)

    start, seconds = 0, 0.0
    state_path = folder / "checkpoint" / "training_state.pt"
    if state := load_training_state(state_path):
        if "networks" not in state:
            raise ValueError(f"{state_path} is of an earlier release; choose another --run")
        networks.load_state_dict(state["networks"])
        optimizer.load_state_dict(state["optimizer"])
        start, seconds = state["iteration"], state["seconds"]
    truncate_metrics(folder, start)

    # Every iteration starts from fresh, seeded scenes, so that a resumed run equals an uninterrupted one.
    frames = env.batch_size.numel() * EPISODE_STEPS
    progress = tqdm(
        range(start, settings.iterations), initial=start, total=settings.iterations, unit="iteration"
    )
    for iteration in progress:
        began = time.perf_counter()
        seed_everything(settings.seed + 1000 * (iteration + 1))
        env.set_seed(settings.seed + 1000 * (iteration + 1))
        for group in optimizer.param_groups:
            group["lr"] = settings.learning_rate * (1 - 0.9 * iteration / settings.iterations)
        batch = collect(env, network)
        losses = update(batch, policy_loss, critic, advantage, optimizer, settings)
        done = batch["next", "done"].squeeze(-1)
        seconds += time.perf_counter() - began
        metrics = {
            "frames": (iteration + 1) * frames,
            "seconds": seconds,
            "reward": batch["next", "reward"].mean(),
            "success": batch["next", "is_success"].squeeze(-1)[done].float().mean(),
            "drop": batch["next", "dropped"].squeeze(-1)[done].float().mean(),
            **losses,
        }
        log_metrics(folder, iteration + 1, settings.logger, **metrics)
        progress.set_postfix(success=f"{metrics['success']:.2f}", drop=f"{metrics['drop']:.2f}")
        last = iteration + 1 == settings.iterations
        if last or (iteration + 1) % settings.checkpoint_every == 0:
            judged = judge(settings.final_episodes if last else settings.eval_episodes)
            path = folder / "checkpoint" / f"iteration_{iteration + 1:03d}"
            save_weights(path.with_suffix(".safetensors"), network)
            at = {"iteration": iteration + 1, "frames": metrics["frames"], "seconds": round(seconds, 1)}
            write_json(path.with_suffix(".json"), judged | facts | at)
            progress.write(
                f"iteration {iteration + 1}: success {judged['success']:.1%}, drop {judged['drop']:.1%}"
            )
        save_training_state(
            state_path,
            networks=networks.state_dict(),
            optimizer=optimizer.state_dict(),
            iteration=iteration + 1,
            seconds=seconds,
        )


@torch.no_grad()
def collect(env: EnvBase, network: ExpertNetwork) -> TensorDictBase:
    """An episode's length in each world, ``[N, T]``, by actions drawn from the network's normal distribution."""

    def act(td: TensorDictBase) -> TensorDictBase:
        return td.set("action", torch.normal(*network(td["state"])))

    batch = env.rollout(EPISODE_STEPS, act, break_when_any_done=False)
    # The probabilities of all at once: a distribution a step takes longer than the network.
    distribution = IndependentNormal(*network(batch["state"]))
    return batch.set("action_log_prob", distribution.log_prob(batch["action"]))


def update(
    batch: TensorDictBase,
    policy_loss: ClipPPOLoss,
    critic: ValueOperator,
    advantage: GAE,
    optimizer,
    settings,
) -> dict[str, float]:
    """PPO's epochs of minibatches over one batch ``[N, T]``; ``ValueError`` where a loss is not finite."""
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

    # The two networks have nothing in common: each learns in a thread of its own, where there are two.
    with ThreadPoolExecutor(1) as other:
        for _ in range(settings.epochs):
            for part in batch[torch.randperm(len(batch))].split(settings.minibatch):
                optimizer.zero_grad()
                values = other.submit(learn_values, part) if settings.threads > 1 else None
                losses = learn_actions(part)
                losses["loss_critic"] = values.result() if values else learn_values(part)
                norm = torch.nn.utils.clip_grad_norm_(parameters, 0.5)
                optimizer.step()
    # Weights that are not finite stay so: the last loss tells. Nor is there a first loss to compare with: the critic's
    # rises with the returns, in a good run fivefold.
    check_loss((losses["loss_objective"] + losses["loss_critic"] + losses["loss_entropy"]).item(), norm)
    return {k: losses[k].item() for k in ("loss_objective", "loss_critic", "entropy")}
