"""Chromium without a screen, over the pipe of its developer tools."""

import base64
import json
import os
import select
import time
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from hearthlog.schemas.errors import HearthlogError

_WAIT_SECONDS = 60.0
_COMMAND = (
    "chromium",
    "--headless=new",
    "--no-sandbox",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--hide-scrollbars",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--remote-debugging-pipe",
)
_DRAWN = "new Promise(f => requestAnimationFrame(() => requestAnimationFrame(f)))"


class BrowserError(HearthlogError):
    """The browser is missing, or does not do what it should."""


class Browser:
    """A browser with one page.

    Parameters
    ----------
    folder : Path
        For its profile.
    """

    def __init__(self, folder: Path) -> None:
        (its_input, self._to), (self._from, its_output) = os.pipe(), os.pipe()
        nowhere = os.open(os.devnull, os.O_RDWR)
        actions = [
            (os.POSIX_SPAWN_DUP2, nowhere, 1),
            (os.POSIX_SPAWN_DUP2, nowhere, 2),
            (os.POSIX_SPAWN_DUP2, its_input, 3),
            (os.POSIX_SPAWN_DUP2, its_output, 4),
        ]
        try:
            self._process = os.posix_spawnp(
                _COMMAND[0],
                [*_COMMAND, f"--user-data-dir={folder}"],
                os.environ,
                file_actions=actions,
            )
        except FileNotFoundError as error:
            raise BrowserError("chromium is not installed: apt install chromium") from error
        finally:
            for one in (its_input, its_output, nowhere):
                os.close(one)
        self._rest = b""
        self._number = 0
        self._session: str | None = None
        target = self.call("Target.createTarget", url="about:blank")["targetId"]
        self._session = self.call("Target.attachToTarget", targetId=target, flatten=True)[
            "sessionId"
        ]
        self._agent = self.call("Runtime.evaluate", expression="navigator.userAgent")

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None
    ) -> None:
        os.close(self._to)  # at which it ends
        os.close(self._from)
        os.waitpid(self._process, 0)

    def call(self, method: str, **parameters: Any) -> Any:
        """Call a method of the protocol and return its result."""
        self._number += 1
        message: dict[str, Any] = {"id": self._number, "method": method, "params": parameters}
        if self._session is not None:
            message["sessionId"] = self._session
        os.write(self._to, json.dumps(message).encode() + b"\0")
        while True:
            answer = self._receive()
            if answer.get("id") == self._number:
                if "error" in answer:
                    raise BrowserError(f"chromium: {method}: {answer['error']['message']}")
                return answer["result"]

    def _receive(self) -> Any:
        deadline = time.monotonic() + _WAIT_SECONDS
        while b"\0" not in self._rest:
            left = max(deadline - time.monotonic(), 0.0)
            block = b""
            if select.select([self._from], [], [], left)[0]:
                block = os.read(self._from, 1 << 20)
            if not block:
                raise BrowserError("chromium does not answer")
            self._rest += block
        answer, _, self._rest = self._rest.partition(b"\0")
        return json.loads(answer)

    def open(
        self, address: str, width: int, height: int, *, dark: bool = False, language: str = "en"
    ) -> None:
        """Open a page in a window of a size, and wait until it is there."""
        self.call(
            "Emulation.setDeviceMetricsOverride",
            width=width,
            height=height,
            deviceScaleFactor=1,
            mobile=False,
        )
        scheme = {"name": "prefers-color-scheme", "value": "dark" if dark else "light"}
        self.call("Emulation.setEmulatedMedia", features=[scheme])
        agent = self._agent["result"]["value"]
        self.call("Emulation.setUserAgentOverride", userAgent=agent, acceptLanguage=language)
        self.call("Page.navigate", url=address)
        self.wait_for("document.readyState === 'complete' && location.href !== 'about:blank'")

    def evaluate(self, expression: str) -> Any:
        """Evaluate an expression in the page."""
        found = self.call(
            "Runtime.evaluate", expression=expression, returnByValue=True, awaitPromise=True
        )
        if "exceptionDetails" in found:
            raise BrowserError(f"{expression}: {found['exceptionDetails']}")
        return found["result"].get("value")

    def wait_for(self, expression: str) -> None:
        """Wait until an expression is true in the page."""
        deadline = time.monotonic() + _WAIT_SECONDS
        while True:
            try:
                if self.evaluate(f"!!({expression})"):
                    return
            except BrowserError:  # the page is just being replaced
                if time.monotonic() > deadline:
                    raise
            if time.monotonic() > deadline:
                raise BrowserError(f"the page never came to this: {expression}")
            time.sleep(0.1)

    def picture(self) -> bytes:
        """Return a picture of the window as PNG."""
        self.evaluate(_DRAWN)
        return base64.b64decode(self.call("Page.captureScreenshot")["data"])
