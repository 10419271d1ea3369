"""The play window: the scene, the world model's prediction, and traces of true and predicted dynamics."""

from __future__ import annotations

import os
import re

import numpy as np

from dynmap_rl.envs.renderer import Renderer, box, pygame
from dynmap_rl.envs.task import Task
from dynmap_rl.envs.world import ACCELERATION_LIMIT, VELOCITY_LIMIT
from dynmap_rl.keys import DYNAMICS

from .session import Session

BLACK, GRAY, LIGHT, WHITE, GREEN = (0, 0, 0), (120, 120, 120), (225, 225, 225), (255, 255, 255), (44, 160, 44)
LINE, MARGIN, TRACE = 20, 8, 84  # pixels
UNITS = {"position": "m", "velocity": "m/s", "acceleration": "m/s2"}
LOW = {"position": [0, 0, -0.5], "velocity": -VELOCITY_LIMIT, "acceleration": -2 * ACCELERATION_LIMIT}
HIGH = {"position": [1, 1, 0.5], "velocity": VELOCITY_LIMIT, "acceleration": 2 * ACCELERATION_LIMIT}
LEAST = {"position": 0.1, "velocity": 0.4, "acceleration": 4.0}  # height of a trace in space
HELP = (
    "arrows or WASD: move",
    "TAB: who drives; I: imagination; B: next body",
    "PAGE UP, PAGE DOWN: delay of the policy's frames",
    "R: next scene; SPACE: pause; ESC: end",
)
KEYS = {  # axis and sign
    "left": (0, -1), "a": (0, -1), "right": (0, 1), "d": (0, 1), "down": (1, -1), "s": (1, -1), "up": (1, 1),
    "w": (1, 1), "e": (2, -1), "q": (2, 1),
}  # fmt: skip


