"""Configuration: TOML → typed, range-checked, frozen. File < environment < command line.

The environment is `COMPANION_TABLE__KEY=value` (`COMPANION_BEACONS__B1__HEIGHT_M` for a nested table), the
command line `--set table.key=value`. Values are TOML; what is not TOML is taken as text.
"""

from __future__ import annotations

import copy
import difflib
import hashlib
import math
import re
import tomllib
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
from msgspec import inspect

from companion.guidance.station_settings import BEACONS_NEEDED
from companion.link import credentials
from companion.link.transport import parse_url
from companion.network_settings import NAME_RULE, RULES, is_name
from companion.settings import Settings
from sitl_mock.scenario import Scenario

ENVIRONMENT_PREFIX = "COMPANION_"


class ConfigError(Exception):
    """The configuration cannot be used; the text names key, value and what is allowed."""


class Config(Settings, frozen=True, forbid_unknown_fields=True):
    """Everything that a configuration file may hold: the settings of a flight, and the simulated world."""

    sim: Scenario = Scenario()


class Loaded(NamedTuple):
    """A configuration, and where each value that is not a default came from (dotted key → source)."""

    config: Config
    sources: dict[str, str]

    @property
    def digest(self) -> str:
        """Identifies the effective configuration in logs: the first 16 hex digits of its SHA-256."""
        return hashlib.sha256(msgspec.json.encode(self.config, order="sorted")).hexdigest()[:16]


def load(
    path: Path | None,
    environment: Mapping[str, str],
    overrides: Iterable[str] = (),
    recorded: Mapping[str, Any] | None = None,
) -> Loaded:
    """Read and check a configuration; without a file, start from a recorded one or from the defaults.

    Raises ConfigError with one line that says what to change.
    """
    raw: dict[str, Any] = copy.deepcopy(dict(recorded or {}))
    sources: dict[str, str] = dict.fromkeys(_leaves(raw), "the record")
    if path is not None:
        raw = _read(path)
        sources = dict.fromkeys(_leaves(raw), str(path))
    for name in sorted(environment):
        if name.startswith(ENVIRONMENT_PREFIX) and "__" in name:
            keys = _match_case(raw, name.removeprefix(ENVIRONMENT_PREFIX).split("__"))
            _put(raw, keys, _value(environment[name]), name)
            sources[".".join(keys)] = f"environment {name}"
    for override in overrides:
        key, separator, text = override.partition("=")
        if not separator or "." not in key:
            raise ConfigError(f"--set {override}: expected table.key=value")
        keys = key.strip().split(".")
        _put(raw, keys, _value(text.strip()), f"--set {override}")
        sources[key.strip()] = f"--set {override}"
    config = _convert(raw, sources)
    problems = contradictions(config)
    if problems:
        raise ConfigError("; ".join(problems))
    return Loaded(config, sources)


_AUTOPILOTS_COMPONENT_ID = 1
_LATE_SPACINGS = 2.0


def contradictions(c: Settings) -> list[str]:
    """What no single value shows: combinations that cannot be flown, each in words."""
    problems = []
    known = ", ".join(sorted(c.beacons)) or "none"
    if c.mission.kind == "station":
        problems += _station_contradictions(c, known)
    elif c.mission.target not in c.beacons:
        problems.append(f"mission.target = {c.mission.target!r}: no such beacon; [beacons] has {known}")
    try:
        parse_url(c.vehicle.mavlink)
    except ValueError as error:
        problems.append(f"vehicle.mavlink = {error}")
    problems += credentials.contradictions(c.ranges)
    problems += [f"beacons.{b}: {NAME_RULE}" for b in c.beacons if not is_name(b)]
    if bool(c.vehicle.signing_key_file) != bool(c.vehicle.signing_state_file):
        problems.append("vehicle.signing_key_file and vehicle.signing_state_file: either both or none")
    if c.vehicle.component_id == _AUTOPILOTS_COMPONENT_ID:
        problems.append("vehicle.component_id = 1: that is the autopilot's own; 191 is usual")
    problems += [
        f"ranges.ros2: topic {t.topic!r} with beacon {t.beacon!r}: `*` stands for several, `beacon` for one"
        for t in c.ranges.ros2
        if t.beacon is not None and "*" in t.topic
    ]
    max_range_m = c.ranges.max_range_m
    pairs = (
        ("guidance.speed_m_s", c.guidance.speed_m_s, "limits.speed_m_s", c.limits.speed_m_s),
        ("guidance.capture_radius_m", c.guidance.capture_radius_m, "ranges.max_range_m", max_range_m),
        (
            "guidance.yaw_rate_max_rad_s",
            c.guidance.yaw_rate_max_rad_s,
            "limits.yaw_rate_rad_s",
            c.limits.yaw_rate_rad_s,
        ),
        ("loss.coast_after_s", c.loss.coast_after_s, "loss.stall_after_s", c.loss.stall_after_s),
        ("loss.stall_after_s", c.loss.stall_after_s, "loss.hand_over_after_s", c.loss.hand_over_after_s),
        ("limits.height_min_m", c.limits.height_min_m, "limits.height_max_m", c.limits.height_max_m),
        ("limits.height_min_m", c.limits.height_min_m, "vehicle.height_m", c.vehicle.height_m),
        ("vehicle.height_m", c.vehicle.height_m, "limits.height_max_m", c.limits.height_max_m),
        ("stream.min_rate_hz", c.stream.min_rate_hz, "stream.max_rate_hz", c.stream.max_rate_hz),
        *(
            (f"beacons.{name}.station_distance_m", b.station_distance_m, "ranges.max_range_m", max_range_m)
            for name, b in sorted(c.beacons.items())
            if b.station_distance_m is not None
        ),
    )
    problems += [
        f"{small} = {low:g}: must not be above {large} = {high:g}"
        for small, low, large, high in pairs
        if low > high
    ]
    spacing_s = 1.0 / c.vehicle.telemetry_rate_hz
    if c.loss.telemetry_after_s < _LATE_SPACINGS * spacing_s:
        problems.append(
            f"loss.telemetry_after_s = {c.loss.telemetry_after_s:g}: telemetry comes every {spacing_s:g} s "
            f"at best (vehicle.telemetry_rate_hz = {c.vehicle.telemetry_rate_hz:g}), and one may be lost: "
            f"allow {_LATE_SPACINGS * spacing_s:g} s at least"
        )
    if c.vehicle.kind == "ardupilot":
        problems += _ardupilot_contradictions(c)
    if c.mission.kind == "capture" and c.mission.target in c.beacons:
        problems += _capture_contradictions(c)
    return problems


