"""The two ways in which hilstar refuses, each with its exit code."""


class HilstarError(Exception):
    """One line for a person: what is wrong, where, and what to write instead."""

    exit_code = 1


class InputError(HilstarError):
    """The command or a file was wrong."""

    exit_code = 2


class MachineError(HilstarError):
    """The machine lacks something; the line says what to install."""

    exit_code = 3
