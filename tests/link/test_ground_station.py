"""What a ground station is told: every text whole, not too often, and never the wrong last word."""

from __future__ import annotations

import threading
from collections.abc import Sequence
from typing import Any

from hypothesis import given
from hypothesis import strategies as st
from pymavlink.dialects.v20 import common as mavlink

from companion.link.ground_station import GroundStation, text_messages
from companion.link.mavlink import VehicleLink
from companion.settings import GroundStationSettings, Settings, VehicleSettings
from companion.types import CompanionHeartbeat, Estimate, FlightMode, Output, Phase, Severity, SystemStatus
from tests.core.flights import OFFBOARD, Script, engaged, fly
from tests.link.test_mavlink_link import Autopilot, autopilot, heard, link  # noqa: F401 - fixtures
from tests.people.flights import change, status
from tests.people.parties import Mock

TEXTS_ONLY = Settings(ground_station=GroundStationSettings(values_rate_hz=0.0))


def on_the_wire(messages: list[Any]) -> list[Any]:
    """Packed and read again, as a ground station does."""
    ours, theirs = mavlink.MAVLink(None, 1, 191), mavlink.MAVLink(None)
    return [m for message in messages for m in theirs.parse_buffer(message.pack(ours))]


class Reader:
    """A ground station that joins chunks by MAVLink 2's rule: same id, in order, the last not full."""

    def __init__(self) -> None:
        self.texts: list[tuple[int, str]] = []
        self._parts: dict[int, str] = {}

    def read(self, messages: list[Any]) -> None:
        for m in on_the_wire(messages):
            if m.get_type() != "STATUSTEXT":
                continue
            if m.id == 0:
                self.texts.append((m.severity, m.text))
                continue
            assert (m.chunk_seq == 0) == (m.id not in self._parts)
            self._parts[m.id] = self._parts.get(m.id, "") + m.text
            if len(m.text) < 50:
                self.texts.append((m.severity, self._parts.pop(m.id)))


def told(outputs: Sequence[Output], settings: Settings = TEXTS_ONLY) -> list[tuple[int, str]]:
    ground, reader = GroundStation(settings), Reader()
    for output in outputs:
        reader.read(ground.messages(output))
    return reader.texts


@given(st.text(st.characters(min_codepoint=32, max_codepoint=126), min_size=1, max_size=300))
def test_a_text_of_any_length_arrives_whole(text: str) -> None:
    reader = Reader()
    reader.read(text_messages(Severity.WARNING, text, 7))
    assert reader.texts == [(4, text)]


def test_a_flight_is_told_in_order_with_its_severities() -> None:
    script = Script()
    flown = [fly(script.run(2.0))]
    for mode in (OFFBOARD, FlightMode.POSCTL):
        script.actual = script.intended = mode
        flown.append(fly(script.run(3.0), before=flown[-1]))
    texts = told([output for part in flown for output in part.outputs])
    assert texts[0] == (6, "companion: standby: vehicle and ranges are there: waiting for OFFBOARD")
    assert texts[1] == (5, "companion: acquire: OFFBOARD selected")
    assert (4, "companion: released: the vehicle left OFFBOARD") in [(n, text[:46]) for n, text in texts]


def test_a_refusal_says_what_to_do() -> None:
    script = Script()
    script.actual = script.intended = OFFBOARD
    (text,) = told(fly(script.run(2.0)).outputs)
    assert text == (
        4,
        "companion: inhibited: OFFBOARD was selected before this app was ready: "
        "select another mode, then OFFBOARD again",
    )


def test_chatter_is_limited_and_its_last_word_is_told() -> None:
    outputs: list[Output] = []
    for i in range(101):  # ten seconds of it
        there = (Phase.ACQUIRE, Phase.APPROACH)[i % 2]
        outputs.append(change(0.1 * i, Phase.HOLD, there, f"{there.value}!"))
        outputs.append(status(0.1 * i + 0.01))
    outputs += [status(10.0 + 0.1 * i) for i in range(20)]
    texts = told(outputs)
    assert 2 <= len(texts) <= 12
    assert texts[-1] == (6, "companion: acquire: acquire!")


