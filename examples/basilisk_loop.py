"""Basilisk's attitude controller before hilstar's display and tracker: a slew that closes the loop,
in real time.

python basilisk_loop.py [SLEW_DEG [SECONDS]]

Basilisk's dynamics turn a spacecraft, whose true attitude goes to `hilstar serve`. `hilstar
tracker` looks at the frames, and its answers (JSON over UDP) are all that Basilisk's controller
(mrpFeedback) knows. The last line is a JSON object: the pointing error at the end, arcsec across
the boresight and about it, and how many answers there were.

The bench is bench.toml beside this file. The camera's axes are the body's.
"""

from __future__ import annotations

import contextlib
import json
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from Basilisk.architecture import messaging
from Basilisk.fswAlgorithms import attTrackingError, inertial3D, mrpFeedback
from Basilisk.simulation import extForceTorque, spacecraft
from Basilisk.utilities import SimulationBaseClass, macros

from hilstar import Sender
from hilstar.rotation import conjugate, from_radec_roll_deg, multiply, propagate, to_rotation_vector

BENCH = Path(__file__).with_name("bench.toml")
STEP_S, CONTROL_S = 0.01, 0.1
INERTIA_KG_M2 = (10.0, 14.0, 18.0)
BANDWIDTH_RAD_S, DAMPING = 0.6, 0.9  # slow enough for answers that are 0.15 s old
SETTLED_SHARE = 0.25  # the last part of the run, over which the pointing error is measured
WAITS_S = 60.0  # for the tracker's first answer
ARCSEC_PER_RAD = 180 * 3600 / np.pi
Array = npt.NDArray[np.float64]
HILSTAR = [sys.executable, "-m", "hilstar"]


def free_port(kind: int) -> int:
    """A port that nobody has."""
    with socket.socket(socket.AF_INET, kind) as found:
        found.bind(("127.0.0.1", 0))
        return int(found.getsockname()[1])


def sigma_bn(q_icrs_to_cam: Array) -> list[float]:
    """Basilisk's MRPs of an attitude: its [BN] turns the frame, so they are those of the
    conjugate.
    """
    w, *vector = q_icrs_to_cam if q_icrs_to_cam[0] >= 0 else -q_icrs_to_cam
    return [-float(part / (1 + w)) for part in vector]


def attitude(sigma: list[float]) -> Array:
    """The inverse of `sigma_bn`."""
    s = np.array(sigma)
    return np.asarray(np.array([1 - s @ s, *(-2 * s)]) / (1 + s @ s))


class Plant:
    """Basilisk's spacecraft, guidance and controller; the navigation message is what the tracker
    says.
    """

    def __init__(self, q_start: Array, q_target: Array) -> None:
        self._sim = sim = SimulationBaseClass.SimBaseClass()
        process = sim.CreateNewProcess("process")
        process.addTask(sim.CreateNewTask("dynamics", macros.sec2nano(STEP_S)))
        process.addTask(sim.CreateNewTask("control", macros.sec2nano(CONTROL_S)))
        self._craft = craft = spacecraft.Spacecraft()
        craft.hub.mHub = 100.0
        craft.hub.IHubPntBc_B = np.diag(INERTIA_KG_M2).tolist()
        craft.hub.r_CN_NInit, craft.hub.v_CN_NInit = [7e6, 0.0, 0.0], [0.0, 0.0, 0.0]
        craft.hub.sigma_BNInit = [[part] for part in sigma_bn(q_start)]
        torque = extForceTorque.ExtForceTorque()
        craft.addDynamicEffector(torque)
        target, error, control = (
            inertial3D.inertial3D(),
            attTrackingError.attTrackingError(),
            mrpFeedback.mrpFeedback(),
        )
        target.sigma_R0N = sigma_bn(q_target)
        self._navigation = messaging.NavAttMsg().write(
            messaging.NavAttMsgPayload(sigma_BN=sigma_bn(q_start))
        )
        error.attNavInMsg.subscribeTo(self._navigation)
        error.attRefInMsg.subscribeTo(target.attRefOutMsg)
        middle = INERTIA_KG_M2[1]
        control.K, control.P, control.Ki = (
            4 * middle * BANDWIDTH_RAD_S**2,
            2 * DAMPING * middle * BANDWIDTH_RAD_S,
            -1.0,
        )
        control.guidInMsg.subscribeTo(error.attGuidOutMsg)
        inertia = messaging.VehicleConfigMsgPayload(
            ISCPntB_B=np.diag(INERTIA_KG_M2).ravel().tolist()
        )
        self._inertia = messaging.VehicleConfigMsg().write(inertia)
        control.vehConfigInMsg.subscribeTo(self._inertia)
        torque.cmdTorqueInMsg.subscribeTo(control.cmdTorqueOutMsg)
        self._modules = [target, error, control, torque]  # Basilisk keeps no reference of its own
        for model in (torque, craft):
            sim.AddModelToTask("dynamics", model)
        for model in (target, error, control):
            sim.AddModelToTask("control", model)
        sim.InitializeSimulation()

    def run_to(self, t_s: float) -> tuple[Array, Array]:
        """Go on until a time: the true attitude, and the rate, rad/s, in body axes."""
        self._sim.ConfigureStopTime(macros.sec2nano(t_s))
        self._sim.ExecuteSimulation()
        state = self._craft.scStateOutMsg.read()
        return attitude(state.sigma_BN), np.array(state.omega_BN_B)

    def navigate(self, q_icrs_to_cam: Array, rate_rad_s: Array) -> None:
        """Tell the controller where the tracker says it points."""
        said = messaging.NavAttMsgPayload(
            sigma_BN=sigma_bn(q_icrs_to_cam), omega_BN_B=rate_rad_s.tolist()
        )
        self._navigation.write(said)


