"""The page: one HTML file with everything in it, which asks no network for anything.

Map and plots are drawn by Plotly's JavaScript, which the Python package `plotly` carries
(`companion[report]`); nothing else of it is used. Headline, figures, story and tables are plain HTML.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from html import escape
from importlib import resources
from pathlib import Path
from string import Template

import msgspec

from companion.picture import PHASE_COLOURS, Truth
from companion.recording import Recording
from companion.report import flight as figures_of
from companion.report import series as series_of
from companion.report.flight import Figures, Flight
from companion.report.series import Series
from companion.types import Phase

_SCRIPTS = ("page.js", "map.js", "plots.js", "cursor.js")


class PageError(Exception):
    """The page cannot be made; the text says why and what to do."""


class _Data(msgspec.Struct, frozen=True):
    """What the page's script reads."""

    figures: Figures
    series: Series
    colours: dict[str, str]
    engaged: list[str]


def write(path: Path, recording: Recording, truth: Truth | None = None) -> Flight:
    """Write the page of a flight and return what it tells; `truth` is what a simulation knows besides.

    Raises PageError where Plotly is missing, RecordError where the recorded configuration cannot be
    understood, OSError where the file cannot be written.
    """
    plotly = _plotly()
    flight = figures_of.of(recording)
    path.write_text(html(flight, series_of.of(recording, flight, truth), plotly), encoding="utf-8")
    return flight


def _plotly() -> str:
    try:
        return (resources.files("plotly") / "package_data" / "plotly.min.js").read_text(encoding="utf-8")
    except (ImportError, FileNotFoundError) as error:
        raise PageError(f"Plotly is missing ({error}): pip install 'companion[report]'") from error


def html(flight: Flight, series: Series, plotly: str) -> str:
    """The page's text. All that was heard from outside is escaped."""
    f = flight.figures
    here, theme = resources.files("companion.report"), resources.files("companion") / "theme.css"
    colours = {phase.value: colour for phase, colour in PHASE_COLOURS.items()}
    engaged = [phase.value for phase in Phase if phase.is_engaged]
    data = msgspec.json.encode(_Data(f, series, colours, engaged)).decode()
    thinned = (
        f"Thinned to be quick: {', '.join(series.thinned)}; the figures count all." if series.thinned else ""
    )
    return Template((here / "page.html").read_text(encoding="utf-8")).substitute(
        title=escape(f"{f.headline} · {Path(f.file).name}"),
        css="".join(sheet.read_text(encoding="utf-8") for sheet in (theme, here / "page.css")),
        verdict="captured" if f.summary.captured else "missed",
        what=escape(f"{f.kind} of {f.began_at} · {f.file} · {f.duration_s:.0f} s recorded"),
        headline=escape(f.headline),
        problems=_problems(f.problems),
        tiles="".join(f"<div><dt>{name}</dt><dd>{value}</dd></div>\n" for name, value in _tiles(f)),
        thinned=escape(thinned),
        tables=_tables(f),
        data=data.replace("<", "\\u003c"),  # so that no text in it can end the script element
        plotly=plotly.replace("</script", "<\\/script"),
        script="\n".join((here / name).read_text(encoding="utf-8") for name in _SCRIPTS),
    )


def _problems(problems: tuple[str, ...]) -> str:
    if not problems:
        return ""
    first = "<li><b>The record is not whole; this is what could be read.</b></li>"
    lines = "".join(f"<li>{escape(problem)}</li>" for problem in problems)
    return f'<ul class="problems">{first}{lines}</ul>\n'


def _tiles(f: Figures) -> Iterator[tuple[str, str]]:
    s = f.summary
    if s.time_s is not None:
        yield "time to rest" if s.captured else "time engaged", f"{s.time_s:.1f} <small>s</small>"
    if s.path_m is not None:
        shortest = (
            f" <small>m, shortest {s.shortest_m:.2f}</small>"
            if s.shortest_m is not None
            else " <small>m</small>"
        )
        yield "path flown", f"{s.path_m:.2f}{shortest}"
    if s.path_ratio is not None and s.captured:
        yield "path ÷ shortest", f"{s.path_ratio:.3f}"
    if s.final_distance_m is not None and s.final_distance_sigma_m is not None:
        sigma = f"<small>± {s.final_distance_sigma_m:.2f} m</small>"
        yield "distance at the end", f"{s.final_distance_m:.2f} {sigma}"
    refused = sum(s.rejected.values())
    yield "ranges believed", f"{s.ranges_accepted} <small>{refused} refused</small>"
    if f.setpoint_latency is not None:
        yield "range → setpoint, p95", f"{f.setpoint_latency.p95_s * 1e3:.2f} <small>ms</small>"


