"""The simulated faults: name, family, what happens, and what must come of it in each phase."""

from __future__ import annotations

from collections.abc import Mapping

from companion.types import Attitude, Defect, LocalMotion, ModeReport, Phase
from sitl_mock.faults import Fault as MockFault
from sitl_mock.modes import Mode
from tests.safety.faults import expected as must
from tests.safety.faults import strikes as do
from tests.safety.faults.expected import only, ranges_lost, rules
from tests.safety.faults.filters import (
    ALL,
    MAVLINK,
    RANGES,
    bursts,
    change,
    flood,
    jam,
    late,
    lose,
    lose_up,
    repeat,
    repeat_up,
    swap,
)
from tests.safety.faults.flight import ARDUPILOT, Fault, kill, select, start, stop
from tests.safety.faults.rules import ACQUIRE, APPROACH, AWAIT, COAST, GROUPS, HOLD, STALL, STANDBY, Rule
from tests.safety.faults.strikes import filtered, switched

_MOTION = (Attitude, LocalMotion)
_TAKEN = rules(engaged=must.TAKEN_THEN_READY, hand_over=must.ENDS, silent=must.STANDS)
_BOUNDED = rules(engaged=must.BOUNDED)
_HELD_UP = rules(engaged=must.HELD_UP, hand_over=must.HELD_UP)
_RESTAMPED = {**ranges_lost(8.0), COAST: must.STALLS_AFTER_ONE}
_GONE = rules(engaged=must.VEHICLE_LOST, standby=must.STANDBY_VEHICLE_LOST)


def _ardupilot(rule: Rule) -> Mapping[Phase, Rule]:
    return only(APPROACH, HOLD, STALL, rule=rule)


def _blind(for_s: float) -> Mapping[Phase, Rule]:
    return rules(engaged=must.after(for_s, must.HEADING_LOST))


