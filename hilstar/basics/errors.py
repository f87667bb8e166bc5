"""The two kinds of refusal, each with its exit code, how it quotes what it refuses, and what it
takes a wrong word for.
"""

from collections.abc import Iterable, Iterator
from contextlib import contextmanager

MAX_QUOTED_CHARACTERS = 120
MAX_LINE_CHARACTERS = 1000
CUT = "[...]"


class HilstarError(Exception):
    """One line for a person: what is wrong, where, and what to write instead; of bounded length,
    whatever it quotes.

    >>> try:
    ...     hilstar.load("nowhere.toml")
    ... except hilstar.HilstarError as error:
    ...     print(error)
    nowhere.toml: cannot be read (No such file or directory); give the path of a bench file
    """

    exit_code = 1

    def __init__(self, line: str) -> None:
        super().__init__(one_line(line))


class InputError(HilstarError):
    """The command, a call or a file was wrong.

    >>> hilstar.load(5)
    Traceback (most recent call last):
    hilstar.basics.errors.InputError: load 5: give the path of a bench file, ...
    """

    exit_code = 2


class MachineError(HilstarError):
    """The machine lacks something; the line says what to install.

    >>> issubclass(hilstar.MachineError, hilstar.HilstarError)
    True
    """

    exit_code = 3


class NoDisplayError(MachineError):
    """There is no display to open a window on; `without_display` adds what can be done then."""


@contextmanager
def without_display(advice: str) -> Iterator[None]:
    """Adds what can be done without a display to the line of a machine that has none."""
    try:
        yield
    except NoDisplayError as error:
        raise NoDisplayError(f"{error}, or {advice}") from error


class NotThereError(MachineError):
    """A device that the command or a file names is not there; the line says what to plug in or
    which others are.
    """


class GpuError(MachineError):
    """The GPU or its driver no longer answers, or has lost what it held."""


def cannot_read(path: object, reason: object, advice: str) -> InputError:
    """The refusal of an input: `reason` is words or the error that came, `advice` what to give
    instead.
    """
    return InputError(f"{path}: cannot be read ({_in_words(reason)}); {advice}")


def cannot_write(path: object, reason: object, advice: str = "choose another place") -> InputError:
    """The refusal of an output: `reason` is words or the error that came."""
    return InputError(f"{path}: cannot be written ({_in_words(reason)}); {advice}")


def _in_words(reason: object) -> str:
    return str(getattr(reason, "strerror", None) or reason)


def shortened(text: object, limit: int = MAX_QUOTED_CHARACTERS) -> str:
    """A quoted piece of input in at most `limit` characters: its beginning and its end, where a
    file's name is.
    """
    try:
        whole = str(text)
    except ValueError:  # Python writes no integer of more than 4300 digits
        return "a number of thousands of digits"
    if len(whole) <= limit:
        return whole
    room = limit - len(CUT)
    return whole[: room - room // 3] + CUT + whole[len(whole) - room // 3 :]


def printable(text: str) -> str:
    r"""The text with control characters, and bytes that are not UTF-8, as escapes such as \x1b
    or \xff.
    """
    return "".join(c if c.isprintable() or c == " " else _escape(c) for c in text)


def _escape(character: str) -> str:
    code = ord(character)
    if 0xDC80 <= code <= 0xDCFF:  # a byte of a name that is not UTF-8
        code -= 0xDC00
    if code < 0x100:
        return f"\\x{code:02x}"
    return f"\\u{code:04x}"


def one_line(text: str) -> str:
    """A message as one line of bounded length, whatever it quotes of the input."""
    short_words = (shortened(printable(word)) for word in text.split())
    return shortened(" ".join(short_words), MAX_LINE_CHARACTERS)


def did_you_mean(word: object, known: Iterable[str]) -> str:
    """ "did you mean frame? " where `word` is nearly one of the words that are known; else
    nothing.
    """
    import difflib  # 5 ms, which a command without a mistake does not need

    by_small_letters = {name.casefold(): name for name in known}
    near = difflib.get_close_matches(shortened(word).casefold(), by_small_letters, n=1)
    if near:
        return f"did you mean {by_small_letters[near[0]]}? "
    return ""


def size_text(size_bytes: int) -> str:
    """A size for a person: "1.5 GB"."""
    for unit, factor in (("GB", 1e9), ("MB", 1e6), ("kB", 1e3)):
        if size_bytes >= factor:
            return f"{size_bytes / factor:.4g} {unit}"
    return f"{size_bytes} bytes"
