"""Which GPU draws headless: EGL's list, the key that chooses from it, and what a wrong one is
told.
"""

from __future__ import annotations

import json
import os

import pytest

from hilstar.basics.errors import MachineError
from hilstar.display.render.context import create_context, gpus
from hilstar.server.bench.build import load
from tests.support.benches import SMALL_BENCH
from tests.support.commands import assert_refused, run_hilstar, run_hilstar_here


def bench_with(folder, gpu: str) -> str:
    path = folder / "bench.toml"
    path.write_text(f"{SMALL_BENCH}\n[render]\ngpu = {gpu}\n")
    return str(path)


def test_every_device_of_egl_is_listed_and_can_be_chosen_by_index_and_by_name(tmp_path):
    found = gpus()
    assert found and found[0].renderer
    for gpu in found:
        by_name = next(one for one in found if gpu.renderer.lower() in one.renderer.lower())
        for key, chosen in ((str(gpu.index), gpu), (json.dumps(gpu.renderer.upper()), by_name)):
            with load(bench_with(tmp_path, key)) as bench:
                assert bench.renderer.gl_renderer == chosen.renderer


def test_the_index_after_the_last_is_no_gpu():
    with pytest.raises(MachineError, match="no such GPU"):
        create_context(len(gpus()))


def test_without_a_key_egl_s_first_draws():
    context = create_context()
    assert context.info["GL_RENDERER"] == gpus()[0].renderer
    context.release()


@pytest.mark.parametrize("wrong", ["99", '"voodoo"'])
def test_a_gpu_that_is_not_there_is_refused_in_one_line_that_lists_those_that_are(tmp_path, wrong):
    result = run_hilstar_here(
        "frame", bench_with(tmp_path, wrong), "--radec", "84,-1,0", "-o", tmp_path / "out.fits"
    )
    assert_refused(result, 3, "[render] gpu", gpus()[0].line())
    with pytest.raises(MachineError, match="no such GPU"):
        create_context(json.loads(wrong))


@pytest.mark.usefixtures("on_llvmpipe")
def test_another_driver_s_devices_are_named_as_that_driver_names_them():
    environment = os.environ | {"GALLIUM_DRIVER": "softpipe", "LIBGL_ALWAYS_SOFTWARE": "1"}
    ran = run_hilstar("doctor", "--json", env=environment)
    checks = {check["name"]: check["detail"] for check in json.loads(ran.stdout)["checks"]}
    assert "headless 0: softpipe" in checks["gpu"]
