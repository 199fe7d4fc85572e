"""A real browser without a window, which loads a page from its file and tells what the page says in its console."""

from __future__ import annotations

import json
import os
import select
import shutil
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from subprocess import DEVNULL, Popen
from tempfile import TemporaryDirectory
from typing import Any

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome", "chrome"))), "")
"""Command of the browser; empty where none is installed."""
_OPTIONS = (
    "--headless=new", "--no-sandbox", "--remote-debugging-pipe", "--no-first-run", "--disable-dev-shm-usage",
    "--use-angle=swiftshader", "--enable-unsafe-swiftshader",  # WebGL 2 without a graphics card
    "--disable-background-networking", "--window-size=1500,1000",
)  # fmt: skip
_LIMIT_S = 120.0


class Tab:
    """A page in the browser; commands and events of the DevTools protocol go through two pipes."""

    def __init__(self, to: int, back: int) -> None:
        self._to, self._back, self._rest, self._number, self._session = to, back, b"", 0, ""
        self.said: list[str] = []
        """What the console holds: violations of the policy, failed loads, exceptions, and what scripts write."""
        self.loaded = False
        target = self.call("Target.createTarget", url="about:blank")["targetId"]
        self._session = self.call("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]
        for domain in ("Page", "Runtime", "Log"):
            self.call(f"{domain}.enable")

    def open(self, page: Path) -> None:
        """Load a page from its file."""
        self.loaded, self.said = False, []
        self.call("Page.navigate", url=page.absolute().as_uri())
        ends = time.monotonic() + _LIMIT_S
        while not self.loaded:
            self._heed(self._message(ends))

    def value(self, script: str) -> Any:
        """The value of an expression in the page, awaited where it is a promise."""
        answer = self.call("Runtime.evaluate", expression=script, awaitPromise=True, returnByValue=True)
        assert "exceptionDetails" not in answer, answer
        return answer["result"].get("value")

    def wait_for(self, script: str) -> None:
        """Wait until an expression in the page is true."""
        ends = time.monotonic() + _LIMIT_S
        while not self.value(script):
            assert time.monotonic() < ends, f"{script} does not become true; the console says {self.said}"
            time.sleep(0.1)

    def call(self, method: str, **given: Any) -> dict[str, Any]:
        """The answer to a command of the protocol."""
        self._number += 1
        command = {"id": self._number, "method": method, "params": given}
        command |= {"sessionId": self._session} if self._session else {}
        os.write(self._to, json.dumps(command).encode() + b"\0")
        ends = time.monotonic() + _LIMIT_S
        while (message := self._message(ends)).get("id") != self._number:
            self._heed(message)
        assert "error" not in message, message
        answer: dict[str, Any] = message["result"]
        return answer

    def _message(self, ends: float) -> dict[str, Any]:
        while b"\0" not in self._rest:
            ready, _, _ = select.select([self._back], [], [], max(0.0, ends - time.monotonic()))
            more = os.read(self._back, 1 << 16) if ready else b""
            assert more, "the browser does not answer"
            self._rest += more
        one, _, self._rest = self._rest.partition(b"\0")
        message: dict[str, Any] = json.loads(one)
        return message

    def _heed(self, message: dict[str, Any]) -> None:
        what, told = message.get("method"), message.get("params", {})
        if what == "Page.loadEventFired":
            self.loaded = True
        elif what == "Log.entryAdded":
            self.said.append(told["entry"]["text"])
        elif what == "Runtime.exceptionThrown":
            self.said.append(json.dumps(told["exceptionDetails"]))
        elif what == "Runtime.consoleAPICalled" and told["type"] in ("error", "warning", "assert"):
            self.said.append(" ".join(str(one.get("value")) for one in told["args"]))
        elif what == "Page.javascriptDialogOpening":
            self.said.append(f"a dialogue opened: {told['message']}")


@contextmanager
def browser() -> Iterator[Tab]:
    """A browser with one empty page, ended with the block."""
    (heard, to), (back, answers) = os.pipe(), os.pipe()
    as_the_browser_wants_them = f'exec "$0" "$@" 3</dev/fd/{heard} 4>/dev/fd/{answers}'
    with TemporaryDirectory(ignore_cleanup_errors=True) as home:
        command = ["sh", "-c", as_the_browser_wants_them, CHROMIUM, *_OPTIONS, f"--user-data-dir={home}"]
        quiet: dict[str, Any] = {"stdin": DEVNULL, "stdout": DEVNULL, "stderr": DEVNULL}
        with Popen(command, pass_fds=(heard, answers), **quiet) as process:
            os.close(heard)
            os.close(answers)
            try:
                yield Tab(to, back)
            finally:
                process.kill()
                os.close(to)
                os.close(back)
