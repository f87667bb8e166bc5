"""Writes attitudes as a CCSDS Attitude Ephemeris Message 1.0, in KVN or XML, through `ccsds-ndm`.

Version 1.0, because every AEM reader reads it, and it states the quaternion's order and direction in the file. Rates are
written as quaternion derivatives: some readers take QUATERNION/RATE of 1.0 as an angular velocity, others as Euler rates.
"""

from __future__ import annotations

from collections.abc import Sequence
from datetime import UTC, datetime
from typing import Any

import numpy as np

from hilstar.attitude.logs.aem.blocks import DERIVATIVE, QUATERNION
from hilstar.attitude.logs.aem.epochs import epoch_text
from hilstar.attitude.logs.aem.xml import library
from hilstar.attitude.wire.packet import AttitudeSample
from hilstar.rotation import conjugate, multiply

SCALES = frozenset({"UTC", "TAI", "TT", "TDB", "TCB", "GPS", "UT1", "SCLK"})  # of AEM 1.0; other clocks are written as UTC


def aem_text(samples: Sequence[AttitudeSample], xml: bool, scale: str | None = None) -> str:
    """An AEM 1.0 of at least one sample, as KVN or XML: a new block at each discontinuity, ICRF to STARTRACKER_1, scalar last.

    A block whose samples all have a rate contains quaternion derivatives; other blocks drop their rates. Sequence numbers are
    dropped. Raises MachineError without ccsds-ndm.
    """
    library()
    from ccsds_ndm import mapping, ndm_io  # type: ignore[import-untyped]
    from ccsds_ndm.models import ndmxml2 as aem  # type: ignore[import-untyped]

    starts = [i for i, sample in enumerate(samples) if i == 0 or sample.discontinuity]
    blocks = [samples[i:j] for i, j in zip(starts, [*starts[1:], len(samples)], strict=True)]
    created = datetime.now(UTC).strftime("%Y-%m-%dT%H:%M:%S")
    message = aem.Aem(
        header=aem.NdmHeader(creation_date=created, originator="HILSTAR"),
        body=aem.AemBody(segment=[_segment(aem, block, scale) for block in blocks]),
    )
    form = mapping.NDMFileFormats.XML if xml else mapping.NDMFileFormats.KVN
    return str(ndm_io.NdmIo().to_string(message, form)).rstrip() + "\n"


def _segment(aem: Any, samples: Sequence[AttitudeSample], scale: str | None) -> Any:
    from ccsds_ndm.models.ndmxml2.ndmxml_2_0_0_aem_1_0 import AttitudeTypeType  # type: ignore[import-untyped]

    rates = [sample.rate_cam_rad_s for sample in samples if sample.rate_cam_rad_s is not None]
    with_rates = len(rates) == len(samples)
    q = np.array([sample.q_icrs_to_cam for sample in samples])
    q_dot = np.zeros_like(q)
    if with_rates:
        q_dot = multiply(np.concatenate((np.zeros((len(q), 1)), np.array(rates)), axis=1), q) / -2.0
    epochs = [epoch_text(sample.t_ns) for sample in samples]
    rows = zip(epochs, (conjugate(q) + 0.0).tolist(), (conjugate(q_dot) + 0.0).tolist(), strict=True)  # + 0.0: CCSDS has no -0
    states = [_state(aem, epoch, components, dots if with_rates else None) for epoch, components, dots in rows]
    metadata = aem.AemMetadata(
        comment=[
            "STARTRACKER_1 is the camera: +z boresight, +x right and +y down in its image.",
            "Epochs are the source's clock from 1970-01-01T00:00:00; leap seconds are not counted.",
        ],
        object_name="UNKNOWN",
        object_id="UNKNOWN",
        ref_frame_a="ICRF",
        ref_frame_b="STARTRACKER_1",
        attitude_dir=aem.RotDirectionType.A2_B,
        time_system=aem.TimeSystemType(scale if scale in SCALES else "UTC"),
        start_time=epochs[0],
        stop_time=epochs[-1],
        attitude_type=AttitudeTypeType(DERIVATIVE if with_rates else QUATERNION),
        quaternion_type=aem.QuaternionTypeType("LAST"),
    )
    return aem.AemSegment(metadata=metadata, data=aem.AemData(attitude_state=states))


def _state(aem: Any, epoch: str, q: list[float], q_dot: list[float] | None) -> Any:
    quaternion = aem.QuaternionType(qc=q[0], q1=q[1], q2=q[2], q3=q[3])
    if q_dot is None:
        return aem.AttitudeStateType(quaternion_state=aem.QuaternionEphemerisType(epoch=epoch, quaternion=quaternion))
    qc, q1, q2, q3 = (aem.QuaternionDotType(value=value) for value in q_dot)
    dot = aem.QuaternionRateType(qc_dot=qc, q1_dot=q1, q2_dot=q2, q3_dot=q3)
    state = aem.QuaternionDerivativeType(epoch=epoch, quaternion=quaternion, quaternion_rate=dot)
    return aem.AttitudeStateType(quaternion_derivative=state)
