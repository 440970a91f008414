"""A headless Chromium for tests of pages: opened once a session, driven by the DevTools protocol.

The protocol's pipe is used (`--remote-debugging-pipe`: JSON ended by a zero byte), so there is no port and no
WebSocket. The fixture `browser` comes with `tests/people/conftest.py`.
"""

from __future__ import annotations

import base64
import os
import select
import shutil
import subprocess
import time
from collections import deque
from collections.abc import Iterator
from pathlib import Path
from types import TracebackType
from typing import Literal, TypeVar

import msgspec
import pytest

Json = None | bool | int | float | str | list["Json"] | dict[str, "Json"]
T = TypeVar("T")

BOUND_S = 60.0
"""Anything that takes longer has failed."""
REQUIRED = "COMPANION_REQUIRE_CHROMIUM"
"""Set to 1 (as `.ci/run` does) it makes a missing Chromium a failure, elsewhere the tests are skipped."""
_ARGUMENTS = (
    "--headless", "--no-sandbox", "--disable-gpu", "--disable-background-networking", "--no-first-run",
    "--disable-extensions", "--disable-component-update", "--disable-dev-shm-usage", "--hide-scrollbars",
    "--remote-debugging-pipe",
)  # fmt: skip


class BrowserError(Exception):
    """Chromium has ended, did not answer in time, or the script that it was given threw."""


class _Reply(msgspec.Struct):
    """A message from Chromium: the answer to the call `id`, or an event called `method`."""

    id: int | None = None
    method: str = ""
    params: dict[str, object] = {}
    result: dict[str, object] = {}
    error: dict[str, object] | None = None
    session: str | None = msgspec.field(default=None, name="sessionId")


