"""Run a command, and end it and all that it started when it ends or standard input does: a process of its own.

The command's output goes to standard error. Standard output gets one line: the status, or why it cannot be started.
"""

import os
import signal
import subprocess
import sys
import threading
import time
from contextlib import suppress

_GRACE_S = 3.0


def _end(running: "subprocess.Popen[bytes]") -> None:
    """End the command and all that it started, by force after 3 s."""
    if not hasattr(os, "killpg"):  # no groups of processes
        running.kill()
        return
    with suppress(OSError):  # there are none left, or only those of another user
        os.killpg(running.pid, signal.SIGTERM)
        until = time.monotonic() + _GRACE_S
        while time.monotonic() < until:
            time.sleep(0.1)
            os.killpg(running.pid, 0)
        os.killpg(running.pid, signal.SIGKILL)


def _end_with_input(running: "subprocess.Popen[bytes]") -> None:
    """End the command as soon as the process that asked for it closes standard input, or ends."""
    sys.stdin.read()
    _end(running)


def _main(parts: list[str]) -> None:
    if os.name == "nt":  # elsewhere a session of its own keeps Ctrl-C away
        signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        running = subprocess.Popen(
            parts, stdin=subprocess.DEVNULL, stdout=sys.stderr, stderr=sys.stderr, process_group=0
        )
    except OSError as error:
        print("cannot start", error.errno)
        return
    signal.signal(signal.SIGTERM, lambda *_: _end(running))
    threading.Thread(target=_end_with_input, args=(running,), daemon=True).start()
    print("ended", running.wait(), flush=True)
    _end(running)


if __name__ == "__main__":
    _main(sys.argv[1:])
