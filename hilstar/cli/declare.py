"""How a command's options are declared: once, each as a field of a struct.

The field has the option's type, its value's name, help, default, limits, panel and completion.
`--help`, docs/commands.md and Tab come from the fields. A command is a function of structs, and
`for_typer` flattens them into the parameters that typer reads.

- An option is `--name` by its field, and what its declaration adds.
- A field whose type admits None is None by default; any other without a default is required.
- Several commands share a struct, or a function that declares one field (`json_option`).
"""

from collections.abc import Callable
from dataclasses import Field, dataclass, field, fields
from functools import wraps
from inspect import Parameter, Signature
from typing import Any, TypeVar, dataclass_transform, get_args, get_type_hints

from typer import Argument, Option

Kind = TypeVar("Kind")
DECLARATION = "declaration"  # key of a field's metadata


@dataclass(frozen=True, slots=True)
class Declaration:
    """What typer is told of a field: its Option or Argument, its flags, and its settings."""

    maker: Callable[..., Any]
    flags: tuple[str, ...]
    settings: dict[str, Any]


def option(value: str, meaning: str, *flags: str, default: Any = None, **settings: Any) -> Any:
    """Declare an option that has a value, shown as `value` in its help.

    `flags` come in place of the field's name; `settings` are typer's.
    """
    settings |= {"metavar": value or None, "help": meaning}
    return field(default=default, metadata={DECLARATION: Declaration(Option, flags, settings)})


def switch(meaning: str, *flags: str, **settings: Any) -> Any:
    """Declare an option without a value: False unless it is given."""
    settings["help"] = meaning
    return field(default=False, metadata={DECLARATION: Declaration(Option, flags, settings)})


def argument(value: str, meaning: str, *, default: Any = None, **settings: Any) -> Any:
    """Declare an argument, shown as `value` in the usage line."""
    settings |= {"metavar": value or None, "help": meaning}
    return field(default=default, metadata={DECLARATION: Declaration(Argument, (), settings)})


@dataclass_transform(
    kw_only_default=True, frozen_default=True, field_specifiers=(option, switch, argument)
)
def struct(kind: type[Kind]) -> type[Kind]:
    """Make a class of declared fields a dataclass."""
    # No command compares or prints options, and each start would make the methods: 0.25 ms a class.
    return dataclass(kw_only=True, eq=False, repr=False)(kind)


def for_typer(command: Callable[..., None]) -> Callable[..., None]:
    """A function of the fields of all structs that a command takes, with its name and docstring.

    Raises ValueError where two of the structs have a field of one name.
    """
    structs = get_type_hints(command)
    structs.pop("return", None)

    @wraps(command)
    def flat(**values: Any) -> None:
        filled = {}
        for name, kind in structs.items():
            of_kind = {declared.name: values[declared.name] for declared in fields(kind)}
            filled[name] = kind(**of_kind)
        command(**filled)

    parameters = []
    for kind in structs.values():
        parameters += [_parameter(declared) for declared in fields(kind)]
    # all commands have --json, and each help has it at its end
    parameters.sort(key=lambda parameter: parameter.name == "as_json")
    flat.__signature__ = Signature(parameters)  # type: ignore[attr-defined]
    # typer reads these beside the signature
    flat.__annotations__ = {parameter.name: parameter.annotation for parameter in parameters}
    return flat


def _parameter(declared: "Field[Any]") -> Parameter:
    """A field as a parameter of typer's."""
    declaration: Declaration = declared.metadata[DECLARATION]
    flags = declaration.flags
    if declaration.maker is Option and not flags:
        # typer's own name of a switch has a second one: --headless/--no-headless
        flags = (f"--{declared.name.replace('_', '-')}",)
    default = declared.default
    if default is None and type(None) not in get_args(declared.type):
        default = ...  # typer's sign of a required one
    info = declaration.maker(default, *flags, **declaration.settings)
    return Parameter(declared.name, Parameter.KEYWORD_ONLY, default=info, annotation=declared.type)
