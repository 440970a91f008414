"""The autopilot's parameters, as far as the mock obeys them (or a client asks for them)."""

from __future__ import annotations

DEFAULTS: dict[str, int | float] = {
    "COM_DISARM_LAND": 2.0,  # s from landed to disarmed
    "COM_DISARM_PRFLT": 10.0,  # s from armed to disarmed without a take-off
    "COM_LOW_BAT_ACT": 0,  # critical battery: 0 warning, 2 land, 3 return
    "COM_OBL_RC_ACT": 0,  # stream lost: 0 position, 1 altitude, 2 manual, 3 return, 4 land, 5 hold, 6, 7 stop
    "COM_OF_LOSS_T": 1.0,  # s
    "COM_RC_OVERRIDE": 1,  # stick override: bit 0 automatic modes, bit 1 OFFBOARD
    "COM_RCL_EXCEPT": 4,
    "MAV_SYS_ID": 1,
    "MAV_TYPE": 2,
    "MIS_TAKEOFF_ALT": 2.5,  # m
    "MPC_LAND_CRWL": 0.3,  # m/s near the ground
    "MPC_LAND_SPEED": 0.7,  # m/s
    "MPC_TKO_RAMP_T": 3.0,  # s
    "MPC_TKO_SPEED": 1.5,  # m/s
    "MPC_XY_CRUISE": 5.0,  # m/s
    "MPC_XY_P": 0.95,  # 1/s
    "MPC_XY_VEL_MAX": 12.0,  # m/s
    "MPC_Z_P": 1.0,  # 1/s
    "MPC_Z_VEL_MAX_DN": 1.5,  # m/s
    "MPC_Z_VEL_MAX_UP": 3.0,  # m/s
    "RTL_RETURN_ALT": 60.0,  # m, at most
    "SYS_AUTOSTART": 10040,
}
"""PX4's defaults (COM_RCL_EXCEPT as set for flying without radio control): int is INT32, float REAL32."""


ARDUPILOT_DEFAULTS: dict[str, int | float] = {
    "FS_GCS_ENABLE": 0,  # no HEARTBEAT of SYSID_MYGCS for 5 s: 0 nothing, 5 land
    "GUID_TIMEOUT": 3.0,  # s without a setpoint, then GUIDED stands
    "SYSID_MYGCS": 255,
}
"""ArduCopter's, as far as its mock obeys them; the others here keep PX4's names."""


class Params:
    """A parameter table. A parameter keeps its type for ever."""

    def __init__(self, overrides: dict[str, int | float] | None = None, ardupilot: bool = False) -> None:
        self.values = DEFAULTS | (ARDUPILOT_DEFAULTS if ardupilot else {})
        """Name → value, now; to be changed by `set` only."""
        for name, value in (overrides or {}).items():
            self.set(name, value)

    def __getitem__(self, name: str) -> float:
        return self.values[name]

    def names(self) -> list[str]:
        """Every name, in the order of its index on the wire."""
        return list(self.values)

    def get(self, name: str) -> int | float | None:
        """The value, or None if there is no such parameter."""
        return self.values.get(name)

    def set(self, name: str, value: float) -> bool:
        """Set a parameter in its own type; False if there is no such parameter."""
        old = self.values.get(name)
        if old is None:
            return False
        self.values[name] = int(value) if isinstance(old, int) else float(value)
        return True
