"""Replaying: the same is found the same, the first difference is shown with its event, changes are shown."""

from __future__ import annotations

import math
from collections.abc import Callable
from itertools import count
from pathlib import Path
from typing import Any

import msgspec
import pytest

from companion.config import Config
from companion.recording import Recording, read
from companion.replay import ReplayResult, replay
from companion.settings import LimitSettings, Settings
from companion.types import Event, Output, Phase, PhaseChange, Setpoint, Status
from tests.record.flights import NEAR, Item, as_bytes, flown, start

ITEMS = flown()


def recording_of(directory: Path, numbered: list[tuple[int, Item]], **begin: Any) -> Recording:
    path = directory / "f.mcap"
    path.write_bytes(as_bytes(numbered, msgspec.structs.replace(start(), **begin)))
    return read(path)


def nth(kind: type, n: int) -> int:
    """Where in the flight the n-th of a kind is."""
    return [i for i, item in enumerate(ITEMS) if type(item) is kind][n]


def changed(directory: Path, at: int, change: Callable[[Any], Item]) -> ReplayResult:
    items = [*ITEMS[:at], change(ITEMS[at]), *ITEMS[at + 1 :]]
    return replay(recording_of(directory, list(enumerate(items))))


def with_settings(**tables: dict[str, Any]) -> Config:
    raw = msgspec.to_builtins(Config(sim=NEAR))
    for table, values in tables.items():
        raw[table] |= values
    return msgspec.convert(raw, Config)


def test_the_same_flight_is_the_same(tmp_path: Path) -> None:
    result = replay(recording_of(tmp_path, list(enumerate(ITEMS))))
    outputs = sum(isinstance(item, Output) for item in ITEMS)
    assert result.equal and result.deviation == 0.0 and result.first is None and not result.setpoints
    assert (result.outputs, result.compared) == (outputs, outputs)
    assert result.phases and all(row.recorded == row.replayed for row in result.phases)
    assert result.text().splitlines()[-1] == f"the same, bit for bit: {outputs} outputs"


def test_whole_numbers_in_float_fields_are_no_difference(tmp_path: Path) -> None:
    at = next(i for i, item in enumerate(ITEMS) if isinstance(item, Setpoint) and item.speed_m_s == 0.0)
    assert changed(tmp_path, at, lambda s: msgspec.structs.replace(s, speed_m_s=0)).equal
    whole = Config(limits=LimitSettings(speed_m_s=1, yaw_rate_rad_s=1, climb_m_s=1))
    same = Config(limits=LimitSettings(speed_m_s=1.0, yaw_rate_rad_s=1.0, climb_m_s=1.0))
    recording = recording_of(tmp_path, list(enumerate(ITEMS)))
    assert replay(recording, whole).differing == replay(recording, same).differing


def test_one_bit_in_one_setpoint_is_found_and_shown_with_its_event(tmp_path: Path) -> None:
    at = nth(Setpoint, 100)
    result = changed(
        tmp_path,
        at,
        lambda s: msgspec.structs.replace(s, yaw_rate_rad_s=math.nextafter(s.yaw_rate_rad_s, math.inf)),
    )
    assert not result.equal and result.differing == 1 and 0.0 < result.deviation < 1e-15
    assert result.first is not None
    cause = max(i for i in range(at) if isinstance(ITEMS[i], Event))
    assert (result.first.number, result.first.event) == (cause, ITEMS[cause])
    (field,) = result.first.fields
    assert field.startswith("setpoint.yaw_rate_rad_s: ") and " → " in field
    text = result.text()
    assert "other numbers only" in text and field in text
    assert msgspec.json.encode(result.first.event).decode() in text


def test_minus_zero_is_not_zero(tmp_path: Path) -> None:
    at = next(i for i, item in enumerate(ITEMS) if isinstance(item, Setpoint) and item.speed_m_s == 0.0)
    assert changed(tmp_path, at, lambda s: msgspec.structs.replace(s, speed_m_s=-0.0)).differing == 1


def test_another_reason_is_a_difference_that_is_not_only_of_numbers(tmp_path: Path) -> None:
    result = changed(tmp_path, nth(PhaseChange, 1), lambda c: msgspec.structs.replace(c, reason="because"))
    assert result.deviation == math.inf and result.differing == 1
    assert "  * " in result.text() and "phase_change.reason: 'because' → " in result.text()


def renumbered(items: list[Item]) -> list[tuple[int, Item]]:
    return list(zip(count(), items, strict=False))


def test_an_output_too_many_or_too_few_is_a_difference(tmp_path: Path) -> None:
    at = nth(Setpoint, 50)
    fewer = replay(recording_of(tmp_path, renumbered([*ITEMS[:at], *ITEMS[at + 1 :]])))
    assert fewer.differing == 1 and fewer.first is not None
    assert any(field.startswith("setpoint: nothing → {") for field in fewer.first.fields)
    more = replay(recording_of(tmp_path, renumbered([*ITEMS[: at + 1], ITEMS[at], *ITEMS[at + 1 :]])))
    assert more.differing == 1


