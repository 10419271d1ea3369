"""Batches in parts: the same gradients as the whole batch, in threads."""

import threading

import pytest
import torch
from torch import nn

from dynmap_rl.training.parallel import differentiate, map_in_threads, split_batch

CPU = torch.device("cpu")


@pytest.fixture(autouse=True)
def two_threads():
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    yield
    torch.set_num_threads(before)


def test_a_batch_is_in_halves_on_a_cpu_and_whole_on_a_gpu():
    assert split_batch(16, CPU) == [8, 8]
    assert split_batch(3, CPU) == [2, 1]
    assert split_batch(1, CPU) == [1]
    assert split_batch(16, torch.device("cuda")) == [16]


def test_losses_and_gradients_are_those_of_the_whole_batch():
    torch.manual_seed(0)
    layer, unused = nn.Conv2d(3, 5, 3).to(memory_format=torch.channels_last), nn.Parameter(torch.ones(2))
    x = torch.randn(7, 3, 8, 8)
    sizes = split_batch(len(x), CPU)
    parts = x.split(sizes)

    def losses(part):
        y = layer(parts[part])
        share = sizes[part] / len(x)
        return {"square": y.square().mean() * share, "size": y.abs().mean() * share}

    whole = layer(x)
    (whole.square().mean() + whole.abs().mean()).backward()
    expected = [p.grad.clone() for p in layer.parameters()]
    with map_in_threads(2) as map_parts:
        found = differentiate(losses, range(2), [*layer.parameters(), unused], map_parts)
    torch.testing.assert_close(found, {"square": whole.square().mean(), "size": whole.abs().mean()})
    torch.testing.assert_close([p.grad for p in layer.parameters()], expected)
    assert layer.weight.grad.stride() == layer.weight.stride(), "fused optimisers take that for granted"
    assert unused.grad is None
    assert not found["square"].requires_grad


def test_every_part_has_a_thread_and_a_share_of_torchs_threads():
    def describe(_):
        meet.wait(timeout=60)
        return threading.current_thread().name, torch.get_num_threads()

    meet = threading.Barrier(2)
    with map_in_threads(2) as map_parts:
        found = list(map_parts(describe, range(2)))
    assert {name for name, _ in found} == {"part_0", "part_1"}
    assert {threads for _, threads in found} == {1}
    assert torch.get_num_threads() == 2


def test_with_one_thread_there_are_no_others():
    torch.set_num_threads(1)
    with map_in_threads(2) as map_parts:
        assert (
            list(map_parts(lambda _: threading.current_thread(), range(2)))
            == [threading.current_thread()] * 2
        )


def test_an_error_in_a_part_is_raised():
    def fail(part):
        raise ValueError(f"part {part}")

    with pytest.raises(ValueError, match="part 0"), map_in_threads(2) as map_parts:
        differentiate(fail, range(2), [], map_parts)
    assert torch.get_num_threads() == 2
