"""ArduPilot's EKF_STATUS_REPORT (193), which pymavlink's common dialects do not have.

In the form that pymavlink's decoder expects of a generated message; importing this makes it known.
"""

from __future__ import annotations

import struct
from typing import ClassVar

from pymavlink.dialects.v20 import development as mavlink

EKF_STATUS_ID = 193


class EkfStatusMessage(mavlink.MAVLink_message):  # type: ignore[misc]
    """Variances, and the same flags as in ESTIMATOR_STATUS; what MAVLink 2 adds to it is left out."""

    id = EKF_STATUS_ID
    msgname = "EKF_STATUS_REPORT"
    fieldnames: ClassVar = [
        "flags", "velocity_variance", "pos_horiz_variance", "pos_vert_variance", "compass_variance",
        "terrain_alt_variance",
    ]  # fmt: skip
    orders: ClassVar = [5, 0, 1, 2, 3, 4]
    lengths: ClassVar = [1] * 6
    crc_extra = 71
    unpacker = struct.Struct("<fffffH")

    def __init__(self, flags: int, *variances: float) -> None:
        super().__init__(EKF_STATUS_ID, self.msgname)
        self._fieldnames = self.fieldnames
        self.flags = flags
        (
            self.velocity_variance,
            self.pos_horiz_variance,
            self.pos_vert_variance,
            self.compass_variance,
            self.terrain_alt_variance,
        ) = variances


mavlink.mavlink_map[EKF_STATUS_ID] = EkfStatusMessage
