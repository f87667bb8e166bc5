"""Values that Tab offers for an option, where they are a closed set.

What brings a set is imported only once Tab asks for it. A set that only one command offers stands
beside that command.
"""

from collections.abc import Callable, Iterable

Offer = Callable[[str], list[str]]


def offered(words: Iterable[str] | Callable[[], Iterable[str]]) -> Offer:
    """The completion of an option whose values are `words`, or what that returns."""

    def complete(incomplete: str) -> list[str]:
        known = words() if callable(words) else words
        return [word for word in known if word.startswith(incomplete)]

    return complete


def centroiders() -> Iterable[str]:
    """The centroiders that a budget takes."""
    from hilstar.tracker.centroiders import FAMILY

    return (*FAMILY, "all")


def sensor_names() -> Iterable[str]:
    """The sensors with a public sheet."""
    from hilstar.tracker.sensors import sensors

    return sensors()


def stars() -> Iterable[str]:
    """The proper names of stars that are one word, as a shell takes a space for the end of one."""
    from hilstar.sky.catalog import star_names

    return (star.name for star in star_names().values() if star.name and " " not in star.name)
