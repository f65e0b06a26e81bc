# SPDX-License-Identifier: MIT
"""A command that ends with whoever started it: `python guard.py COMMAND...`.

Ends the command, and all that it has started, when standard input closes: the writing end of that
pipe is gone as soon as its process is, however that ended. Nothing but the standard library is
imported.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time

GRACE = 5.0
"""Seconds between the request to end (torchrun passes it on to its processes) and the end."""


def main() -> None:
    """Run the command and end with its exit code, 128 + N where signal N ended it."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # whoever started it decides
    child = subprocess.Popen(sys.argv[1:], stdin=subprocess.DEVNULL, start_new_session=True)
    threading.Thread(target=_end_with_input, args=(child,), daemon=True).start()
    code = child.wait()
    sys.exit(code if code >= 0 else 128 - code)


def _end_with_input(child: subprocess.Popen[bytes]) -> None:
    while os.read(0, 1024):  # not sys.stdin, which a thread may not hold at the end
        pass
    try:
        os.killpg(child.pid, signal.SIGTERM)
        time.sleep(GRACE)  # the command may be gone before: then this process is, too
        os.killpg(child.pid, signal.SIGKILL)
    except ProcessLookupError:
        return


if __name__ == "__main__":
    main()
