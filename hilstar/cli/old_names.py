"""Options by their former names: a command line that has them is read as if it had the present
ones.

Each option has one meaning in all commands: `--frames` is how many, `--rate` how many a second,
`--at` seconds after `sky.epoch_utc`, `--to` where packets go, `--duration` how long a command runs.
The former names are in no help, and work as before.
"""

from collections.abc import Callable

FRAMES, FEED, AVERAGE = "--frames", "--feed", "--average"


def _frames_or_feed(value: str) -> str:
    """`--frames` took an endpoint, and takes a number."""
    return FEED if "://" in value else FRAMES


def _average_or_feed(value: str) -> str:
    """`--frames` took an endpoint, or the number that is `--average` now."""
    return FEED if "://" in value else AVERAGE


# By command: the former name, and the present one, which may hang on the value.
OLD_NAMES: dict[str, dict[str, str | Callable[[str], str]]] = {
    "serve": {FRAMES: _frames_or_feed},
    "replay": {FRAMES: FEED},
    "campaign": {FRAMES: FEED},
    "first-light": {FRAMES: _average_or_feed},
    "simulate": {"--rate": "--slew"},
    "attitude": {"--at": "--time"},
    "confront": {"--at": "--taken"},
    "catalogue": {"--to": "--faintest"},
    "answers": {"--seconds": "--duration"},
    "calibrate dots": {"--seconds": "--dwell"},
    "calibrate plan": {"--seconds": "--dwell"},
}


def with_present_names(words: list[str]) -> list[str]:
    """The command line with the present names of its options; what follows `--` stays."""
    of_command = OLD_NAMES.get(" ".join(words[:1]), {})
    old_names = OLD_NAMES.get(" ".join(words[:2]), of_command)
    end = len(words)
    if "--" in words:
        end = words.index("--")
    present: list[str] = []
    for k, word in enumerate(words[:end]):
        name, equals, joined = word.partition("=")
        new = old_names.get(name)
        if new is None:
            present.append(word)
            continue
        if callable(new):
            new = new(joined if equals else "".join(words[k + 1 : k + 2]))
        present.append(f"{new}{equals}{joined}")
    return present + words[end:]