class PlayWindow:
    """Window that shows a session and passes keys and mouse to it.

    Tasks of cart and block are drawn in full resolution; of other tasks, the frame of the first camera is shown.

    Args:
        session: session to show.
        size: side of the scene, in pixels.

    Raises:
        ValueError: there is no display.
    """

    def __init__(self, session: Session, size: int = 384):
        self.session, self.size = session, size
        self.dt, self.flat = session.env.layout.dt, isinstance(session.task, Task)
        self.bodies = list(dict.fromkeys(map(_name_body, session.env.layout.velocity)))
        self.body = self.bodies[-1] if self.flat else self.bodies[0]  # the object that is moved
        self.paused, self.open = False, True
        self.held: set[str] = set()
        pygame.font.init()
        self.width = 2 * size + 3 * MARGIN
        self.height = size + 3 * MARGIN + 3 * LINE + len(DYNAMICS) * TRACE
        try:
            pygame.display.init()
            self.screen = pygame.display.set_mode((self.width, self.height))
            if pygame.display.get_driver() == "offscreen" and "SDL_VIDEODRIVER" not in os.environ:
                raise pygame.error("SDL finds none")  # it would draw off screen
        except pygame.error as error:
            raise ValueError(
                f"there is no display to open a window on ({error}); set SDL_VIDEODRIVER=dummy to write a --gif "
                "without one"
            ) from error
        pygame.display.set_caption("dynmap_rl")
        self.font = pygame.font.Font(None, LINE)
        self.renderer = Renderer(size, supersample=2) if self.flat else None

    def close(self) -> None:
        """Close the window."""
        pygame.display.quit()

    def handle(self) -> None:
        """Process the keys and mouse events since the last call."""
        for event in pygame.event.get():
            if event.type == pygame.QUIT:
                self.open = False
            elif event.type == pygame.KEYDOWN:
                self._press(pygame.key.name(event.key))
            elif event.type == pygame.KEYUP:
                self.held.discard(pygame.key.name(event.key))
            elif event.type in (pygame.MOUSEBUTTONDOWN, pygame.MOUSEMOTION):
                self._point(event)
            elif event.type == pygame.MOUSEBUTTONUP:
                self.session.person.target = None
        direction = np.zeros(3)
        for axis, sign in (KEYS[key] for key in self.held):
            direction[axis] += sign
        self.session.person.direction = direction.clip(-1, 1)

    def _press(self, key: str) -> None:
        session = self.session
        if key in KEYS:
            self.held.add(key)
            session.driver = "person"
        elif key == "escape":
            self.open = False
        elif key == "space":
            self.paused = not self.paused
        elif key == "r":
            session.restart()
        elif key == "b":
            self.body = self.bodies[(self.bodies.index(self.body) + 1) % len(self.bodies)]
        elif key == "i" and session.actor:
            session.imagining = not session.imagining
        elif key in ("page up", "page down") and session.actor:
            session.set_delay(session.delay + (1 if key == "page up" else -1))
        elif key == "tab":
            drivers = session.drivers
            session.driver = drivers[(drivers.index(session.driver) + 1) % len(drivers)]

    def _point(self, event) -> None:
        pressed = event.button == 1 if event.type == pygame.MOUSEBUTTONDOWN else event.buttons[0]
        x, y = (event.pos[0] - MARGIN) / self.size, 1 - (event.pos[1] - MARGIN - LINE) / self.size
        if self.flat and pressed and 0 <= x <= 1 and 0 <= y <= 1:
            self.session.driver, self.session.person.target = "person", (x, y)

    def draw(self) -> np.ndarray:
        """Draw the present and return the picture, uint8 ``[height, width, 3]``."""
        session, size = self.session, self.size
        self.screen.fill(WHITE)
        self._write(f"{session.task.name}: {session.driver} drives", MARGIN, MARGIN)
        self._show(self._draw_scene(), MARGIN)
        if self.flat and "position" in session.prediction and (session.delay or session.imagining):
            self._show_belief(session.prediction["position"])
        right = 2 * MARGIN + size
        if "pixels" in session.prediction:
            age = round(1000 * self.dt * (session.delay + 1))
            source = "imagination, without frames" if session.imagining else f"prediction from {age} ms ago"
            self._write(f"world model: {source}", right, MARGIN)
            self._show(_first_camera(session.prediction["pixels"]), right)
        else:
            of_task = "Q, E: tilt; mouse button: call the cart" if self.flat else "Q, E: up and down"
            for i, line in enumerate((HELP[0], of_task, *HELP[1:])):
                self._write(line, right, MARGIN + LINE * (i + 2), GRAY)
        self._write(self._status(), MARGIN, 2 * MARGIN + LINE + size)
        for row, quantity in enumerate(DYNAMICS):
            names = session.env.layout.dynamics[quantity]
            owners = [
                max((b for b in self.bodies if f"{n}_".startswith(f"{b}_")), key=len, default="")
                for n in names
            ]
            entries = [i for i, owner in enumerate(owners) if owner == self.body]
            for column, entry in enumerate(entries[:3]):
                self._trace(quantity, entry, column, row)
        pygame.display.flip()
        return pygame.surfarray.array3d(self.screen).swapaxes(0, 1)

    def _draw_scene(self) -> np.ndarray:
        if self.renderer:
            return self.renderer.draw(self.session.world, self.session.task)
        return _first_camera(self.session.td["pixels"][0].permute(1, 2, 0).numpy())

    def _status(self) -> str:
        session, world = self.session, self.session.world
        way = world.goal_distance if self.flat else world.position_error
        state = (
            "success" if session.succeeded else "dropped" if world.dropped else f"{1000 * way:.0f} mm to go"
        )
        steps = f"step {world.steps} of {session.env.layout.steps}"
        return (
            f"{steps}; {state}; {self.body}'s dynamics: black true"
            + (", green predicted" if session.actor else "")
            + (f"; frames {round(1000 * self.dt * session.delay)} ms late" if session.delay else "")
            + ("; paused" if self.paused else "")
        )

    def _show(self, frame: np.ndarray, x: int) -> None:
        image = pygame.image.frombuffer(np.ascontiguousarray(frame), frame.shape[1::-1], "RGB")
        self.screen.blit(pygame.transform.scale(image, (self.size, self.size)), (x, MARGIN + LINE))

    def _show_belief(self, position: np.ndarray) -> None:
        """Draw cart and block translucent where the world model predicts them."""
        scene, layer = self.session.world.scene, pygame.Surface((self.size, self.size), pygame.SRCALPHA)
        sizes = (scene.cart_width, scene.cart_height), (scene.block_width, scene.block_height)
        colors = scene.cart_color, scene.block_color
        for pose, size, color in zip((position[:3], position[3:]), sizes, colors, strict=True):
            corners = [(x * self.size, (1 - y) * self.size) for x, y in box(*pose.tolist(), *size)]
            pygame.draw.polygon(layer, (*color, 100), corners)
            pygame.draw.polygon(layer, (*BLACK, 200), corners, 2)
        self.screen.blit(layer, (MARGIN, MARGIN + LINE))

    def _write(self, text: str, x: int, y: int, color=BLACK) -> None:
        self.screen.blit(self.font.render(text, True, color), (x, y))

    def _trace(self, quantity: str, entry: int, column: int, row: int) -> None:
        width = (self.width - 4 * MARGIN) // 3
        left = MARGIN + column * (width + MARGIN)
        top = 2 * MARGIN + 2 * LINE + self.size + row * TRACE
        area = pygame.Rect(left, top + LINE - 4, width, TRACE - LINE - 2)
        layout, trace = self.session.env.layout, self.session.trace
        component = layout.dynamics[quantity][entry].removeprefix(f"{self.body}_")
        unit = UNITS[quantity].replace("m", "rad", 1) if component == "theta" else UNITS[quantity]
        self._write(f"{quantity} {component} [{unit}]", left, top, GRAY)
        pygame.draw.rect(self.screen, LIGHT, area, 1)
        lines = {kind: np.array(trace[quantity, kind])[:, entry] for kind in ("true", "predicted")}
        low, high = LOW[quantity][column], HIGH[quantity][column]
        if not self.flat:
            low, high = _limits(lines["true"], LEAST[quantity])
        for kind, color in (("true", BLACK), ("predicted", GREEN)):
            values = lines[kind]
            steps = np.flatnonzero(np.isfinite(values))
            if len(steps) > 1:
                x = area.left + steps / layout.steps * area.width
                y = area.bottom - ((values[steps] - low) / (high - low)).clip(0, 1) * area.height
                pygame.draw.lines(self.screen, color, False, np.stack([x, y], 1).tolist())


def _first_camera(frame: np.ndarray) -> np.ndarray:
    """Return the frame of the first of several cameras side by side."""
    return frame[:, : frame.shape[0]]


def _limits(values: np.ndarray, least: float) -> tuple[float, float]:
    """Return the lower and the upper end of a trace that holds all values and has at least a height."""
    middle, half = (values.max() + values.min()) / 2, max(np.ptp(values), least) / 2
    return middle - half, middle + half


def _name_body(entry: str) -> str:
    """Return the body of an entry of the velocity, such as ``left_hand`` of ``left_hand_omega_x``."""
    return re.sub("(_omega)?_[^_]+$", "", entry)