def test_a_warning_does_not_wait_nor_does_the_end() -> None:
    outputs = [
        change(0.0, Phase.STANDBY, Phase.ACQUIRE, "OFFBOARD selected"),
        change(0.1, Phase.ACQUIRE, Phase.STALL, "no ranges: standing still", Severity.WARNING),
        change(0.2, Phase.STALL, Phase.HAND_OVER, "no ranges for too long", Severity.CRITICAL),
        change(0.3, Phase.HAND_OVER, Phase.ENDED, "disarmed: the flight is over", Severity.NOTICE),
    ]
    assert [severity for severity, _ in told(outputs)] == [6, 4, 2, 5]


def test_what_is_awaited_is_told_once_when_it_lasts() -> None:
    short, long = (
        ("ATTITUDE on udpin:0.0.0.0:14540",),
        ("ranges of beacon 'b1' (Zenoh site 'lab', tcp/10.0.0.1:7447)",),
    )
    outputs = [status(0.1 * i, phase=Phase.AWAIT, awaited=short if i < 5 else long) for i in range(100)]
    assert told(outputs) == [(5, f"companion: awaiting {long[0]}")]


def test_values_have_names_that_fit_and_leave_out_what_is_not_known() -> None:
    cfg = Settings(ground_station=GroundStationSettings(values_rate_hz=2.0))
    ground = GroundStation(cfg)
    sent: list[tuple[int, str, float]] = []
    for i in range(21):
        fields = (
            {"estimate": Estimate(5.3, 0.1, -0.5, 0.1)} if i < 10 else {"estimate": None, "range_age_s": 3.0}
        )
        for m in on_the_wire(ground.messages(status(0.1 * i, **fields))):
            sent.append((m.time_boot_ms, m.name, round(m.value, 2)))
    assert [name for _, name, _ in sent] == ["range_m", "bear_deg", "sigma_deg", "togo_m"] * 2
    assert [value for _, _, value in sent[:4]] == [5.9, -28.65, 5.73, 4.8]
    assert sent[4][0] - sent[0][0] == 500


def test_it_can_be_switched_off() -> None:
    off = Settings(ground_station=GroundStationSettings(texts=False, values_rate_hz=0.0))
    ground = GroundStation(off)
    outputs = [
        *engaged(Script()).outputs,
        status(1.0),
        status(9.0, awaited=("ranges",)),
        status(20.0, awaited=("ranges",)),
    ]
    assert not any(ground.messages(output) for output in outputs)


def test_nothing_is_told_before_the_vehicle_is_known(link: VehicleLink, autopilot: Autopilot) -> None:  # noqa: F811
    link._ground = GroundStation(TEXTS_ONLY)
    ending = change(1.0, Phase.AWAIT, Phase.STANDBY, "ready")
    link.send(ending)
    autopilot.heartbeat()
    heard(link)
    link.send(ending)
    while (message := autopilot.hear()).get_type() != "STATUSTEXT":
        assert message.get_type() == "COMMAND_LONG"
    assert (message.text, message.get_srcSystem(), message.get_srcComponent()) == (
        "companion: standby: ready",
        7,
        191,
    )


def test_mavsdk_on_the_ground_hears_the_companion_through_the_autopilot() -> None:
    import mavsdk
    from mavsdk.plugins import telemetry

    hearing = threading.Event()
    texts: list[str] = []

    def note(text: Any, _: object) -> None:
        texts.append(text.text)
        if text.text.startswith("companion: stall"):
            hearing.set()

    with Mock() as mock:
        client = mavsdk.Mavsdk(
            mavsdk.Configuration.create_with_component_type(mavsdk.ComponentType.GROUND_STATION)
        )
        vehicle = VehicleLink.open(
            VehicleSettings(mavlink=f"udpout:127.0.0.1:{mock.onboard_port}"), ground=GroundStation(TEXTS_ONLY)
        )
        try:
            client.add_any_connection(f"udpout://127.0.0.1:{mock.ground_port}")
            system = client.first_autopilot(60.0)
            assert system is not None
            telemetry.Telemetry(system).subscribe_status_text(note)
            for i in range(600):
                vehicle.send(CompanionHeartbeat(0, SystemStatus.ACTIVE))
                list(vehicle.receive())  # the autopilot is known once it is heard
                vehicle.send(
                    change(10.0 * i, Phase.APPROACH, Phase.STALL, f"no ranges, {i}", Severity.WARNING)
                )
                if hearing.wait(0.1):
                    break
            assert hearing.is_set(), texts
        finally:
            vehicle.close()
            client.destroy()
