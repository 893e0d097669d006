"""A headless browser that is asked for pictures until it shows what is waited for, in real time."""

import base64
import json
import os
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any


class Browser:
    """Chromium behind the pipe of its debugging protocol: JSON texts, each ended by a zero byte.

    Args:
        requests: file descriptor that it reads.
        answers: file descriptor that it writes.
    """

    def __init__(self, requests: int, answers: int) -> None:
        self._requests, self._answers = requests, answers
        self._count = 0
        self._session = ""
        self._rest = b""

    def open(self, address: str) -> None:
        """Open a page."""
        target = self._ask("Target.createTarget", {"url": address})["targetId"]
        self._session = self._ask("Target.attachToTarget", {"targetId": target, "flatten": True})["sessionId"]

    def picture(self, path: Path) -> None:
        """Write what the page looks like now as PNG."""
        path.write_bytes(base64.b64decode(self._ask("Page.captureScreenshot", {})["data"]))

    def _ask(self, method: str, parameters: dict[str, Any]) -> dict[str, Any]:
        self._count += 1
        request = {"id": self._count, "method": method, "params": parameters}
        if self._session:
            request["sessionId"] = self._session
        os.write(self._requests, json.dumps(request).encode() + b"\0")
        while True:
            while b"\0" not in self._rest:
                data = os.read(self._answers, 1 << 16)
                assert data, "the browser has ended"
                self._rest += data
            text, _, self._rest = self._rest.partition(b"\0")
            answer = json.loads(text)
            if answer.get("id") == self._count:
                result: dict[str, Any] = answer["result"]
                return result


@contextmanager
def browser(program: str, profile: Path) -> Iterator[Browser]:
    """A browser that draws in software, with an empty profile; ended with the block."""
    to_read, requests = os.pipe()
    answers, to_write = os.pipe()
    flags = ["--headless", "--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
    flags += ["--window-size=1600,1000", f"--user-data-dir={profile}", "--remote-debugging-pipe"]
    # It expects its end of the pipes at the file descriptors 3 and 4.
    script = f'exec "$0" "$@" 3<&{to_read} 4>&{to_write}'
    process = subprocess.Popen(
        ["/bin/bash", "-c", script, program, *flags],
        pass_fds=(to_read, to_write),
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    os.close(to_read)
    os.close(to_write)
    try:
        yield Browser(requests, answers)
    finally:
        process.kill()
        process.wait()
        os.close(requests)
        os.close(answers)