class Browser:
    """One Chromium process. `open` gives a page of its own."""

    def __init__(self, executable: str, profile: Path) -> None:
        # The shell puts the two ends of the pipe where Chromium expects them: it reads 3 and writes 4.
        plumbing = 'exec "$@" 3<&0 4>&1 </dev/null >/dev/null 2>&1'
        self._process = subprocess.Popen(
            ["sh", "-c", plumbing, "sh", executable, *_ARGUMENTS, f"--user-data-dir={profile}"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
        )
        self._decode = msgspec.json.Decoder(_Reply).decode
        self._rest = b""
        self._arrived: deque[bytes] = deque()
        self._calls = 0
        self._pages: dict[str, Page] = {}

    def __enter__(self) -> Browser:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def open(self, url: str, width: int = 1280, height: int = 900) -> Page:
        """A new page with this inner size, loaded. What it complains of is in its `errors`."""
        made = self.call("Target.createTarget", url="about:blank")
        target = str(made["targetId"])
        session = str(self.call("Target.attachToTarget", targetId=target, flatten=True)["sessionId"])
        page = self._pages[session] = Page(self, session, target)
        for domain in ("Page", "Runtime", "Log", "Network"):
            page.call(f"{domain}.enable")
        page.resize(width, height)
        page.go(url)
        return page

    def call(self, method: str, session: str | None = None, **params: Json) -> dict[str, object]:
        """One call of the DevTools protocol. Raises BrowserError where it is refused or not answered."""
        self._calls += 1
        number = self._calls
        message = {"id": number, "method": method, "params": params}
        if session is not None:
            message["sessionId"] = session
        assert self._process.stdin is not None
        self._process.stdin.write(msgspec.json.encode(message) + b"\0")
        self._process.stdin.flush()
        deadline = time.monotonic() + BOUND_S
        while True:
            reply = self._next(deadline, method)
            if reply.id == number:
                if reply.error is not None:
                    raise BrowserError(f"{method}: {reply.error.get('message')}")
                return reply.result
            self._take(reply)

    def wait(self, deadline: float, what: str) -> None:
        """Take in the next event, of any page."""
        self._take(self._next(deadline, what))

    def close(self) -> None:
        """End it, as asked or by force."""
        assert self._process.stdin is not None and self._process.stdout is not None
        self._process.stdin.close()  # the end of the pipe is the end of Chromium
        try:
            self._process.wait(5.0)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self._process.stdout.close()

    def _take(self, event: _Reply) -> None:
        page = self._pages.get(event.session or "")
        if page is not None:
            page.take(event.method, event.params)

    def _next(self, deadline: float, what: str) -> _Reply:
        assert self._process.stdout is not None
        while not self._arrived:
            left_s = deadline - time.monotonic()
            if left_s <= 0.0 or not select.select([self._process.stdout], [], [], left_s)[0]:
                raise BrowserError(f"{what}: no answer within {BOUND_S:.0f} s")
            data = os.read(self._process.stdout.fileno(), 1 << 20)
            if not data:
                raise BrowserError(f"{what}: Chromium has ended")
            *whole, self._rest = (self._rest + data).split(b"\0")
            self._arrived.extend(whole)
        return self._decode(self._arrived.popleft())


class Page:
    """A page. `errors`: errors on its console, uncaught exceptions and failed loads; `asked`: every URL that
    it asked for, its own included."""

    def __init__(self, browser: Browser, session: str, target: str) -> None:
        self.errors: list[str] = []
        self.asked: list[str] = []
        self._browser = browser
        self._session = session
        self._target = target
        self._loads = 0

    def call(self, method: str, **params: Json) -> dict[str, object]:
        """One call of the DevTools protocol, for this page."""
        return self._browser.call(method, self._session, **params)

    def go(self, url: str) -> None:
        """Load this URL and wait for its `load` event."""
        loads = self._loads
        told = self.call("Page.navigate", url=url)
        if "errorText" in told:
            raise BrowserError(f"{url}: {told['errorText']}")
        deadline = time.monotonic() + BOUND_S
        while self._loads == loads:
            self._browser.wait(deadline, f"load of {url}")

    def resize(self, width: int, height: int) -> None:
        """Give the window another inner size, in CSS pixels."""
        size: dict[str, Json] = {"width": width, "height": height}
        self.call("Emulation.setDeviceMetricsOverride", **size, deviceScaleFactor=1, mobile=False)

    def evaluate(self, script: str, kind: type[T]) -> T:
        """The value of a JavaScript expression (of its promise, if it is one), which must be of this type.

        Raises BrowserError where it throws, msgspec.ValidationError where it is of another type.
        """
        told = self.call("Runtime.evaluate", expression=script, returnByValue=True, awaitPromise=True)
        thrown = told.get("exceptionDetails")
        if thrown is not None:
            raise BrowserError(_thrown(thrown))
        result = msgspec.convert(told["result"], dict[str, object])
        return msgspec.convert(result.get("value"), kind)

    def wait_for(self, script: str, bound_s: float = 0.8 * BOUND_S) -> None:
        """Wait until this JavaScript expression is true, looked at once a frame. Raises BrowserError."""
        waiting = (
            f"new Promise((done, fail) => {{ const end = performance.now() + {bound_s * 1e3:.0f};"
            f"const look = () => ({script}) ? done(true) : performance.now() > end"
            " ? fail(new Error('waited in vain')) : requestAnimationFrame(look); look(); })"
        )
        self.evaluate(waiting, bool)

    def settle(self) -> None:
        """Wait until what was done so far has been painted: two frames."""
        self.evaluate(
            "new Promise(r => requestAnimationFrame(() => requestAnimationFrame(() => r(true))))", bool
        )

    def move(self, x: float, y: float) -> None:
        """Move the mouse there, in CSS pixels of the window."""
        self._mouse("mouseMoved", x, y)

    def wheel(self, x: float, y: float, dy: float) -> None:
        """Turn the wheel there; dy > 0 is towards the person (scrolls down, zooms out)."""
        self.call("Input.dispatchMouseEvent", type="mouseWheel", x=x, y=y, deltaX=0, deltaY=dy)

    def click(self, x: float, y: float) -> None:
        """Press and release the left button there."""
        self.drag((x, y), (x, y))

    def drag(self, start: tuple[float, float], end: tuple[float, float]) -> None:
        """Press the left button at one place, move to another in steps, release."""
        self._mouse("mouseMoved", *start)
        self._mouse("mousePressed", *start)
        for i in range(1, 6):
            share = i / 5
            x, y = (a + share * (b - a) for a, b in zip(start, end, strict=True))
            self._mouse("mouseMoved", x, y, held=True)
        self._mouse("mouseReleased", *end)

    def _mouse(
        self,
        kind: Literal["mouseMoved", "mousePressed", "mouseReleased"],
        x: float,
        y: float,
        held: bool = False,
    ) -> None:
        pressing = kind != "mouseMoved"
        self.call(
            "Input.dispatchMouseEvent", type=kind, x=x, y=y, button="left" if pressing or held else "none",
            buttons=int(held or kind == "mousePressed"), clickCount=int(pressing),
        )  # fmt: skip

    def screenshot(self, path: Path | None = None, whole: bool = False) -> bytes:
        """What is seen as PNG, or the whole length of the page; written to `path` too."""
        told = self.call("Page.captureScreenshot", format="png", captureBeyondViewport=whole)
        data = base64.b64decode(str(told["data"]))
        if path is not None:
            path.write_bytes(data)
        return data

    def close(self) -> None:
        """Close the page."""
        self._browser.call("Target.closeTarget", targetId=self._target)

    def take(self, method: str, params: dict[str, object]) -> None:
        """Take in an event of this page."""
        if method == "Page.loadEventFired":
            self._loads += 1
        elif method == "Runtime.exceptionThrown":
            self.errors.append(_thrown(params.get("exceptionDetails")))
        elif method == "Runtime.consoleAPICalled" and params.get("type") in ("error", "assert"):
            values = msgspec.convert(params.get("args", []), list[dict[str, object]])
            self.errors.append(" ".join(str(v.get("value", v.get("description", ""))) for v in values))
        elif method == "Log.entryAdded":
            entry = msgspec.convert(params["entry"], dict[str, object])
            if entry.get("level") == "error":
                self.errors.append(f"{entry.get('text')} {entry.get('url', '')}")
        elif method == "Network.requestWillBeSent":
            self.asked.append(str(msgspec.convert(params["request"], dict[str, object])["url"]))


def _thrown(details: object) -> str:
    told = msgspec.convert(details, dict[str, object])
    exception = msgspec.convert(told.get("exception", {}), dict[str, object])
    return str(exception.get("description") or exception.get("value") or told.get("text"))


def executable() -> str | None:
    """Debian's Chromium, or another one on the path."""
    return shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")


@pytest.fixture(scope="session")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    """A Chromium for the whole session; skips, or fails where `REQUIRED` says so, if there is none."""
    found = executable()
    if found is None:
        missing = "there is no chromium on the path: apt-get install chromium"
        if os.environ.get(REQUIRED) == "1":
            pytest.fail(missing)
        pytest.skip(missing)
    with Browser(found, tmp_path_factory.mktemp("chromium")) as running:
        yield running
