"""Drawing of worlds with pygame: 1 m x 1 m on ``size`` x ``size`` pixels."""

from __future__ import annotations

import math
import os
import warnings
from typing import Protocol

import numpy as np

from .geometry import Polygon
from .scene import Color, Scene
from .world import World

os.environ.setdefault("PYGAME_HIDE_SUPPORT_PROMPT", "1")

with warnings.catch_warnings():
    warnings.simplefilter("ignore")  # pygame imports the deprecated pkg_resources
    import pygame


RGB = 0xFF, 0xFF00, 0xFF0000, 0  # masks of a surface whose bytes are those of a frame


class Marked(Protocol):
    """Part of a task that is drawn."""

    def markers(self, scene: Scene) -> list[tuple[Polygon, Color]]:
        """Return the polygons (m) behind cart and block, with their colours."""


class Renderer:
    """Renderer on a bare surface: it opens no window and needs no display.

    Args:
        size: side of the frame in pixels.
        supersample: factor by which the picture is drawn larger and then averaged; 1 gives hard edges.

    Raises:
        ValueError: the size or the factor is not positive.
    """

    def __init__(self, size: int = 64, supersample: int = 1):
        if min(size, supersample) < 1:
            raise ValueError(f"size and supersample must be at least 1, got {size} and {supersample}")
        self.size = size
        self.scale = size * supersample
        self.canvas = pygame.Surface((self.scale, self.scale), 0, 24, RGB)
        self.frame = pygame.Surface((size, size), 0, 24, RGB) if supersample > 1 else self.canvas

    def __reduce__(self) -> tuple:
        return Renderer, (self.size, self.scale // self.size)  # pygame's surfaces cannot be copied

    def draw(self, world: World, task: Marked) -> np.ndarray:
        """Draw the frame, uint8 ``[size, size, 3]`` (height, width, RGB)."""
        scene = world.scene
        self.canvas.fill(scene.background_color)
        for polygon, color in task.markers(scene):
            self._fill(polygon, color)
        cx, cy, ct, bx, by, bt = world.position.tolist()
        self._fill(box(cx, cy, ct, scene.cart_width, scene.cart_height), scene.cart_color)
        self._fill(box(bx, by, bt, scene.block_width, scene.block_height), scene.block_color)
        if self.frame is not self.canvas:
            pygame.transform.smoothscale(self.canvas, (self.size, self.size), self.frame)
        rows = np.frombuffer(self.frame.get_buffer(), dtype=np.uint8).reshape(self.size, -1)
        # pygame pads rows to a multiple of 4 bytes.
        return rows[:, : 3 * self.size].reshape(self.size, self.size, 3).copy()

    def _fill(self, polygon: Polygon, color: tuple[int, int, int]) -> None:
        scale = self.scale  # pygame truncates to the pixel that a corner lies in
        pygame.draw.polygon(self.canvas, color, [(x * scale, (1.0 - y) * scale) for x, y in polygon])


class Window:
    """Window on the screen that shows frames in real time.

    Args:
        size: side in pixels.
        fps: largest number of frames per second; ``show`` waits accordingly.
    """

    def __init__(self, size: int, fps: float):
        self.size, self.clock, self.fps = size, pygame.time.Clock(), fps
        self._open()

    def _open(self) -> None:
        pygame.display.init()
        pygame.display.set_caption("dynmap_rl")
        self.screen = pygame.display.set_mode((self.size, self.size))

    def show(self, frame: np.ndarray) -> None:
        """Show a frame, uint8 ``[size, size, 3]``. A process has one window, which the last to show a frame takes over."""
        if pygame.display.get_surface() is not self.screen:
            self._open()
        self.screen.blit(pygame.image.frombuffer(frame, frame.shape[1::-1], "RGB"), (0, 0))
        pygame.event.pump()  # otherwise the system reports a window that does not respond
        pygame.display.flip()
        self.clock.tick(self.fps)

    def close(self) -> None:
        """Close the window, if no other one has taken it over."""
        if pygame.display.get_init() and pygame.display.get_surface() is self.screen:
            pygame.display.quit()


def box(x: float, y: float, angle: float, width: float, height: float) -> Polygon:
    """Return the corners of a rectangle (m) that is rotated about its centre by ``angle`` (rad)."""
    c, s = math.cos(angle) / 2, math.sin(angle) / 2
    wx, wy, hx, hy = c * width, s * width, -s * height, c * height
    return [
        (x - wx - hx, y - wy - hy),
        (x + wx - hx, y + wy - hy),
        (x + wx + hx, y + wy + hy),
        (x - wx + hx, y - wy + hy),
    ]
