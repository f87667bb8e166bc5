"""Wishes of operators who are not at the display: asked for from any thread, acted on by the frame loop between two frames."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

from hilstar.run.aids import Aids


@dataclass(eq=False, slots=True)
class Wish:
    """A switch of `Aids` to be turned, by whom; `done` is set once the frame loop has, unless it was called off before."""

    name: str
    on: bool
    who: str
    share: float = 1.0
    called_off: bool = False
    done: bool = False

    @property
    def text(self) -> str:
        """What is wished, such as "blank on"."""
        return f"{self.name} {'on' if self.on else 'off'}"


class Desk:
    """Takes wishes without a lock; the frame loop looks at them once a frame and never waits."""

    def __init__(self) -> None:
        self.waiting: deque[Wish] = deque()

    def ask(self, wish: Wish) -> None:
        """Hand in a wish."""
        self.waiting.append(wish)

    def act(self, aids: Aids, acted: Callable[[Wish], None]) -> None:
        """Turn the switches that were wished for, each told by `acted`; for the frame loop."""
        while self.waiting:
            wish = self.waiting.popleft()
            if wish.called_off:
                continue
            aids.set(wish.name, wish.on, wish.share)
            acted(wish)
            wish.done = True
