"""Fewer points that look the same: a page of a long flight must still open at once."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

LINE_POINTS = 3000
"""Points of a line at most, about two for each pixel of a wide window."""
MARKS = 4000
"""Single marks of a plot at most."""

Line = tuple[list[float], list[float | None]]
"""Times, s, and values; None breaks the line."""


def line(points: Sequence[tuple[float, float]], gap_s: float, limit: int = LINE_POINTS) -> Line:
    """The line through these points, broken where nothing came for longer than `gap_s`.

    Where there are more than `limit`, every bucket keeps its least and its greatest value: no peak is lost.
    """
    size = max(1, -(-2 * len(points) // limit)) if len(points) > limit else 1
    times: list[float] = []
    values: list[float | None] = []
    for run in _runs(points, gap_s):
        if times:
            times.append(times[-1])
            values.append(None)
        for t_s, value in _extremes(run, size):
            times.append(round(t_s, 3))
            values.append(round(value, 4))
    return times, values


def _runs(points: Sequence[tuple[float, float]], gap_s: float) -> Iterator[Sequence[tuple[float, float]]]:
    begin = 0
    for i in range(1, len(points)):
        if points[i][0] - points[i - 1][0] > gap_s:
            yield points[begin:i]
            begin = i
    if points:
        yield points[begin:]


def _extremes(run: Sequence[tuple[float, float]], size: int) -> Iterator[tuple[float, float]]:
    if size <= 2:
        yield from run
        return
    yield run[0]
    for begin in range(1, len(run) - 1, size):
        bucket = run[begin : min(begin + size, len(run) - 1)]
        low = min(bucket, key=lambda point: point[1])
        high = max(bucket, key=lambda point: point[1])
        yield from sorted({low, high})
    if len(run) > 1:
        yield run[-1]


def stride(count: int, limit: int) -> int:
    """Every how manieth of so many is kept, so that no more than `limit` are left."""
    return max(1, -(-count // limit))


def peaks(points: Sequence[tuple[float, float]], limit: int) -> list[tuple[float, float]]:
    """These points, or where they are too many the greatest of every few."""
    size = stride(len(points), limit)
    return [max(points[i : i + size], key=lambda point: point[1]) for i in range(0, len(points), size)]
