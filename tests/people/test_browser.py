"""The browser that tests of pages look through sees what a person would see."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.people.browser import Browser, BrowserError

PAGE = """<!doctype html><title>a page</title><body style="margin:0; background: #ff0000">
<div id=box style="width:100px; height:50px; background: #00ff00"></div>
<script>
var seen = []; box.onmousemove = () => seen.push("over"); box.onclick = () => seen.push("click");
onwheel = e => seen.push(e.deltaY > 0 ? "out" : "in");
console.error("as said", 7); console.log("not told");
setTimeout(() => { throw new Error("thrown later") }, 1);
</script><img src="missing.png">"""


def test_a_page_is_opened_watched_and_worked(browser: Browser, tmp_path: Path) -> None:
    path = tmp_path / "page.html"
    path.write_text(PAGE, encoding="utf-8")
    page = browser.open(path.as_uri(), width=400, height=300)
    assert page.evaluate("document.title", str) == "a page"
    assert page.evaluate("[innerWidth, innerHeight]", list[int]) == [400, 300]
    page.move(10.0, 10.0)
    page.click(20.0, 20.0)
    page.wheel(20.0, 20.0, -120.0)
    page.wait_for("seen.includes('in')")
    assert set(page.evaluate("seen", list[str])) == {"over", "click", "in"}
    told = "\n".join(page.errors)
    assert "as said 7" in told and "thrown later" in told and "missing.png" in told
    assert "not told" not in told
    assert [url.rpartition("/")[2] for url in page.asked] == ["page.html", "missing.png"]
    assert page.screenshot(tmp_path / "seen.png").startswith(b"\x89PNG")
    with pytest.raises(BrowserError, match="nowhere is not defined"):
        page.evaluate("nowhere", str)
    with pytest.raises(BrowserError, match="in vain"):
        page.wait_for("false", bound_s=0.1)
    page.close()