def newest(answers: socket.socket) -> dict[str, Any] | None:
    """The newest valid answer that waits; None where there is none."""
    found = None
    with contextlib.suppress(BlockingIOError):
        while True:
            said = json.loads(answers.recv(65536))
            found = said if said["valid"] else found
    return found


@contextlib.contextmanager
def display_and_tracker(
    bench: Path, seconds: float, attitudes: int, answers: int
) -> Iterator[None]:
    """The two commands, until the loop is over; attitudes come and answers go by UDP ports."""
    text = f'{BENCH.read_text()}\n[attitude]\nsource = "udp"\nbind = "127.0.0.1:{attitudes}"\n'
    bench.write_text(text)
    frames = f"tcp://127.0.0.1:{free_port(socket.SOCK_STREAM)}"
    shown = [
        *HILSTAR,
        "serve",
        str(bench),
        "--headless",
        "--duration",
        str(seconds + 30),
        "--feed",
        frames,
    ]
    looks = [
        *HILSTAR,
        "tracker",
        str(bench),
        "--watch",
        frames,
        "--answer",
        f"udp://127.0.0.1:{answers}",
        "--format",
        "json",
    ]
    with contextlib.ExitStack() as running:
        for command in (shown, looks):
            process = running.enter_context(subprocess.Popen(command, stdout=subprocess.DEVNULL))
            running.callback(process.terminate)
        yield


def run(slew_deg: float = 2.0, seconds: float = 25.0) -> dict[str, Any]:
    """Slew and settle; the pointing error at the end, arcsec."""
    q_start, q_target = (from_radec_roll_deg(84.057 + turn, -1.2, turn) for turn in (0.0, slew_deg))
    plant = Plant(q_start, q_target)
    errors: list[Array] = []
    ages_s: list[float] = []
    with (
        tempfile.TemporaryDirectory() as folder,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as answers,
    ):
        answers.bind(("127.0.0.1", 0))
        answers.setblocking(False)
        attitudes, bench = free_port(socket.SOCK_DGRAM), Path(folder) / "bench.toml"
        with (
            display_and_tracker(bench, seconds, attitudes, int(answers.getsockname()[1])),
            Sender(f"udp://127.0.0.1:{attitudes}") as sender,
        ):
            rest(sender, q_start, answers)
            begun_s = time.monotonic()
            for step in range(1, round(seconds / STEP_S) + 1):
                q, rate_rad_s = plant.run_to(step * STEP_S)
                time.sleep(max(0.0, begun_s + step * STEP_S - time.monotonic()))
                sender.send(q, rate_rad_s)
                said = newest(answers)
                if said is not None:
                    # the tracker's clock is this machine's
                    age_s = (time.monotonic_ns() - said["t_ns"]) / 1e9
                    turn = np.array(said.get("rate", [0.0, 0.0, 0.0]))
                    plant.navigate(propagate(np.array(said["q"]), turn, age_s), turn)
                    ages_s.append(age_s)
                errors.append(to_rotation_vector(multiply(q, conjugate(q_target))) * ARCSEC_PER_RAD)
    last = np.array(errors[-round(SETTLED_SHARE * len(errors)) :])
    rms = np.sqrt(np.mean(last**2, axis=0))
    return {
        "slew_deg": slew_deg,
        "answers": len(ages_s),
        "answer_age_ms": 1e3 * float(np.median(ages_s)),
        "pointing_rms_arcsec": {"x": rms[0], "y": rms[1], "about_boresight": rms[2]},
    }


def rest(sender: Sender, q: Array, answers: socket.socket) -> None:
    """Send one attitude until the tracker answers."""
    until_s = time.monotonic() + WAITS_S
    while newest(answers) is None:
        if time.monotonic() > until_s:
            raise SystemExit(
                "the tracker does not answer; run hilstar serve and hilstar tracker by hand to"
                " see why"
            )
        sender.send(q, np.zeros(3))
        time.sleep(STEP_S)


if __name__ == "__main__":
    print(json.dumps(run(*map(float, sys.argv[1:]))))
