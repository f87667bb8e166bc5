"""A base for what has to be closed: a `with` around it does so at its end."""

from typing import Self


class Closing:
    """Closed when its `with` ends."""

    def close(self) -> None:
        """Let go of what it holds."""
        raise NotImplementedError

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
