"""A real flight: links, signals, view and summary around the loop."""

from __future__ import annotations

import gc
import os
import signal
import sys
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path

import msgspec
import zenoh

from companion.compiled import twin
from companion.exits import Exit
from companion.link.ground_station import GroundStation
from companion.link.mavlink import VehicleLink
from companion.link.signing import SignedMavlink, SigningError
from companion.link.systemd import Notifier
from companion.link.zenoh_ranges import RangeLink
from companion.link.zenoh_session import words
from companion.link.zenoh_status import StatusLink
from companion.live import Bell, Loop
from companion.recorder import Recorder
from companion.settings import Settings
from companion.state import State
from companion.summary import FlightLog, FlightReport, problem_of, report, text
from companion.types import Output, PhaseChange, Status
from companion.view import View


def fly(
    settings: Settings, view: View, recorder: Recorder, json_file: Path | None, png_file: Path | None
) -> Exit:
    """Fly until the flight is over, then tell what it came to."""
    log = FlightLog()
    try:
        with ExitStack() as stack:
            bell = twin(Bell)()
            stack.callback(bell.close)
            for number in (
                signal.SIGINT,
                signal.SIGTERM,
            ):  # first in, last out: the record closes in peace
                stack.callback(signal.signal, number, signal.signal(number, lambda *_: bell.ask_stop()))
            stack.enter_context(recorder)
            stack.callback(view.close)
            systemd = Notifier()
            stack.callback(systemd.close)
            vehicle, ranges = _links(stack, settings, bell)
            network = NetworkWatch(ranges, bool(settings.ranges.tls), view.tell)
            status = StatusLink(settings, lambda: ranges.session, view.tell)
            stack.callback(status.close)

            def tell(output: Output) -> None:
                systemd.send(output)
                status.send(output)
                if isinstance(output, Status):
                    network.look(output)
                    view.show(output)
                    log.add(output)
                elif isinstance(output, PhaseChange):
                    view.note(output)
                    log.add(output)

            if settings.mission.shadow:
                view.tell("shadow: everything is computed, nothing is sent but the heartbeat")
            if recorder.problem is not None:
                view.tell(f"not recorded: {recorder.problem}")
            gc.freeze()  # what is there now stays: the collector need not look at it again
            final = twin(Loop)(settings, vehicle, ranges, bell, tell, recorder.write).fly()
    except (LinkError, OSError, SigningError, zenoh.ZError) as error:
        print(f"companion: link: {error}", file=sys.stderr)
        return Exit.LINK
    flight = report(log, problem_of(settings))
    try:
        if settings.mission.shadow:
            print("shadow flight: nothing of this was sent to the vehicle")
        print(text(flight.summary))
        print(f"record: {recorder.problem or recorder.name}")
        if recorder.problem is None:
            print(f"to look at it: companion report {recorder.name}")
        _write(flight, json_file, png_file)
        sys.stdout.flush()
    except (
        OSError
    ):  # nobody reads any more, or the disk is full: the exit status is the flight's all the same
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    return exit_status(final, log)


class LinkError(Exception):
    """A link cannot be opened as configured. (In flight a ValueError is a bug, and crashes.)"""


def _links(stack: ExitStack, settings: Settings, bell: Bell) -> tuple[VehicleLink, RangeLink]:
    try:
        signed = SignedMavlink.of(settings.vehicle)
        if signed is not None:
            stack.callback(signed.close)
        vehicle = twin(VehicleLink).open(
            settings.vehicle, signed, settings.mission.shadow, twin(GroundStation)(settings)
        )
        stack.callback(vehicle.close)
    except OSError as error:
        raise LinkError(
            f"{settings.vehicle.mavlink}: {error.strerror or error} (vehicle.mavlink; is another program "
            "using it, such as mavlink-router or another flight?)"
        ) from error
    except ValueError as error:
        raise LinkError(str(error)) from error
    try:
        ranges = twin(RangeLink)(settings.ranges, bell.ring, settings.beacons)
        stack.callback(ranges.close)
    except ValueError as error:
        raise LinkError(str(error)) from error
    except zenoh.ZError as error:
        raise LinkError(f"Zenoh: {words(error)} (ranges.connect, ranges.listen)") from error
    return vehicle, ranges


class NetworkWatch:
    """Says while something is awaited whether anybody is connected: Zenoh itself keeps trying in silence."""

    def __init__(self, ranges: RangeLink, is_guarded: bool, tell: Callable[[str], None]) -> None:
        self._ranges, self._is_guarded, self._tell = ranges, is_guarded, tell
        self._told: str | None = None
        self._looks = 0

    def look(self, status: Status) -> None:
        """Tell a person when it has changed. Not asked for in flight: there the ranges' age says it."""
        if not any(words.startswith("ranges") for words in status.awaited):
            return
        self._looks += 1
        if self._looks == 1:
            return  # it has only just begun
        found = "Zenoh: connected, and no range yet"
        if self._is_guarded:
            found += ": are the beacons on, and do the router's rules name their certificates and this one?"
        if not self._ranges.connected():
            found = f"Zenoh: connected to nobody; it keeps trying. {self._ranges.reason}".strip()
        if found != self._told:
            self._told = found
            self._tell(found)


def exit_status(final: State, log: FlightLog) -> Exit:
    """What the ending means to a script."""
    if final.flight.captured:
        return Exit.OK
    if final.flight.was_engaged:
        return Exit.INTERRUPTED if final.flight.stop_asked else Exit.NOT_CAPTURED
    if final.flight.stop_asked:
        return Exit.INTERRUPTED
    awaited = log.last.awaited if log.last is not None else ()
    return Exit.NO_RANGES if awaited and awaited[0].startswith("ranges") else Exit.NO_VEHICLE


def _write(flight: FlightReport, json_file: Path | None, png_file: Path | None) -> None:
    if json_file is not None:
        try:
            json_file.write_bytes(msgspec.json.encode(flight))
        except OSError as error:
            print(f"companion: no summary: {json_file}: {error.strerror or error}", file=sys.stderr)
    if png_file is not None:
        from companion.picture import PictureError, draw_flight

        try:
            draw_flight(png_file, flight)
            print(f"picture: {png_file}")
        except PictureError as error:
            print(f"companion: no picture: {error}", file=sys.stderr)
