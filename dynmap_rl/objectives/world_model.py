"""Losses of a world model: RGB reconstruction, latent consistency and dynamics (paper, Eq. 4a and 5)."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import dispatch
from tensordict.utils import NestedKey, unravel_key
from torchrl.objectives.common import LossModule

from dynmap_rl.modules.layers import color_weights
from dynmap_rl.modules.world_model import WorldModel
from dynmap_rl.utils.ranks import mean_over_ranks, rank, ranks

from .windows import check_windows


class WorldModelLoss(LossModule):
    """Losses of Eq. 4a and 5 on windows of frames, actions and dynamics.

    Every term is the mean over the time steps t >= 1 of a root mean square: the L2 norm of the paper's equations
    (not its square), divided by the square root of the number of entries. Frames, latents and dynamics then have one
    scale.

    Input: ``pixels`` uint8 ``[B, T, 3, S, cameras * S]``, ``action`` ``[B, T, A]`` and, for every supervised quantity,
    ``("dynamics", quantity)`` ``[B, T, D]``, in SI units. Optional: a mask of valid steps, bool ``[B, T]`` or
    ``[B, T, 1]``, under ``loss_mask_key`` of :class:`torchrl.objectives.LossModule`, by default
    ``("collector", "mask")``; invalid steps are left out. Also optional: ``labelled``, bool ``[B, T]``,
    ``[B, T, 1]`` or ``[B, T, D]``, the steps, or entries, whose dynamics are known. Unknown entries count as right, and the
    loss of the dynamics is the mean over the steps with a known one.

    Output: ``loss_rgb`` (times ``beta_rgb``), ``loss_latent`` (times ``beta_z``) and, where supervised, ``loss_position``,
    ``loss_velocity``, ``loss_acceleration`` (times ``beta_dynamics``): scalars whose sum is to be minimised.

    Args:
        world_model: world model to train.
        beta_z: weight of the latent loss.
        beta_dynamics: weight of the loss of every supervised quantity.
        stop_gradient: train only the predicted change of the latent with the latent loss. Its full gradient favours
            latents that do not vary, and the reconstruction stalls.
        rarity: weight of rare colours in ``loss_rgb``, see :func:`color_weights`; 0 is the paper's loss, in which the
            background outweighs small objects.
        imagined: share of the windows in which the world model sees no frames from a random step on, and predicts from
            its own predictions. 0 is the paper's loss; more makes predictions over many steps accurate.
        beta_rgb: weight of ``loss_rgb``; with 0, no frames are decoded and this loss is missing.
        rgb_frames: number of random frames of the batch that are decoded; None decodes all.
        generator: generator that draws these frames and steps; by default torch's own.
        distributed: the processes of ``torch.distributed`` share a batch, and all of them compute the loss of their
            part in step. The mean of their losses is then that of the whole batch, also where parts have different
            numbers of known steps.

    Raises:
        TypeError: ``world_model`` is none.
        ValueError: the input is not windows ``[B, T]``, T >= 2, of one episode each.
    """

    @dataclass
    class _AcceptedKeys:
        pixels: NestedKey = "pixels"
        action: NestedKey = "action"
        dynamics: NestedKey = "dynamics"
        labelled: NestedKey = "labelled"

    tensor_keys: _AcceptedKeys
    default_keys = _AcceptedKeys

    def __init__(
        self,
        world_model: WorldModel,
        beta_z: float = 0.1,
        beta_dynamics: float = 1.0,
        stop_gradient: bool = True,
        rarity: float = 0.0,
        imagined: float = 0.0,
        beta_rgb: float = 1.0,
        rgb_frames: int | None = None,
        generator: torch.Generator | None = None,
        distributed: bool = False,
    ):
        super().__init__()
        if not isinstance(world_model, WorldModel):
            raise TypeError(f"world_model must be a WorldModel, got {type(world_model).__name__}")
        self.world_model, self.generator = world_model, generator
        self.beta_z, self.beta_dynamics = beta_z, beta_dynamics
        self.stop_gradient, self.rarity = stop_gradient, rarity
        self.imagined, self.beta_rgb, self.rgb_frames = imagined, beta_rgb, rgb_frames
        self.distributed = distributed

    @property
    def in_keys(self) -> list[NestedKey]:
        """Keys that the loss reads; of the dynamics, those that the world model decodes."""
        keys = self.tensor_keys
        dynamics = [(keys.dynamics, quantity) for quantity in self.world_model.supervision]
        return [unravel_key(key) for key in (keys.pixels, keys.action, *dynamics)]

    @property
    def out_keys(self) -> list[str]:
        """Keys that the loss writes; their sum is to be minimised."""
        first = ("rgb", "latent") if self.beta_rgb else ("latent",)
        return [f"loss_{name}" for name in (*first, *self.world_model.supervision)]

    @dispatch(auto_batch_size=False)
    def forward(self, tensordict: TensorDictBase) -> TensorDict:
        """Return the losses."""
        check_windows(tensordict, 2, self._loss_mask_keys())
        latent, states = self.predict(tensordict)
        read = latent
        # Of the windows of all processes, of which each has every N-th.
        first, count = (rank(), ranks()) if self.distributed else (0, 1)
        if blind := len(range(first, round(self.imagined * len(latent) * count), count)):
            read, states = self._imagine(tensordict, latent, states, blind)
        return TensorDict(self.compare(tensordict, latent, states, read), [])

    def predict(self, tensordict: TensorDictBase) -> tuple[torch.Tensor, tuple[torch.Tensor, ...]]:
        """Return the latents ``[B, T, Z]``, and ``predicted_latent``, ``hidden1``, ``hidden2`` at every t."""
        latent = self.world_model.encode(tensordict[self.tensor_keys.pixels]).float()
        with torch.autocast(latent.device.type, enabled=False):
            return latent, self.world_model.predict(latent, tensordict[self.tensor_keys.action])

    def _imagine(self, tensordict, latent, states, blind: int):
        """Predict the first ``blind`` windows from their own predictions; return the latents read, and the states."""
        steps, device = latent.shape[1], latent.device
        context = torch.randint(1, steps, (1,), generator=self.generator, device=device).item()
        action = tensordict[self.tensor_keys.action][:blind]
        with torch.autocast(device.type, enabled=False):
            imagined = self.world_model.transition.imagine(latent[:blind], action, context)
        read = torch.cat([latent[:blind, :context], imagined[0][:, context:]], 1)
        states = tuple(torch.cat([a, b[blind:]]) for a, b in zip(imagined, states, strict=True))
        return torch.cat([read, latent[blind:]]), states

    def compare(
        self, tensordict: TensorDictBase, latent: torch.Tensor, states, read: torch.Tensor | None = None
    ) -> dict[str, torch.Tensor]:
        """Return the losses by name.

        Args:
            tensordict: the input.
            latent: first result of :meth:`predict`.
            states: second result of :meth:`predict`.
            read: latents ``[B, T, Z]`` from which the states were predicted; by default ``latent``.
        """
        model, keys = self.world_model, self.tensor_keys
        predicted, hidden1, hidden2 = (x[:, 1:] for x in states)  # (B, T-1, .)
        pixels = tensordict[keys.pixels][:, 1:]
        masks = tensordict.select(*self._loss_mask_keys(), strict=False)[:, 1:]
        known = tensordict.get(keys.labelled, None)
        known = known if known is None else known[:, 1:].reshape(*pixels.shape[:2], -1)
        losses = {}
        if self.beta_rgb:
            rgb = self._rgb_loss(masks, pixels, predicted, hidden1, hidden2)
            losses["loss_rgb"] = self.beta_rgb * rgb
        losses["loss_latent"] = self.beta_z * self._mean(self._latent_error(latent, predicted, read), masks)
        for name, value in model.decode_dynamics(predicted, hidden1, hidden2).items():
            scale = model.dynamics_decoder.normalizers[name].scale
            truth = tensordict[unravel_key((keys.dynamics, name))]
            if truth.shape[-1] != value.shape[-1]:
                raise ValueError(f"{name} must be [B, T, {value.shape[-1]}], got {list(truth.shape)}")
            truth = truth[:, 1:]
            for mask in (known, *masks.values(True, True)):
                if mask is not None:  # unknown entries may be NaN, whose gradient no mask stops
                    truth = torch.where(mask.reshape(*truth.shape[:2], -1), truth, value.detach())
            losses[f"loss_{name}"] = self.beta_dynamics * self._mean(
                rms((value - truth) / scale), masks, known if known is None else known.any(-1)
            )
        return losses

    def _mean(
        self, error: torch.Tensor, masks: TensorDictBase, known: torch.Tensor | None = None
    ) -> torch.Tensor:
        """Return the mean of an error ``[B, T]`` over the valid steps that are known; 0 where there is none."""
        mean = self._reduce_loss(error, masks, mask=known, reduction="mean")
        if known is None or not self.sums_over_ranks():
            return mean
        # Processes have different numbers of known steps; the mean of their losses is that of the whole batch.
        count = self._reduce_loss(torch.ones_like(error), masks, mask=known, reduction="sum")
        return mean * count / mean_over_ranks(count).clamp_min(1 / ranks())

    def sums_over_ranks(self) -> bool:
        """Return whether the loss is of a part of the batch that processes share."""
        return self.distributed and ranks() > 1 and torch.is_grad_enabled()

    def _latent_error(self, latent, predicted, read) -> torch.Tensor:
        before, target = (latent if read is None else read)[:, :-1], latent[:, 1:]
        if self.stop_gradient:
            predicted = predicted - before + before.detach()  # only the predicted change is moved
            target = target.detach()
        return rms(predicted - target)

    def _rgb_loss(self, masks, pixels, *states) -> torch.Tensor:
        frames = pixels.shape[0] * pixels.shape[1]
        if self.rgb_frames is not None and self.rgb_frames < frames:
            index = torch.randperm(frames, generator=self.generator, device=pixels.device)[: self.rgb_frames]
            masks, pixels, *states = (x.flatten(0, 1)[index][None] for x in (masks, pixels, *states))
        frames = self.world_model.decode_pixels(*states).float()
        error = (frames - pixels / 255).square().mean(-3)  # (B, T, 64, 64)
        if self.rarity:
            error = error * color_weights(pixels, self.rarity)
        return self._mean((error.mean((-2, -1)) + 1e-8).sqrt(), masks)


def rms(x: torch.Tensor) -> torch.Tensor:
    """Return the root mean square over the last axis, smooth at zero."""
    return (x.square().mean(-1) + 1e-8).sqrt()