def test_a_record_that_goes_on_after_the_end_is_told(tmp_path: Path) -> None:
    tail = [msgspec.structs.replace(item, t_ns=item.t_ns + 10**9) for item in ITEMS[:50]]
    assert isinstance(ITEMS[-1], Status) and ITEMS[-1].phase is Phase.ENDED
    result = replay(recording_of(tmp_path, renumbered([*ITEMS, *tail])))
    assert result.stopped == "the replayed flight was over, the recorded one went on"


# ---------------------------------------------------------------------------------------------- losses


def without(*numbers: int) -> list[tuple[int, Item]]:
    return [(i, item) for i, item in enumerate(ITEMS) if i not in numbers]


def test_lost_outputs_hide_nothing_else(tmp_path: Path) -> None:
    lost = [nth(Setpoint, n) for n in (10, 11, 12, 80)] + [nth(Status, 3)]
    recording = recording_of(tmp_path, without(*lost))
    result = replay(recording)
    assert recording.lost == len(lost) and "5 records are missing" in result.problems
    assert result.equal and result.stopped is None
    assert result.compared == sum(isinstance(item, Output) for item in ITEMS) - len(lost)


def test_a_lost_event_ends_the_comparison(tmp_path: Path) -> None:
    at = max(i for i in range(nth(Setpoint, 100)) if isinstance(ITEMS[i], Event))
    result = replay(recording_of(tmp_path, without(at)))
    assert result.equal and result.stopped is not None and result.stopped.endswith("the record lacks events")
    assert 0 < result.compared < result.outputs
    assert "not compared to the end: from " in result.text()


def test_a_lost_beginning_leaves_nothing_to_compare(tmp_path: Path) -> None:
    result = replay(recording_of(tmp_path, list(enumerate(ITEMS))[300:]))
    assert result.compared == 0 and result.stopped == "the record lacks its beginning"


# --------------------------------------------------------------------------------------------- changes


def test_changed_settings_show_what_would_have_been_commanded(tmp_path: Path) -> None:
    slower = with_settings(guidance={"speed_m_s": 0.3})
    result = replay(recording_of(tmp_path, list(enumerate(ITEMS))), slower)
    recorded = Config().guidance.speed_m_s
    assert result.changed == {"guidance.speed_m_s": (recorded, 0.3)}
    assert not result.equal and result.setpoints
    assert pytest.approx(recorded - 0.3) in [row.speed_off_m_s for row in result.setpoints]
    text = result.text()
    assert f"setting: guidance.speed_m_s = {recorded} → 0.3" in text
    assert "setpoints where they differ" in text


def test_changed_phases_stand_side_by_side(tmp_path: Path) -> None:
    wide = with_settings(guidance={"capture_radius_m": 2.0})
    result = replay(recording_of(tmp_path, list(enumerate(ITEMS))), wide)
    holds = [
        row for row in result.phases if Phase.HOLD in {p.after for p in (row.recorded, row.replayed) if p}
    ]
    times = [(row.recorded, row.replayed) for row in holds]
    assert any(now is not None and (was is None or now.t_s < was.t_s) for was, now in times), (
        "captured earlier"
    )
    assert "phases (* where they differ), s:" in result.text()


def test_settings_that_change_nothing_change_nothing(tmp_path: Path) -> None:
    patient = with_settings(loss={"wait_s": 1000.0})
    result = replay(recording_of(tmp_path, list(enumerate(ITEMS))), patient)
    assert result.equal and result.changed == {"loss.wait_s": (Settings().loss.wait_s, 1000.0)}


def test_another_version_is_told(tmp_path: Path) -> None:
    older = {**start().versions, "companion": "0.0.9", "source": "0" * 16, "extinct": "1.0"}
    result = replay(recording_of(tmp_path, list(enumerate(ITEMS)), versions=older))
    assert result.equal
    assert result.versions.keys() == {"companion", "source", "extinct"}
    assert (
        "version: companion 0.0.9 then, " in result.text()
        and "version: extinct 1.0 then, none now" in result.text()
    )


def test_the_result_is_json_too(tmp_path: Path) -> None:
    at = nth(PhaseChange, 1)
    result = changed(tmp_path, at, lambda c: msgspec.structs.replace(c, reason="because"))
    plain = msgspec.json.decode(msgspec.json.encode(result))
    assert plain["differing"] == 1 and plain["deviation"] is None
    assert plain["first"]["recorded"][0]["reason"] == "because"
    assert plain["first"]["event"]["t_ns"] == ITEMS[plain["first"]["number"]].t_ns
