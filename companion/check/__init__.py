"""`companion check`: is everything there for a flight? It looks and asks, and moves nothing."""

from __future__ import annotations

import selectors
import time
from contextlib import ExitStack

from companion.check import credentials
from companion.check import ranges as ranging
from companion.check import vehicle as vehicles
from companion.check.ranges import RangeFindings
from companion.check.report import CheckReport, Part, Row, State, text
from companion.config import contradictions
from companion.link.credentials import CredentialsError
from companion.link.signing import SignedMavlink, SigningError
from companion.link.survey import VehicleSurvey, open_ranges
from companion.link.zenoh_ranges import RangeLink
from companion.live import Bell
from companion.settings import Settings

__all__ = ["CheckReport", "Part", "Row", "State", "check", "text"]

_LOOK_S = 0.05


def check(settings: Settings, patience_s: float) -> CheckReport:
    """Connect as a flight does, look and ask, and judge.

    `patience_s`: how long to wait for an autopilot, and from then on for all that it is asked for. With
    everything there it takes about four seconds.
    """
    rows: list[Row] = []
    with ExitStack() as stack:
        bell = Bell()
        stack.callback(bell.close)
        survey = ranges = signed = None
        try:
            signed = SignedMavlink.of(settings.vehicle)
            if signed is not None:
                stack.callback(signed.close)
            survey = VehicleSurvey.open(settings.vehicle, signed)
            stack.callback(survey.close)
        except SigningError as error:
            rows.append(Row(Part.LINK, "signing", State.FAIL, str(error), "A signed link is asked for."))
        except (OSError, ValueError) as error:
            rows.append(_no_link(settings.vehicle.mavlink, error))
        try:
            ranges = open_ranges(settings.ranges, bell.ring)
            stack.callback(ranges.close)
        except OSError as error:
            rows.append(_no_zenoh(error))
        except CredentialsError:
            pass  # its own row says it
        rows += credentials.judge(settings)
        heard = RangeFindings(settings)
        start_ns = time.monotonic_ns()
        try:
            _watch(survey, ranges, heard, bell, round(patience_s * 1e9))
        except OSError as error:
            rows.append(_no_link(settings.vehicle.mavlink, error))
        now_ns = time.monotonic_ns()
        watched_s = (now_ns - start_ns) * 1e-9
        height_m = None
        if survey is not None:
            survey.measure(now_ns)
            height_m = survey.found.height_m
            asked_s = watched_s
            if survey.found.t_found_ns is not None:
                asked_s = (now_ns - survey.found.t_found_ns) * 1e-9
            rows += vehicles.judge(settings, survey.found, signed is not None, asked_s)
        if ranges is not None:
            rows += ranging.judge(settings, heard, ranges.connected(), now_ns, watched_s, height_m)
    rows += _configuration(settings)
    order = list(Part)
    return CheckReport(tuple(sorted(rows, key=lambda row: order.index(row.part))))


def _watch(
    survey: VehicleSurvey | None,
    ranges: RangeLink | None,
    heard: RangeFindings,
    bell: Bell,
    patience_ns: int,
) -> None:
    """Listen and ask until everything is there, or patience ends."""
    start_ns = time.monotonic_ns()
    with selectors.DefaultSelector() as selector:
        selector.register(bell.fileno(), selectors.EVENT_READ)
        if survey is not None:
            selector.register(survey.fileno(), selectors.EVENT_READ)
        while survey is not None or ranges is not None:
            selector.select(_LOOK_S)
            bell.silence()
            for event in ranges.receive() if ranges is not None else ():
                heard.take_in(event)
            now_ns = time.monotonic_ns()
            from_ns = start_ns
            if survey is not None:
                survey.receive()
                survey.ask(now_ns)
                from_ns = survey.found.t_found_ns or start_ns
            complete = (survey is None or survey.is_complete(now_ns)) and (
                ranges is None or heard.is_complete(now_ns)
            )
            if complete or now_ns - from_ns >= patience_ns:
                return


def _no_link(url: str, error: Exception) -> Row:
    return Row(
        Part.LINK,
        "autopilot",
        State.FAIL,
        f"{url}: {error}",
        "The vehicle's link cannot be used.",
        "is another program using it (a flight, mavlink-router)? Check vehicle.mavlink, and whether you may "
        "open the serial port (group dialout)",
    )


def _no_zenoh(error: Exception) -> Row:
    return Row(
        Part.RANGES,
        "Zenoh",
        State.FAIL,
        str(error),
        "The ranges' link cannot be opened.",
        "check ranges.connect and ranges.listen; an endpoint looks like tcp/192.168.1.10:7447",
    )


def _configuration(settings: Settings) -> list[Row]:
    problems = contradictions(settings)
    if not problems:
        return [Row(Part.CONFIGURATION, "contradictions", State.OK, "none")]
    return [Row(Part.CONFIGURATION, "contradiction", State.FAIL, p) for p in problems]
