"""Shows a report in a browser, where somebody sits in front of one."""

import os
import sys
import webbrowser
from contextlib import suppress
from pathlib import Path


def can_open() -> bool:
    """Whether standard output is a terminal on a machine with a display, and no automatic run (CI)."""
    if not sys.stdout.isatty() or os.environ.get("CI"):
        return False
    if sys.platform in ("win32", "darwin"):
        return "SSH_CONNECTION" not in os.environ
    return any(os.environ.get(name) for name in ("DISPLAY", "WAYLAND_DISPLAY"))


def show(path: Path) -> None:
    """Open a page in the browser; nothing happens without one, or with one that would take over the terminal."""
    with suppress(webbrowser.Error, OSError):
        browser = webbrowser.get()
        if type(browser) is not webbrowser.GenericBrowser:  # such as lynx
            browser.open(path.resolve().as_uri())
