"""The floor: the least that the same libraries can do between a range and a setpoint.

Zenoh's callback → a constant setpoint → pymavlink's pack → UDP. It reads no range, no telemetry and no clock
but for the message's time stamp; what it costs cannot be saved by anybody who uses these libraries. Zenoh's
threads are set as the app's are (`ZENOH_RUNTIME`, by the import of `companion.link.zenoh_session`).

    python -m companion.bench.system.floor tcp/127.0.0.1:7447 127.0.0.1:14540
"""

from __future__ import annotations

import socket
import sys
import threading
import time

import zenoh
from pymavlink.dialects.v20 import development as mavlink

from companion.link.zenoh_session import zenoh_config
from companion.network_settings import RangesSettings
from companion.wire_range import range_key

_HEARTBEAT_S = 1.0
_MASK = 1 | 2 | 32 | 64 | 128 | 256 | 1024
"""As the app sends it: horizontal velocity, height and yaw rate count."""


def main(endpoint: str, address: str) -> None:
    """Answer every range of every beacon, until killed."""
    host, _, port = address.rpartition(":")
    settings = RangesSettings(connect=(endpoint,))
    out = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    out.connect((host, int(port)))
    mav = mavlink.MAVLink(None, srcSystem=1, srcComponent=191)
    lock = threading.Lock()  # pymavlink's object is not for two threads

    def send(message: mavlink.MAVLink_message) -> None:
        with lock:
            data = message.pack(mav)
            mav.seq = (mav.seq + 1) % 256
        out.send(data)

    def answer(_: zenoh.Sample) -> None:
        t_ms = time.monotonic_ns() // 1_000_000 & 0xFFFFFFFF
        send(
            mavlink.MAVLink_set_position_target_local_ned_message(
                t_ms, 1, 1, mavlink.MAV_FRAME_LOCAL_NED, _MASK,
                0.0, 0.0, -3.0, 0.4, 0.3, 0.0, 0.0, 0.0, 0.0, 0.0, 0.1,
            )
        )  # fmt: skip

    heartbeat = mavlink.MAVLink_heartbeat_message(18, 8, 0, 0, 4, 3)
    send(heartbeat)
    with zenoh.open(zenoh_config(settings)) as session:
        key = range_key(settings.site, "*", settings.tag)
        session.declare_subscriber(key, zenoh.handlers.Callback(answer, indirect=False))
        while True:
            time.sleep(_HEARTBEAT_S)
            send(heartbeat)


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2])