# fmt: off
_ALL = (
    # the ranges
    Fault("range-loss-3s", "range", "no beacon is heard for 3 s",
        switched(MockFault.RANGE_LOSS, 3.0), ranges_lost(3.0)),
    Fault("range-loss-8s", "range", "no beacon is heard for 8 s",
        switched(MockFault.RANGE_LOSS, 8.0), ranges_lost(8.0), 12.0),
    Fault("range-loss", "range", "no beacon is heard any more",
        switched(MockFault.RANGE_LOSS), ranges_lost(20.0), 20.0),
    Fault("range-frozen", "range", "the last message is repeated for 8 s",
        switched(MockFault.RANGE_FROZEN, 8.0), ranges_lost(8.0), 12.0),
    Fault("range-restamped", "range", "the last message is repeated for 8 s, each time with a new stamp",
        (*switched(MockFault.RANGE_FROZEN, 8.0), *filtered(change(RANGES, do.stamped_anew), 8.0)),
        _RESTAMPED, 12.0),
    Fault("range-bias", "range", "every range is 1.5 m too long for 5 s",
        switched(MockFault.RANGE_BIAS, 5.0), rules()),
    Fault("beacon-restart", "range", "the beacon begins a new session",
        switched(MockFault.BEACON_RESTART, 0.5), rules()),
    Fault("beacon-other", "range", "another beacon's ranges only, for 8 s",
        filtered(do.ranges_with(beacon="b9"), 8.0), ranges_lost(8.0), 12.0),
    Fault("range-thinned", "range", "half of the ranges are lost", filtered(lose(RANGES, 0.5)), rules()),
    Fault("range-repeated", "range", "each range comes three times", filtered(repeat(RANGES, 3)), rules()),
    Fault("range-reordered", "range", "every two ranges come in the wrong order",
        filtered(swap(RANGES)), rules()),
    Fault("range-backlog", "range", "ranges wait for 2 s and come all at once",
        filtered(bursts(RANGES, 2.0, once=True)), rules()),
    Fault("range-late", "range", "each range comes 0.2 s late", filtered(late(RANGES, 0.2)), rules()),
    Fault("range-garbage", "range", "250 unreadable messages a second",
        filtered(jam(Defect.RANGE_PAYLOAD, 5)), rules()),
    Fault("range-flood", "range", "1000 ranges a second", filtered(flood(1000.0), 3.0), rules(), 6.0),
    Fault("range-absurd", "range", "NaN, infinite, negative and 1e9 m for 8 s",
        filtered(change(RANGES, do.absurd), 8.0), ranges_lost(8.0), 12.0),
    Fault("range-seq-stuck", "range", "sequence numbers 0, 1, 2, 0, … for 8 s",
        filtered(change(RANGES, do.seq_stuck), 8.0), _BOUNDED, 12.0),
    Fault("range-random", "range", "every range lies: anything from 0 to 60 m",
        filtered(do.ranges_drawn(0.0, 60.0)), _BOUNDED, 30.0),
    Fault("range-constant", "range", "every range lies: always 12 m",
        filtered(do.ranges_with(range_m=12.0)), only(ACQUIRE, APPROACH, rule=must.BUDGET), 112.0),

    # the link
    Fault("telemetry-stop-2s", "link", "heartbeat only, for 2 s",
        switched(MockFault.TELEMETRY_STOP, 2.0), _blind(2.0)),
    Fault("telemetry-stop", "link", "heartbeat only",
        switched(MockFault.TELEMETRY_STOP),
        rules(engaged=must.HEADING_LOST, standby=must.STANDBY_VEHICLE_LOST)),
    Fault("telemetry-nan", "link", "attitude and velocity are not finite for 3 s",
        filtered(change(_MOTION, do.not_finite), 3.0), _blind(3.0)),
    Fault("heartbeat-stop", "link", "no heartbeat for 5 s, all else goes on",
        switched(MockFault.HEARTBEAT_STOP, 5.0), rules()),
    Fault("mode-stop", "link", "CURRENT_MODE is not told", filtered(lose((ModeReport,), 1.0)), rules()),
    Fault("mode-stop-takeover", "link", "CURRENT_MODE is not told, LOITER is selected 2 s later",
        (*filtered(lose((ModeReport,), 1.0)), (2.0, select(Mode.LOITER))),
        rules(engaged=must.NEXT_HEARTBEAT, hand_over=must.BOUNDED)),
    Fault("link-loss-400ms", "link", "nothing in or out for 0.4 s",
        switched(MockFault.LINK_LOSS, 0.4), rules()),
    Fault("link-loss-2s", "link", "nothing in or out for 2 s",
        switched(MockFault.LINK_LOSS, 2.0), _blind(2.0)),
    Fault("link-loss-6s", "link", "nothing in or out for 6 s",
        switched(MockFault.LINK_LOSS, 6.0),
        rules(engaged=must.VEHICLE_LOST, standby=must.after(6.0, must.STANDBY_VEHICLE_LOST)), 10.0),
    Fault("link-loss", "link", "nothing in or out any more", switched(MockFault.LINK_LOSS), _GONE),
    Fault("uplink-loss", "link", "setpoints do not arrive for 3 s",
        switched(MockFault.SETPOINTS_REFUSED, 3.0), rules(engaged=must.FALLEN_BACK)),
    Fault("packet-loss", "link", "30 % of all MAVLink is lost, either way",
        filtered(lose(MAVLINK, 0.3), up=lose_up(0.3)), rules()),
    Fault("packet-repeated", "link", "every MAVLink message comes twice, either way",
        filtered(repeat(MAVLINK, 2), up=repeat_up(2)), rules()),
    Fault("packet-reordered", "link", "every two MAVLink messages of a kind are swapped",
        filtered(swap(MAVLINK)), rules()),
    Fault("packet-late", "link", "MAVLink comes 0.3 s late", filtered(late(MAVLINK, 0.3)), _BOUNDED),
    Fault("mavlink-garbage", "link", "1000 bad packets a second",
        filtered(jam(Defect.MAVLINK_BYTES, 20), 4.0), rules()),

    # people
    Fault("rc-switch", "person", "a pilot's switch selects POSCTL", switched(MockFault.RC_SWITCH), _TAKEN),
    Fault("rc-sticks", "person", "a pilot moves the sticks", switched(MockFault.RC_STICKS), _TAKEN),
    Fault("mode-land", "person", "the ground station commands LAND", ((0.0, select(Mode.LAND)),), _TAKEN),
    Fault("flick", "person", "POSCTL, and OFFBOARD again 2 s later",
        (*switched(MockFault.RC_SWITCH), (2.0, do.engage)),
        rules(engaged=must.ENGAGED_ANEW, hand_over=must.ENDS, silent=must.STANDS_FOR_2_S,
              waiting=must.STANDS_FOR_2_S, standby=must.STANDS_FOR_2_S)),
    Fault("engage-blind", "person", "ranges stop, OFFBOARD is selected 1 s later",
        (*switched(MockFault.RANGE_LOSS), (1.0, do.engage)), only(AWAIT, STANDBY, rule=must.STANDS)),
    Fault("stop", "person", "the app is asked to end (SIGTERM)",
        ((0.0, stop),), rules(every=must.ENDS, engaged=must.STOPS, hand_over=must.FALLS_SILENT)),

    # the vehicle
    Fault("disarm", "vehicle", "the motors are killed",
        switched(MockFault.DISARM),
        rules(every=must.DISARMED, waiting=must.STANDS, standby=must.STANDS, silent=must.WATCHES)),
    Fault("reboot", "vehicle", "the autopilot restarts in flight",
        switched(MockFault.REBOOT),
        rules(engaged=must.REBOOTED, hand_over=must.BOUNDED, silent=must.STANDS)),
    Fault("battery-low", "vehicle", "battery critical: PX4 lands",
        switched(MockFault.BATTERY_LOW), rules(engaged=must.TAKEN, hand_over=must.ENDS)),
    Fault("battery-warning", "vehicle", "the battery is low, PX4 does nothing",
        switched(MockFault.BATTERY_WARNING), rules(engaged=must.HANDS_OVER, standby=must.FALLS_SILENT_2_S)),
    Fault("second-commander", "vehicle", "somebody else's setpoints pass on the link",
        switched(MockFault.SECOND_COMMANDER), rules(engaged=must.HANDS_OVER, standby=must.FALLS_SILENT_2_S)),
    Fault("twin", "vehicle", "a second companion with the same ids is on the link",
        switched(MockFault.TWIN), rules(engaged=must.HANDS_OVER, standby=must.FALLS_SILENT_2_S)),
    Fault("second-vehicle", "vehicle", "another autopilot is heard on the link",
        switched(MockFault.SECOND_VEHICLE), rules()),
    Fault("id-change", "vehicle", "the autopilot's system id changes",
        switched(MockFault.ID_CHANGE), _GONE),
    Fault("velocity-invalid", "vehicle", "the velocity estimate is invalid",
        switched(MockFault.VELOCITY_INVALID), rules(engaged=must.TAKEN, hand_over=must.BOUNDED)),
    Fault("gps-lost", "vehicle", "no global position", switched(MockFault.GPS_LOST), rules()),
    Fault("gps-and-ranges-lost", "vehicle", "no global position, no ranges",
        (*switched(MockFault.GPS_LOST), *switched(MockFault.RANGE_LOSS)),
        only(APPROACH, HOLD, STALL, rule=must.NO_HOLD), 20.0),
    Fault("heading-jumps", "vehicle", "the estimated heading is reset by 57°",
        filtered(change((Attitude,), do.turned)), _BOUNDED),
    Fault("position-jumps", "vehicle", "the estimated position is reset by 6 m",
        filtered(change((LocalMotion,), do.moved)), rules()),
    Fault("height-jumps", "vehicle", "the estimated height is 20 m too large",
        filtered(change((LocalMotion,), do.raised)), _BOUNDED),
    Fault("velocity-lies", "vehicle", "the estimated velocity is wrong by 3 m/s",
        filtered(change((LocalMotion,), do.fast)), _BOUNDED),

    # clocks
    Fault("publisher-clock-forth", "clock", "the publisher's clock is set an hour ahead",
        ((0.0, do.clock_set(3600.0)),), rules()),
    Fault("publisher-clock-back", "clock", "the publisher's clock is set an hour back",
        ((0.0, do.clock_set(-3600.0)),), rules()),
    Fault("publisher-clock-jitter", "clock", "the publisher's clock is set back 0.1 s, ten times",
        tuple((0.5 * k, do.clock_set(-0.1)) for k in range(10)), rules()),
    Fault("autopilot-clock-step", "clock", "the autopilot's own clock is set back half a second",
        filtered(change(_MOTION, do.boot_half_back)), rules()),
    Fault("autopilot-clock-back", "clock", "the autopilot's own clock runs from 0 to 1 s, again and again",
        filtered(change(_MOTION, do.boot_back)),
        {**rules(engaged=must.RESTARTED, hand_over=must.RESTARTED), ACQUIRE: must.BOUNDED}),

    # the process
    Fault("killed", "process", "the app is killed and started anew 1 s later",
        ((0.0, kill), (1.0, start)), rules(every=must.WATCHES, waiting=must.STANDS, standby=must.STANDS)),
    Fault("killed-mode-late", "process", "killed, started anew 2 s later, CURRENT_MODE 1.5 s after that",
        (*filtered(lose((ModeReport,), 1.0), 3.5), (0.0, kill), (2.0, start)),
        rules(every=must.WATCHES, waiting=must.STANDS, standby=must.STANDS)),
    Fault("killed-for-good", "process", "the app is killed",
        ((0.0, kill),), rules(every=must.WATCHES._replace(says="silent at once"))),
    Fault("held-up-300ms", "process", "the loop does not run for 0.3 s",
        filtered(bursts(ALL, 0.3, once=True)), rules()),
    Fault("held-up-700ms", "process", "the loop does not run for 0.7 s",
        filtered(bursts(ALL, 0.7, once=True)), _BOUNDED),
    Fault("held-up-1500ms", "process", "the loop does not run for 1.5 s (SIGSTOP)",
        filtered(bursts(ALL, 1.5, once=True)), _HELD_UP),
    Fault("held-up-3s", "process", "the loop does not run for 3 s (SIGSTOP)",
        filtered(bursts(ALL, 3.0, once=True)), _HELD_UP),
    Fault("held-up-10s", "process", "the loop does not run for 10 s (SIGSTOP)",
        filtered(bursts(ALL, 10.0, once=True)), _HELD_UP, 14.0),
    Fault("held-up-takeover", "process", "the loop does not run for 0.7 s, LOITER is selected meanwhile",
        (*filtered(bursts(ALL, 0.7, once=True)), (0.3, select(Mode.LOITER))),
        only(*GROUPS["engaged"], rule=must.HELD_UP_TAKEOVER)),

    # an ArduCopter: GUIDED is told by HEARTBEAT alone, five times a second
    Fault("ardupilot-takeover", "person", "ArduCopter: a pilot selects another mode",
        ((0.0, select(Mode.POSCTL)),), _ardupilot(must.TAKEN_BY_HEARTBEAT), 6.0, ARDUPILOT),
    Fault("ardupilot-range-loss", "range", "ArduCopter: no beacon is heard any more",
        switched(MockFault.RANGE_LOSS), _ardupilot(must.HANDS_OVER_IN_TIME), 18.0, ARDUPILOT),
    Fault("ardupilot-link-loss", "link", "ArduCopter: nothing in or out any more",
        switched(MockFault.LINK_LOSS), _ardupilot(must.INSISTS), 6.0, ARDUPILOT),
    Fault("ardupilot-disarm", "vehicle", "ArduCopter: the motors are killed",
        switched(MockFault.DISARM), _ardupilot(must.DISARMED), 6.0, ARDUPILOT),
    Fault("ardupilot-stop", "person", "ArduCopter: the app is asked to end (SIGTERM)",
        ((0.0, stop),), _ardupilot(must.STOPS), 6.0, ARDUPILOT),
    Fault("ardupilot-killed", "process", "ArduCopter: the app is killed and started anew 1 s later",
        ((0.0, kill), (1.0, start)), _ardupilot(must.WATCHES), 6.0, ARDUPILOT),
    Fault("ardupilot-held-up-3s", "process", "ArduCopter: the loop does not run for 3 s (SIGSTOP)",
        filtered(bursts(ALL, 3.0, once=True)), _ardupilot(must.INSISTS), 8.0, ARDUPILOT),
    Fault("ardupilot-held-up-takeover", "process", "ArduCopter: the same, and a pilot takes over meanwhile",
        (*filtered(bursts(ALL, 3.0, once=True)), (1.0, select(Mode.POSCTL))),
        _ardupilot(must.NOTHING_ASKED), 8.0, ARDUPILOT),
    Fault("ardupilot-unheard-takeover", "link", "ArduCopter: nothing is heard of it, and a pilot takes over",
        (*filtered(lose((*MAVLINK,), 1.0)), (1.0, select(Mode.POSCTL))),
        _ardupilot(must.NOTHING_ASKED), 12.0, ARDUPILOT),

    # load
    Fault("slow-loop", "load", "the loop runs five times a second only",
        filtered(bursts(ALL, 0.2)), _BOUNDED),
)
# fmt: on

FAULTS: Mapping[str, Fault] = {fault.name: fault for fault in _ALL}
"""By name, in the order of the table."""
