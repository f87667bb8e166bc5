"""The door to the commands: what they import takes a third of a second, and Ctrl-C may come in
it.
"""

import gc
import sys
from typing import NoReturn

READER_WAITS_S = 0.1  # for a reader of stderr that sleeps
WRONG_FILE = 2
# for garbage: nearly all that a start makes stays, and looking through it took 20 ms
OBJECTS_BETWEEN_LOOKS = 20_000


def main() -> NoReturn:
    """Import the commands and run them; one line where a module that they need is damaged."""
    try:
        import_and_run()
    except Exception as error:
        path = damaged_module(error)
        if path is None:
            raise
        print(
            f"hilstar: {path}: this compiled module is damaged ({error}), as by a full disk; delete"
            " the file",
            file=sys.stderr,
        )
        sys.exit(WRONG_FILE)


def import_and_run() -> NoReturn:
    """Import the commands and run them; Ctrl-C may come at any step."""
    from hilstar.basics.process import interrupts
    from hilstar.basics.process.interrupts import finish_stderr

    try:
        gc.set_threshold(OBJECTS_BETWEEN_LOOKS)
        interrupts.install()
        from hilstar.cli import main as run

        run()
    except KeyboardInterrupt:
        print("hilstar: stopped", file=sys.stderr)
        finish_stderr(READER_WAITS_S)
        interrupts.leave(interrupts.exit_code())


def damaged_module(error: BaseException) -> str | None:
    """The path of the compiled module (.pyc) that Python could not read; None where the error is
    any other.

    Python writes such a file on its own, cut short where the disk is full, and then fails at each
    start:
    marshal raises EOFError, ValueError or TypeError.
    """
    trace = error.__traceback__
    while trace is not None:
        frame = trace.tb_frame
        if frame.f_code.co_name == "_compile_bytecode" and "bytecode_path" in frame.f_locals:
            return str(frame.f_locals["bytecode_path"])
        trace = trace.tb_next
    return None


if __name__ == "__main__":
    main()