# --------------------------------------------------------------------------------------------- tables


def _tables(f: Figures) -> str:
    return "".join((_story(f), _summary(f), _beacons(f), _latencies(f), _settings(f), _versions(f)))


def _table(title: str, head: Iterable[str], rows: Iterable[str], scroll: bool = False) -> str:
    """A card with a table; empty where there are no rows. `head` and `rows` are HTML."""
    body = "".join(rows)
    if not body:
        return ""
    cells = "".join(head)
    table = f"<table>{f'<tr>{cells}</tr>' if cells else ''}{body}</table>"
    inner = f'<div class="scroll">{table}</div>' if scroll else table
    return f'<section class="card"><h2>{title}</h2>{inner}</section>\n'


def _row(*cells: str, number: bool = False) -> str:
    first, *others = (escape(cell) for cell in cells)
    td = '<td class="n">' if number else "<td>"
    return f"<tr><th>{first}</th>{''.join(f'{td}{cell}</td>' for cell in others)}</tr>"


def _story(f: Figures) -> str:
    rows = (
        f'<tr data-t="{h.t_s:.3f}" class="s{int(h.severity)}"><td class="n">{h.t_s:.2f}</td>'
        f'<td class="by">{escape(h.source)}</td><td>{escape(h.text)}</td></tr>'
        for h in f.story
    )
    title = 'What happened <span class="hint">click a line: the cursor goes there</span>'
    return _table(title, ('<th class="n">s</th>', "<th>by</th>", "<th></th>"), rows, True)


def _summary(f: Figures) -> str:
    s = f.summary
    aim, done = ("station", "reached") if s.kind == "station" else ("target", "captured")

    def figure(value: float | None, unit: str, digits: int = 2) -> str:
        return "–" if value is None else f"{value:.{digits}f} {unit}"

    rows = [
        _row(f"{done}, by what it knew", "yes" if s.captured else "no"),
        _row("ending", f.ending),
        _row("time", figure(s.time_s, "s", 1)),
        _row("path flown", figure(s.path_m, "m")),
        _row("shortest path, with the turn bound", figure(s.shortest_m, "m")),
        _row("path ÷ shortest", figure(s.path_ratio if s.captured else None, "", 3)),
        _row("extra path", figure(s.extra_path_m if s.captured else None, "m")),
        _row(
            "distance at the end, estimated",
            figure(s.final_distance_m, f"m ± {s.final_distance_sigma_m or 0.0:.2f}"),
        ),
        _row("last range (slant)", figure(s.final_range_m, "m")),
        _row(f"{aim}, East / North", f"{figure(s.target_x_m, 'm')} / {figure(s.target_y_m, 'm')}"),
        _row(f"{done} within", figure(f.problem.radius_m, "m")),
        _row("ranges believed", str(s.ranges_accepted)),
        *(_row(f"refused: {reason}", str(n)) for reason, n in sorted(s.rejected.items()) if n),
        *(_row(f"malformed: {reason}", str(n)) for reason, n in sorted(s.malformed.items()) if n),
    ]
    return _table("Summary", (), rows)


def _beacons(f: Figures) -> str:
    rows = (
        _row(
            b.beacon,
            str(b.ranges),
            "–" if b.rate_hz is None else f"{b.rate_hz:.1f} Hz",
            ", ".join(f"{fate} {n}" for fate, n in b.verdicts.items()),
        )
        for b in f.beacons
    )
    return _table(
        "Beacons heard", ("<th>id</th>", "<th>ranges</th>", "<th>mean rate</th>", "<th>verdicts</th>"), rows
    )


def _latencies(f: Figures) -> str:
    names = ("median", "p95", "p99", "longest", "count")
    rows = []
    for name, of in (
        ("range → setpoint handed over", f.setpoint_latency),
        ("transport, beyond the quickest", f.transport),
    ):
        if of is not None:
            values = (f"{v * 1e3:.2f}" for v in (of.median_s, of.p95_s, of.p99_s, of.longest_s))
            rows.append(_row(name, *values, str(of.count), number=True))
    return _table("Latency, ms", ("<th></th>", *(f'<th class="n">{name}</th>' for name in names)), rows)


def _settings(f: Figures) -> str:
    rows = [_row(key, value, source) for key, (value, source) in f.settings.items()]
    return _table(f"Settings not at their defaults (digest {escape(f.digest)})", (), rows, True)


def _versions(f: Figures) -> str:
    return _table("Versions", (), [_row(name, version) for name, version in f.versions.items()])
