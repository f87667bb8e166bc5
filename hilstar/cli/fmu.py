"""hilstar fmu: a co-simulation FMU (FMI 2.0) that drives a bench over UDP, by PythonFMU."""

import importlib
import json
import shutil
import sys
from pathlib import Path

from hilstar import server
from hilstar.attitude.wire import protocol
from hilstar.basics.errors import InputError, MachineError
from hilstar.basics.files import check_ending, temporary_folder, written
from hilstar.cli.declare import struct
from hilstar.cli.options import bench_argument, check_files, json_option, output_option
from hilstar.server.console.terminal import busy, print_found, say

FMU = (".fmu",)
# the modules in the FMU: the model, and the table of the wire that it imports
MODEL, PROTOCOL = "star_display", "hilstar_protocol"
EXTRA = "pythonfmu cannot be imported; install it: pip install 'hilstar[fmi]'"


@struct
class FmuOptions:
    """The options of `hilstar fmu`."""

    bench_file: Path = bench_argument()
    output: Path = output_option("FILE.fmu", "The FMU to write.")
    as_json: bool = json_option()


def fmu(options: FmuOptions) -> None:
    """Make an FMU of a bench: a simulation tool's block with attitude in; frame, health and
    answered attitude out.
    """
    from hilstar.server.bench.bench_file import read_bench_file

    check_ending("-o", options.output, FMU)
    file = read_bench_file(options.bench_file)
    check_files([], [options.output], file)
    address = _address(file.path, file.config.attitude)
    with busy("building the FMU"), temporary_folder("fmu") as folder:
        written(options.output, lambda out: out.write(build(folder, address).read_bytes()))
    say(f"{options.output}: sends to {address}; start hilstar serve {options.bench_file} there")
    summary = {"address": address, "written": [str(options.output)]}
    print_found(options.as_json, summary, [str(options.output)])


def _address(path: Path, settings: object) -> str:
    """Where the FMU sends to by `[attitude]`: this machine where the bench listens everywhere.
    Raises InputError.
    """
    from hilstar.server.bench.config.attitude import AttitudeSettings, udp_road

    assert isinstance(settings, AttitudeSettings)
    if settings.source != "udp":
        raise InputError(
            f'{path}: [attitude] source = "{settings.source}"; an FMU sends over UDP: write source'
            ' = "udp"'
        )
    place, _ = udp_road(settings)
    if not place.port:
        raise InputError(
            f"{path}: [attitude] port 0 is another one at each start; write the port to which the"
            " FMU sends"
        )
    if not settings.status_hz:
        raise InputError(
            f"{path}: [attitude] status_hz = 0, by which an FMU hears nothing; write 10 or more"
        )
    host = str(place.host)
    if place.host.is_unspecified:
        host = "::1" if place.host.version == 6 else "127.0.0.1"
    if ":" in host:
        host = f"[{host}]"
    return f"{host}:{place.port}"


def build(folder: Path, address: str) -> Path:
    """Make the FMU in an empty folder. Raises MachineError without PythonFMU."""
    try:
        from pythonfmu.builder import FmuBuilder
    except ImportError as error:
        raise MachineError(EXTRA) from error
    script = folder / f"{MODEL}.py"
    shutil.copyfile(Path(server.__file__).with_name("fmu_model.py"), script)
    table = folder / f"{PROTOCOL}.py"
    shutil.copyfile(Path(protocol.__file__), table)
    bench = folder / "bench.json"
    bench.write_text(json.dumps({"address": address}))
    path = list(sys.path)
    try:  # PythonFMU imports the script by its name
        sys.path.insert(0, str(folder))
        _forget_modules()
        importlib.invalidate_caches()
        made = folder / f"{MODEL}.fmu"
        return Path(FmuBuilder.build_FMU(script, made, project_files=[bench, table]))
    finally:
        sys.path[:] = path
        _forget_modules()


def _forget_modules() -> None:
    """Have the next import of the FMU's modules read their files: another FMU has others."""
    for name in (MODEL, PROTOCOL):
        sys.modules.pop(name, None)