def _ardupilot_contradictions(c: Settings) -> Iterable[str]:
    """What ArduCopter does not know, and what its GUIDED mode makes dangerous."""
    if c.vehicle.setpoint_frame != "body_ned":
        yield (
            f"vehicle.setpoint_frame = {c.vehicle.setpoint_frame!r}: vehicle.kind = 'ardupilot' takes "
            "velocities in all three axes only; set it to 'body_ned'"
        )
    for key, value in (
        ("loss.hand_over_to", c.loss.hand_over_to),
        ("loss.battery_to", c.loss.battery_to),
    ):
        if value == "release":
            yield f"{key} = 'release': an ArduPilot stays in GUIDED after that; allowed: 'land', 'hold'"


def _capture_contradictions(c: Settings) -> Iterable[str]:
    """A disc whose edge cannot be told from its middle, or that the vehicle cannot stop inside."""
    g, v, target = c.guidance, c.vehicle, c.mission.target
    beacon, radius_m = c.beacons[target], g.capture_radius_m
    # A height that the beacon tells itself is not known yet: then the range alone is held against the radius;
    # for "drift" too, which tells near from far by how the ranges change on the way.
    above_m = 0.0
    if beacon.height_m is not None and g.observer != "drift":
        above_m = abs(v.height_m - beacon.height_m)
    slant_m = math.hypot(radius_m, above_m)
    told_m = math.hypot(slant_m * beacon.sigma_m, above_m * v.height_sigma_m) / radius_m
    if told_m > radius_m:
        yield (
            f"guidance.capture_radius_m = {radius_m:g}: {above_m:g} m above {target} the horizontal distance "
            f"is known to {told_m:.2f} m only (beacons.{target}.sigma_m = {beacon.sigma_m:g}, "
            f"vehicle.height_sigma_m = {v.height_sigma_m:g}): take a larger radius, or fly closer to the "
            "beacon's height"
        )
    overrun_m = g.speed_m_s * (v.velocity_lag_s + v.response_delay_s)
    if overrun_m > 2.0 * radius_m:
        yield (
            f"guidance.speed_m_s = {g.speed_m_s:g}: the vehicle coasts {overrun_m:.2f} m before it stands "
            "(vehicle.velocity_lag_s, response_delay_s), further than the disc of "
            f"guidance.capture_radius_m = {radius_m:g} is wide: fly slower, or take a larger radius"
        )


def _station_contradictions(c: Settings, known: str) -> list[str]:
    problems = []
    if len(c.beacons) < BEACONS_NEEDED:
        problems.append(
            f"beacons = {known}: mission.kind = 'station' needs at least {BEACONS_NEEDED}, not in one line"
        )
    problems += [
        f"beacons.{name}.station_distance_m = none: mission.kind = 'station' needs the horizontal distance "
        "of the station from every beacon, above 0"
        for name, beacon in sorted(c.beacons.items())
        if beacon.station_distance_m is None
    ]
    told = [name for name, beacon in sorted(c.beacons.items()) if beacon.station_bearing_rad is not None]
    if told and c.station.scheme != "station-paper":
        problems.append(
            f"beacons.{told[0]}.station_bearing_rad = {c.beacons[told[0]].station_bearing_rad:g}: only for "
            f"station.scheme = 'station-paper'; {c.station.scheme!r} assumes no bearing"
        )
    elif told and len(told) < len(c.beacons):
        lacking = ", ".join(name for name in sorted(c.beacons) if name not in told)
        problems.append(f"beacons.ID.station_bearing_rad: for all beacons or none; not given for {lacking}")
    return problems


