"""What the README says is true: its commands run, its publisher publishes, its table is the code's."""

from __future__ import annotations

import os
import re
import shlex
import signal
import subprocess
import sys
import threading
from pathlib import Path

import pytest

from companion.exits import Exit
from companion.link.zenoh_ranges import RangeLink
from companion.network_settings import RangesSettings
from companion.operator import OperatorResult
from companion.range_message import RangeMessage
from companion.types import RangeSample
from companion.wire_range import decode
from tests.core.readme import README, with_figures, with_table
from tests.link.test_fly_process import free_port
from tests.record.flights import flown, in_file

ROOT = README.parent
TEXT = README.read_text(encoding="utf-8")
BOUND_S = 90.0


def blocks(language: str) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", TEXT, re.DOTALL)


def commands() -> list[str]:
    lines = [line.split("#")[0].strip() for block in blocks("sh") for line in block.splitlines()]
    return [line for line in lines if line]


RUN_BY_CI = {"make demo", "make test", "make lint", "make faults", "make bench-short", "pip install ."}


def run(arguments: list[str]) -> int:
    done = subprocess.run(
        [sys.executable, "-m", *arguments], cwd=ROOT, capture_output=True, text=True, timeout=BOUND_S
    )
    assert "Traceback" not in done.stderr
    return done.returncode


@pytest.mark.parametrize("command", [c for c in commands() if c not in RUN_BY_CI])
def test_every_command_runs(command: str, tmp_path: Path) -> None:
    words = shlex.split(command)
    words[0] = {"companion": "companion", "sitl-mock": "sitl_mock"}[words[0]]
    port = free_port()
    words = [f"udpin:127.0.0.1:{port}" if w.startswith(("serial:", "udpin:")) else w for w in words]
    if words[0] == "sitl_mock":
        start_and_stop(words)
    elif words[1] == "fly":
        words += ["--set", "loss.wait_s=1", "--record", str(tmp_path / "flight.mcap")]
        assert run(words) == Exit.NO_VEHICLE
    elif words[1] == "keys":
        words = [w.replace("lab-keys", str(tmp_path / "keys")) for w in words]
        if "--site" not in words:
            assert (
                run([*words[:2], str(tmp_path / "keys"), "--site", "lab", "--router", "127.0.0.1"]) == Exit.OK
            )
        assert run(words) == Exit.OK
    elif words[1] == "check":
        assert run([*words, "--patience", "1"]) == Exit.NOT_READY
    elif words[1] == "beacons":
        words = [w.replace("192.168.1.10", "127.0.0.1") for w in words]
        assert run([*words, "--seconds", "0.3"]) == Exit.NO_RANGES
    elif words[1] == "watch":
        words = [{"8080": "0"}.get(w, w.replace("192.168.1.10", "127.0.0.1")) for w in words]
        assert run([*words, "--seconds", "0.3"]) == Exit.NO_VEHICLE
    elif words[1] == "report":
        words = [str(tmp_path / Path(w).name) if w.startswith("flights/") else w for w in words]
        in_file(Path(words[2]), flown())
        assert run(words) == Exit.OK
    elif words[1] == "calibrate":
        for i, name in enumerate(words):
            if name.endswith((".jsonl", ".toml", ".png")):
                words[i] = str(tmp_path / name)
        for k, path in enumerate(w for w in words if w.endswith(".jsonl")):
            lines = [
                f'{{"beacon": "0x0001", "range_m": {5.3 + 15 * k + 0.01 * (n % 9)}}}\n' for n in range(40)
            ]
            Path(path).write_text("".join(lines))
        assert run(words) == Exit.OK
    elif words[1:3] == ["bench", "system"]:  # minutes; its parts have tests of their own
        assert run([*words[:3], "--only", "size"]) == Exit.OK
    elif words[1] == "operator":
        assert run([*words, "--timeout", "1"]) == OperatorResult.NO_VEHICLE.exit_status
    else:
        words = ["4" if w == "200" else w for w in words]
        words = [str(tmp_path) if words[i - 1] in ("--plots", "-o") else w for i, w in enumerate(words)]
        assert run(words) == Exit.OK


def start_and_stop(words: list[str]) -> None:
    words = [*words, "--zenoh-listen", "tcp/127.0.0.1:0"]
    with subprocess.Popen(
        [sys.executable, "-m", *words], cwd=ROOT, stdout=subprocess.PIPE, text=True
    ) as mock:
        assert mock.stdout is not None
        assert mock.stdout.readline().startswith("listening")
        mock.send_signal(signal.SIGTERM)
        assert mock.wait(BOUND_S) == 0


def test_the_publisher_publishes() -> None:
    (code,) = [block for block in blocks("python") if "zenoh" in block]
    port = free_port()
    code = code.replace(":7447", f":{port}")
    heard = threading.Event()
    with subprocess.Popen([sys.executable, "-c", code], env=dict(os.environ)) as publisher:
        link = RangeLink(RangesSettings(connect=(f"tcp/127.0.0.1:{port}",)), heard.set)
        try:
            assert heard.wait(20.0)
            (event, *_) = link.receive()
        finally:
            publisher.kill()
            link.close()
    assert isinstance(event, RangeSample)
    assert (event.beacon, event.range_m, event.sigma_m) == ("b1", 7.5, 0.07)


def test_the_publisher_in_c_writes_ranges() -> None:
    (code,) = blocks("c")
    found = re.search(r'snprintf\(text, sizeof text, "(.*?)", name, seq, measured_m', code)
    assert found is not None
    text = found[1].replace('\\"', '"') % (0xBEEF, 7, 5.0625)
    assert len(text) < 128
    assert decode(text.encode(), "application/json") == RangeMessage("0000beef", 7, 5.062)


def test_the_configuration_table_is_the_codes() -> None:
    assert with_table(TEXT) == TEXT, "python -m tests.core.readme"


def test_the_figures_are_those_that_were_measured() -> None:
    assert with_figures(TEXT) == TEXT, "python -m tests.core.readme"


def test_no_equation_is_lost() -> None:
    tagged = "\n".join(path.read_text(encoding="utf-8") for path in (ROOT / "companion").rglob("*.py"))
    missing = [n for n in range(1, 34) if n != 2 and f"Eq. ({n})" not in tagged]
    assert not missing
