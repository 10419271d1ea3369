"""Kernels that read and write at any place, and weights of rare colours."""

import torch

from dynmap_rl.modules.layers import color_weights, hat_kernels


def test_weights_of_colours_have_mean_one_and_fall_with_frequency():
    pixels = torch.zeros(2, 3, 8, 8, dtype=torch.uint8)
    pixels[:, 0, 0, :4] = 200
    weight = color_weights(pixels, 0.5)
    torch.testing.assert_close(weight.mean((1, 2)), torch.ones(2))
    torch.testing.assert_close(weight[0, 0, 0] / weight[0, 5, 5], torch.tensor((60 / 4) ** 0.5))
    equal = color_weights(pixels, 1.0)
    torch.testing.assert_close(equal[0, 0, :4].sum(), equal[0].sum() / 2, msg="the same share of each colour")
    torch.testing.assert_close(color_weights(pixels, 0.0), torch.ones(2, 8, 8))


def test_kernels_read_a_line_between_its_pixels():
    """A ramp is read exactly, as interpolation is linear; the centre of the frame is between pixels 31 and 32."""
    ramp = torch.arange(64.0)
    centers = torch.tensor([0.0, 0.1])  # -1..1 is 64 pixels wide
    for spacing in (1.0, 2.0):
        samples = hat_kernels(centers, 5, spacing) @ ramp
        expected = 31.5 + 32 * centers[:, None] + spacing * torch.arange(-2, 3)
        torch.testing.assert_close(samples, expected)


def test_kernels_outside_the_frame_are_zero_and_their_centre_has_a_gradient():
    centers = torch.tensor([1.5, 0.013], requires_grad=True)
    kernels = hat_kernels(centers, 3)
    assert kernels[0].sum() == 0
    (kernels[1] @ torch.arange(64.0)).sum().backward()
    torch.testing.assert_close(centers.grad, torch.tensor([0.0, 3 * 32.0]))


def test_a_written_sample_lands_where_it_is_read():
    kernels = hat_kernels(
        torch.tensor(-0.5), 4
    )  # on whole pixels: 16 pixels from the left, between two of them
    line = torch.tensor([1.0, 2.0, 3.0, 4.0]) @ kernels
    assert line[14:18].tolist() == [1.0, 2.0, 3.0, 4.0] and line.sum() == 10
