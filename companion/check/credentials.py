"""The certificate that the vehicle shows on Zenoh: whose it is, and for how long."""

from __future__ import annotations

from collections.abc import Iterator
from datetime import UTC, datetime, timedelta
from pathlib import Path

from companion.check.report import Part, Row, State
from companion.link.credentials import CredentialsError, read
from companion.settings import Settings

_SOON = timedelta(days=30)


def judge(settings: Settings) -> Iterator[Row]:
    """Rows about `ranges.tls`; none where it is not used."""
    if not settings.ranges.tls:
        return
    try:
        c = read(Path(settings.ranges.tls))
    except CredentialsError as error:
        yield Row(
            Part.RANGES, "certificate", State.FAIL, str(error), "The router would refuse the connection."
        )
        return
    left = c.until - datetime.now(UTC)
    found = f"{c.name}, until {c.until:%Y-%m-%d}, {left.days} days"
    if left < _SOON:
        why = "When it has ended nobody lets it in."
        yield Row(Part.RANGES, "certificate", State.WARN, found, why, f"companion keys DIR --renew {c.name}")
    else:
        yield Row(Part.RANGES, "certificate", State.OK, found)
    role, _, name = c.name.partition("/")
    if role != "vehicle":
        why = "The router's rules go by the certificate: only a vehicle may write its status."
        yield Row(Part.RANGES, "certificate", State.WARN, f"is no vehicle's but {c.name}", why)
    elif name != settings.status.uav and settings.status.rate_hz > 0.0:
        yield Row(
            Part.RANGES,
            "certificate",
            State.WARN,
            f"is {c.name}, but status.uav = {settings.status.uav!r}",
            "The router drops the status in silence: the key is not this certificate's own.",
            f'set status.uav = "{name}"',
        )
