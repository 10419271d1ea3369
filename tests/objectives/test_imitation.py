"""Imitation loss: scale, emphasis, and steps that are left out."""

import pytest
import torch
from small import CONSTANTS, make_model
from tensordict import TensorDict

from dynmap_rl.modules.checkpoints import make_policy
from dynmap_rl.modules.normalization import Normalizer
from dynmap_rl.objectives.imitation import ImitationLoss, find_target, imitation_loss


def test_the_loss_is_the_mean_absolute_error_in_normalised_units():
    normalizer = Normalizer([-2.0, -4.0], [2.0, 4.0])
    predicted, action = torch.tensor([[1.0, 0.0]]), torch.tensor([[0.0, 2.0]])
    assert imitation_loss(predicted, action, normalizer).item() == pytest.approx(0.5)


def test_emphasis_weighs_the_steps_in_which_the_action_changes():
    normalizer = Normalizer([-2.0], [2.0])  # the change counts in normalised units, as the error does
    action = torch.tensor([[[0.0], [1.0], [1.0]]])
    wrong_at = [torch.zeros(1, 3, 1).index_fill(1, torch.tensor([t]), 2.0) for t in range(3)]
    losses = [imitation_loss(action + error, action, normalizer, emphasis=4.0).item() for error in wrong_at]
    assert losses == pytest.approx([0.2, 0.6, 0.2])  # weights 1, 1 + 4 / 2, 1
    from_the_start = [
        imitation_loss(action + e + 1.0, action + 1.0, normalizer, emphasis=4.0) for e in wrong_at
    ]
    assert from_the_start[0] == from_the_start[1] > from_the_start[2]


def test_the_first_step_of_a_window_within_an_episode_has_no_emphasis():
    torch.manual_seed(0)
    model = make_model()
    policy = make_policy(CONSTANTS, "feedforward", model, width=8)
    states = {
        "latent": torch.randn(2, 3, 16),
        "hidden1": torch.randn(2, 3, 24),
        "hidden2": torch.randn(2, 3, 24),
    }
    td = TensorDict(states | {"goal": torch.rand(2, 3, 2), "action": torch.full((2, 3, 3), 0.01)}, [2, 3])
    loss = ImitationLoss(policy, emphasis=4.0)
    begins = loss(td)["loss_policy"]
    td["step_count"] = torch.tensor([[[0], [1], [2]]] * 2)
    assert torch.equal(loss(td)["loss_policy"], begins)
    td["step_count"] += 5
    assert torch.allclose(loss(td)["loss_policy"], ImitationLoss(policy)(td)["loss_policy"]), (
        "it never changes"
    )


def test_the_loss_is_divided_by_the_given_total():
    action, normalizer = torch.zeros(1, 4, 1), Normalizer([-1.0], [1.0])
    loss = imitation_loss(action + 1, action, normalizer, total=lambda weight: 2 * weight)
    assert loss.item() == pytest.approx(0.5)


def test_ignored_steps_do_not_count_with_emphasis():
    normalizer = Normalizer([-1.0], [1.0])
    action, error = torch.tensor([[[0.5], [0.5]]]), torch.tensor([[[1.0], [0.0]]])
    ignore = torch.tensor([[[True], [False]]])
    assert imitation_loss(action + error, action, normalizer, ignore, emphasis=4.0) == 0


def test_an_ignored_action_does_not_weigh_the_step_after_it():
    normalizer, ignore = Normalizer([-1.0], [1.0]), torch.tensor([[[False], [True], [False], [False]]])
    action, error = torch.tensor([[[0.0], [0.9], [0.0], [0.5]]]), torch.tensor([[[0.0], [0.0], [0.1], [0.0]]])
    loss = imitation_loss(action + error, action, normalizer, ignore, emphasis=4.0).item()
    assert loss == pytest.approx(0.1 / (1 + 1 + 3))  # weights 1, ignored, 1, 1 + 4 / 2


@pytest.mark.parametrize("emphasis", [0.0, 4.0])
@pytest.mark.parametrize("ignore", [[True, False], [True, True]])
def test_ignored_steps_may_be_nan(ignore, emphasis):
    """The loss and its gradients are finite, also where no step counts."""
    action = torch.tensor([[[torch.nan], [0.5]]])
    predicted = torch.zeros(1, 2, 1, requires_grad=True)
    mask = torch.tensor(ignore).view(1, 2, 1)
    loss = imitation_loss(predicted, action, Normalizer([-1.0], [1.0]), mask, emphasis)
    loss.backward()
    assert loss == (0.0 if all(ignore) else 0.5)
    assert predicted.grad.isfinite().all()


def test_what_the_demonstrator_wanted_is_imitated_in_every_step():
    td = TensorDict({"action": torch.zeros(1, 2, 3), "expert_action": torch.ones(1, 2, 3)}, [1, 2])
    td["disturbed"] = torch.ones(1, 2, 1, dtype=torch.bool)
    target, ignore = find_target(td)
    assert torch.equal(target, td["expert_action"]) and ignore is None


def test_disturbed_and_masked_steps_are_both_left_out():
    td = TensorDict({"action": torch.zeros(1, 3, 3)}, [1, 3])
    td["disturbed"] = torch.tensor([[[True], [False], [False]]])
    td["mask"] = torch.tensor([[True, True, False]])
    target, ignore = find_target(td, masks=("mask",))
    assert torch.equal(target, td["action"]) and ignore.flatten().tolist() == [True, False, True]


def test_the_module_is_the_function_of_the_policys_actions():
    policy = make_policy(CONSTANTS, "recurrent", make_model(), width=16)
    sizes = {"latent": 16, "hidden1": 24, "hidden2": 24, "goal": 2, "action": 3}
    td = TensorDict({key: torch.randn(2, 6, size) for key, size in sizes.items()}, [2, 6])
    td["disturbed"] = torch.rand(2, 6, 1) < 0.3
    predicted = policy(*(td[key] for key in ("latent", "hidden1", "hidden2", "goal")))
    expected = imitation_loss(predicted, td["action"], policy.action, td["disturbed"], 3.0)
    loss = ImitationLoss(policy, emphasis=3.0)(td)["loss_policy"]
    assert torch.equal(loss, expected)
    loss.backward()
    assert all(p.grad is not None for p in policy.parameters())
