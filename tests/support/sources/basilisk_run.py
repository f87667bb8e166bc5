"""A tumbling spacecraft in Basilisk, in a process of its own: python basilisk_run.py SCENARIO.json

The scenario says how it is shown ("broadcastStream" in real time, "liveStream" or "noDisplay" as
fast as the other side answers), where it begins, and its camera, if it has one. Basilisk's own
record of every step goes to `truth` (.npz), and each picture that its camera got to
`pictures`-<ns>.png. Its sockets are open before it waits for a line on stdin.
"""

from __future__ import annotations

import ctypes
import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
from Basilisk.architecture import messaging
from Basilisk.simulation import simSynch, spacecraft
from Basilisk.utilities import SimulationBaseClass, macros, vizSupport

STEP_S = 0.001  # of the dynamics; what is shown comes every `shown_s`


def tumbling(name: str, sigma: list[float], omega_rad_s: list[float]) -> spacecraft.Spacecraft:
    """A body with three different moments of inertia, which nothing disturbs."""
    craft = spacecraft.Spacecraft()
    craft.ModelTag = name
    craft.hub.mHub = 100.0
    craft.hub.IHubPntBc_B = [[10.0, 0.0, 0.0], [0.0, 14.0, 0.0], [0.0, 0.0, 18.0]]
    craft.hub.r_CN_NInit, craft.hub.v_CN_NInit = [7000e3, 0.0, 0.0], [0.0, 7500.0, 0.0]
    craft.hub.sigma_BNInit = [[s] for s in sigma]
    craft.hub.omega_BN_BInit = [[w] for w in omega_rad_s]
    return craft


def camera_message(camera: dict[str, Any], parent: str) -> messaging.CameraConfigMsg:
    """A camera that is on, from its keys in Basilisk's own words."""
    payload = messaging.CameraConfigMsgPayload()
    for key, value in camera.items():
        setattr(payload, key, value)
    payload.parentName, payload.isOn = parent, 1
    return messaging.CameraConfigMsg().write(payload)


def save_picture(viz: Any, stem: str) -> None:
    """What the camera's image message points to."""
    image = viz.opnavImageOutMsgs[0].read()
    data = (
        (ctypes.c_char * image.imageBufferLength).from_address(int(image.imagePointer))
        if image.valid
        else b""
    )
    Path(f"{stem}-{image.timeTag}.png").write_bytes(bytes(data))


def run(scenario: dict[str, Any]) -> None:
    sim = SimulationBaseClass.SimBaseClass()
    process = sim.CreateNewProcess("process")
    process.addTask(sim.CreateNewTask("dynamics", macros.sec2nano(STEP_S)), 2)
    process.addTask(sim.CreateNewTask("display", macros.sec2nano(scenario["shown_s"])), 1)
    if scenario["mode"] == "broadcastStream":
        clock = simSynch.ClockSynch()
        clock.accelFactor = 1.0
        sim.AddModelToTask("dynamics", clock)
    crafts = [tumbling(name, *start) for name, start in scenario["spacecraft"].items()]
    for craft in crafts:
        sim.AddModelToTask("dynamics", craft)
    truth = crafts[0].scStateOutMsg.recorder()
    sim.AddModelToTask("dynamics", truth)
    viz = vizSupport.enableUnityVisualization(sim, "display", crafts, **{scenario["mode"]: True})
    viz.reqComAddress = viz.pubComAddress = "127.0.0.1"
    viz.reqPortNumber = viz.pubPortNumber = str(scenario["port"])
    if scenario.get("camera"):
        message = camera_message(scenario["camera"], crafts[0].ModelTag)
        viz.addCamMsgToModule(message)
    sim.InitializeSimulation()
    sys.stdin.readline()  # whoever is to hear its first step is there
    for stop_s in scenario["stops_s"]:
        sim.ConfigureStopTime(macros.sec2nano(stop_s))
        sim.ExecuteSimulation()
        if scenario.get("camera"):
            save_picture(viz, scenario["pictures"])
    columns = {
        "t_ns": truth.times(),
        "sigma_bn": truth.sigma_BN,
        "omega_bn_b": truth.omega_BN_B,
        "v_bn_n": truth.v_BN_N,
    }
    columns["r_bn_n"] = truth.r_BN_N
    np.savez(scenario["truth"], **columns)


if __name__ == "__main__":
    run(json.loads(Path(sys.argv[1]).read_text()))