def schema() -> dict[str, Any]:
    """The JSON Schema of the configuration file."""
    return msgspec.json.schema(Config)


def flat(config: Config) -> dict[str, Any]:
    """Every effective value by its dotted key."""
    builtins = msgspec.to_builtins(config)
    return {key: _get(builtins, key.split(".")) for key in _leaves(builtins)}


def _read(path: Path) -> dict[str, Any]:
    try:
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise ConfigError(f"{path}: {error.strerror or error}") from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: not TOML: {error}") from error


def _value(text: str) -> Any:
    try:
        return tomllib.loads(f"v = {text}")["v"]
    except tomllib.TOMLDecodeError:
        return text


def _leaves(table: Mapping[str, Any], prefix: str = "") -> Iterable[str]:
    for key, value in table.items():
        if isinstance(value, dict) and value:
            yield from _leaves(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}"


def _get(raw: Any, keys: Iterable[str]) -> Any:
    for key in keys:
        raw = raw[int(key)] if isinstance(raw, list) else raw[key]
    return raw


def _put(raw: dict[str, Any], keys: list[str], value: Any, source: str) -> None:
    for depth, key in enumerate(keys[:-1], start=1):
        raw = raw.setdefault(key, {})
        if not isinstance(raw, dict):
            raise ConfigError(f"{source}: {'.'.join(keys[:depth])} is not a table")
    raw[keys[-1]] = value


def _match_case(raw: Mapping[str, Any], keys: list[str]) -> list[str]:
    """Environment names are upper case; keys are lower case unless the file spells them otherwise."""
    matched = []
    table: Any = raw
    for key in keys:
        known = table if isinstance(table, dict) else {}
        spelled = next((name for name in known if name.upper() == key.upper()), key.lower())
        matched.append(spelled)
        table = known.get(spelled)
    return matched


_PLACE = re.compile(r"^(?P<problem>.*?)(?: - at `(?:key in )?\$(?P<path>[^`]*)`)?$", re.DOTALL)
_STEP = re.compile(r"\[\.\.\.\]|[^.\[\]]+")
_UNKNOWN = re.compile(r"Object contains unknown field `(?P<field>[^`]*)`")


def _convert(raw: dict[str, Any], sources: Mapping[str, str]) -> Config:
    try:
        return msgspec.convert(raw, Config, strict=True)
    except msgspec.ValidationError as error:
        raise ConfigError(_explain(str(error), raw, sources)) from error


def _explain(message: str, raw: dict[str, Any], sources: Mapping[str, str]) -> str:
    """msgspec's message as one line: key = value: problem, what is allowed (source)."""
    place = _PLACE.match(message)
    assert place is not None
    problem = place["problem"]
    keys: list[str] = []
    kind: Any = inspect.type_info(Config)
    value: Any = raw
    for step in _STEP.findall(place["path"] or ""):
        kind = _bare(kind)
        if isinstance(kind, inspect.StructType):
            kind = next(f.type for f in kind.fields if f.encode_name == step)
        elif isinstance(kind, inspect.DictType):
            kind = kind.value_type
            step = next(key for key, entry in value.items() if not _is_valid(entry, kind))
        elif isinstance(kind, inspect.VarTupleType):
            kind = kind.item_type
        else:
            kind = kind.item_types[int(step)]
        keys.append(step)
        value = value[int(step)] if isinstance(value, list) else value[step]
    kind = _bare(kind)
    unknown = _UNKNOWN.match(problem)
    if unknown:
        keys.append(unknown["field"])
        allowed = [f.encode_name for f in kind.fields]
        near = difflib.get_close_matches(unknown["field"], allowed, n=1)
        hint = f"did you mean {near[0]}? " if near else ""
        problem = f"unknown key; {hint}allowed: {', '.join(allowed)}"
    elif isinstance(kind, inspect.LiteralType):
        problem = f"allowed: {', '.join(map(repr, kind.values))}"
    elif isinstance(kind, inspect.StrType) and "matching regex" in problem:
        problem = RULES.get(kind.pattern or "", problem)
    key = ".".join(keys)
    shown = "" if unknown or isinstance(value, dict) else f" = {value!r}"
    source = sources.get(key)
    return f"{key}{shown}: {problem}" + ("" if source is None else f" (from {source})")


def _bare(kind: Any) -> Any:
    """A type without its description."""
    return kind.type if isinstance(kind, inspect.Metadata) else kind


def _is_valid(entry: Any, kind: Any) -> bool:
    try:
        msgspec.convert(entry, _bare(kind).cls)
    except msgspec.ValidationError:
        return False
    return True
