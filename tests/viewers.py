"""Rerun's viewer without a screen of its own: headless, in a window of Xvfb, in a browser."""

import asyncio
import base64
import io
import json
import os
import select
import shutil
import subprocess
import sys
import tempfile
import threading
import time
from contextlib import contextmanager, suppress
from pathlib import Path

import aiohttp
import numpy as np
import psutil
import pytest
from PIL import Image
from rerun.experimental import ViewerClient

from hearthlog.analyzer.http import free_port

_WAIT_SECONDS = 120
_DRAW_SECONDS = 2
_COMMAND = [sys.executable, "-m", "hearthlog.tools.cli.main"]
_CHROMIUM = (
    "--headless=new",
    "--no-sandbox",
    "--no-first-run",
    "--disable-quic",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--remote-debugging-port=0",
)
# For what no picture is taken of: a viewer draws a quarter of the pixels, in software.
COARSE = ("--force-device-scale-factor=0.5",)


def rerun_home(folder: Path) -> dict[str, str]:
    """An environment in which Rerun keeps its files in a folder of its own."""
    return {"XDG_CONFIG_HOME": str(folder / "config"), "XDG_DATA_HOME": str(folder / "data")}


@pytest.fixture
def viewer(tmp_path, monkeypatch):
    """Rerun's viewer; it asks for a Vulkan driver, such as Mesa's llvmpipe."""
    for name, value in rerun_home(tmp_path).items():
        monkeypatch.setenv(name, value)
    configuration = tmp_path / "config" / "rerun" / "analytics.json"
    configuration.parent.mkdir(parents=True)
    statistics = {
        "analytics_enabled": False,
        "analytics_id": "",
        "metadata": {},
        "config_file_path": str(configuration),
        "data_dir_path": str(tmp_path / "data"),
    }
    configuration.write_text(json.dumps(statistics))
    program = Path(sys.executable).with_name("rerun")
    try:
        client = ViewerClient.spawn(headless=True, port=free_port(), executable_path=str(program))
        client.get_state()
    except ConnectionError as error:
        _missing(f"Rerun's viewer does not run here: {error}")
    with client:
        yield client


def shown(client, path, views):
    """Open a file, wait until so many views are there, and return a picture and their state."""
    client.open([str(path)])
    patiently(client.get_state, lambda state: not state.loading and len(state.views) >= views)
    time.sleep(_DRAW_SECONDS)
    return patiently(client.take_screenshot), patiently(client.get_state)


def patiently(operation, is_enough=lambda _: True):
    """Ask the viewer until it answers what is wanted; on a busy machine it paints slowly."""
    deadline = time.monotonic() + _WAIT_SECONDS
    while True:
        answer = "the viewer does not answer"
        with suppress(TimeoutError, ConnectionError):
            answer = operation()
            if is_enough(answer):
                return answer
        if time.monotonic() > deadline:
            pytest.fail(_kept(answer) if isinstance(answer, bytes) else str(answer))
        time.sleep(0.1)


def _kept(picture):
    """Write a picture that was not the wanted one to a file; return where it is."""
    with tempfile.NamedTemporaryFile(suffix=".png", delete=False) as file:
        file.write(picture)
    return f"another picture is shown: {file.name}"


def pixels(picture):
    """Read a PNG as an array of red, green and blue."""
    with Image.open(io.BytesIO(picture)) as image:
        return np.asarray(image.convert("RGB")).astype(int)


def _missing(why):
    """Skip what cannot be tried here; where everything must be there, fail."""
    if os.environ.get("TESTS_REQUIRE_AUDIO") == "1":
        pytest.fail(why)
    pytest.skip(why)


def _need(*programs):
    for program in programs:
        if shutil.which(program) is None:
            _missing(f"{program} is not installed")


@pytest.fixture(scope="session")
def display():
    """A screen in memory; its name, as in DISPLAY."""
    _need("Xvfb", "xdotool")
    command = ["Xvfb", "-displayfd", "1", "-screen", "0", "1920x1080x24", "-nolisten", "tcp"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL) as server:
        ready, _, _ = select.select([server.stdout], [], [], _WAIT_SECONDS)
        number = server.stdout.readline().decode().strip() if ready else ""
        if not number:
            server.terminate()
            _missing("Xvfb does not start")
        yield f":{number}"
        server.terminate()


class Review:
    """`hearthlog review` as a process, whose keys are typed here."""

    def __init__(self, arguments, environment):
        self.lines = []
        self._key = ""
        self.process = subprocess.Popen(
            [*_COMMAND, "review", *map(str, arguments)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            env={**os.environ, **environment},
        )
        self._reader = threading.Thread(target=self._read)
        self._reader.start()

    def _read(self):
        for line in self.process.stdout:
            self.lines.append(line.rstrip("\n"))
            if line.endswith("press the key again\n"):  # of a viewer that is slow
                with suppress(OSError):
                    self.press(self._key)

    def press(self, keys):
        self._key = keys
        self.process.stdin.write(f"{keys}\n")
        self.process.stdin.flush()

    def wait_for(self, text, after=0):
        """Wait for a line that has a text, and return it."""
        deadline = time.monotonic() + _WAIT_SECONDS
        while True:
            for line in self.lines[after:]:
                if text in line:
                    return line
            assert self.process.poll() is None, self.lines
            assert time.monotonic() < deadline, self.lines
            time.sleep(0.05)

    def quit(self):
        """Press the key that ends it, and return its status."""
        self.press("q")
        return self.process.wait(_WAIT_SECONDS)

    def close(self):
        with suppress(OSError):
            self.process.stdin.close()
        if self.process.poll() is None:
            started = psutil.Process(self.process.pid).children(recursive=True)
            self.process.kill()
            for each in started:
                each.kill()
        self.process.wait()
        self._reader.join()
        self.process.stdout.close()


@contextmanager
def reviewing(*arguments, **environment):
    """Run `hearthlog review` until it is ready for keys."""
    review = Review(arguments, environment)
    try:
        yield review
    finally:
        review.close()


def address_of(port):
    """Address at which something listens at a port; None if nothing does."""
    for connection in psutil.net_connections("inet"):
        if connection.status == psutil.CONN_LISTEN and connection.laddr.port == port:
            return connection.laddr.ip
    return None


class Window:
    """The window of a viewer on a screen in memory."""

    def __init__(self, display, port):
        self._display = display
        address = patiently(lambda: address_of(port), bool)
        self._client = patiently(
            lambda: ViewerClient.connect(f"rerun+http://{address}:{port}/proxy")
        )

    def state(self):
        return patiently(self._client.get_state)

    def picture(self):
        self.state()
        return patiently(self._client.take_screenshot)

    def selection(self):
        """The span that is marked, or None."""
        panel = patiently(self._client.get_blueprint).blueprint.get("/time_panel", {})
        found = panel.get("TimePanelBlueprint", {}).get("time_selection")
        return (found["min"], found["max"]) if found else None

    def dragged(self):
        """The span that is marked once the viewer has drawn all of a drag."""
        selected = patiently(self.selection, bool)
        before = None
        while selected != before:
            time.sleep(_DRAW_SECONDS)
            before, selected = selected, self.selection()
        return selected

    def mouse(self, *steps):
        """Do what `xdotool` calls steps, each when the one before was seen and drawn."""
        for step in steps:
            subprocess.run(
                ["xdotool", *step.split()], check=True, env={**os.environ, "DISPLAY": self._display}
            )
            self.state()

    def drag(self, y, start, end):
        """Drag the mouse from one x to another.

        A button that is pressed in the frame of the move after it counts as pressed where that move
        ends. A state may come out of a frame that began before the button; a picture does not. What
        lies under the mouse, such as the end of a selection, is known a frame after the move.
        """
        middle = (start + end) // 2
        self.mouse(f"mousemove {start} {y}")
        self.picture()
        self.picture()
        self.mouse("mousedown 1")
        self.picture()
        self.mouse(f"mousemove {start + 12} {y}")
        self.mouse(f"mousemove {middle} {y}", f"mousemove {end} {y}", "mouseup 1")


class Page:
    """A page in a browser without a screen, over the protocol of its developer tools."""

    def __init__(self, address, folder, size, flags=()):
        _need("chromium")
        folder.mkdir(parents=True, exist_ok=True)
        self._log = (folder / "chromium.log").open("wb")
        self._browser = subprocess.Popen(
            [
                *("chromium", *_CHROMIUM, *flags),
                *(f"--window-size={size}", f"--user-data-dir={folder}", address),
            ],
            stdout=self._log,
            stderr=self._log,
        )
        self._loop = asyncio.new_event_loop()
        self._number = 0
        self._session = self._socket = None
        port = folder / "DevToolsActivePort"
        try:
            patiently(port.exists, bool)
            number = patiently(lambda: port.read_text().split("\n")[0], bool)
            self._loop.run_until_complete(self._connect(f"http://127.0.0.1:{number}/json"))
        except BaseException:
            self.close()
            raise

    async def _connect(self, address):
        self._session = aiohttp.ClientSession()
        while True:
            pages = await (await self._session.get(address)).json(content_type=None)
            found = [page for page in pages if page["type"] == "page"]
            if found:
                break
            await asyncio.sleep(0.1)
        url = found[0]["webSocketDebuggerUrl"]
        self._socket = await self._session.ws_connect(url, max_msg_size=0)

    async def _send(self, method, parameters):
        self._number += 1
        await self._socket.send_json({"id": self._number, "method": method, "params": parameters})
        return self._number

    async def _call(self, method, parameters):
        return await self._answer(await self._send(method, parameters))

    async def _answer(self, number):
        while True:
            answer = await self._socket.receive_json()
            if answer.get("id") == number:
                assert "error" not in answer, answer
                return answer["result"]

    def call(self, method, **parameters):
        call = asyncio.wait_for(self._call(method, parameters), _WAIT_SECONDS)
        return self._loop.run_until_complete(call)

    def open(self, address):
        """Go to another page, and wait until it is there with its pictures."""
        self.call("Page.navigate", url=address)
        self._wait_until_loaded()

    def open_as(self, address, content):
        """Open a page that does not come from where its address points to."""
        opened = asyncio.wait_for(self._open_as(address, content), _WAIT_SECONDS)
        self._loop.run_until_complete(opened)
        self._wait_until_loaded()

    async def _open_as(self, address, content):
        await self._call("Fetch.enable", {"patterns": [{"urlPattern": address}]})
        opened = await self._send("Page.navigate", {"url": address})
        while (output := await self._socket.receive_json()).get("method") != "Fetch.requestPaused":
            pass
        answer = {
            "requestId": output["params"]["requestId"],
            "responseCode": 200,
            "responseHeaders": [{"name": "Content-Type", "value": "text/html"}],
            "body": base64.b64encode(content.encode()).decode(),
        }
        await self._send("Fetch.fulfillRequest", answer)
        await self._answer(opened)
        await self._call("Fetch.disable", {})

    def _wait_until_loaded(self):
        patiently(lambda: self.evaluate("document.readyState"), lambda state: state == "complete")

    def wait_for(self, promise):
        """Let the page compute something that takes its time."""
        found = self.call(
            "Runtime.evaluate", expression=promise, returnByValue=True, awaitPromise=True
        )
        assert "exceptionDetails" not in found, found
        return found["result"]["value"]

    def evaluate(self, expression):
        """Let the page compute something."""
        found = self.call("Runtime.evaluate", expression=expression, returnByValue=True)
        return found["result"].get("value")

    def bar_height(self):
        """The pixels of the bar of keys, below the viewer."""
        return self.evaluate("document.getElementById('keys').offsetHeight")

    def text(self):
        """The line that the page shows."""
        return self.evaluate('document.getElementById("text").textContent') or ""

    def picture(self):
        return base64.b64decode(self.call("Page.captureScreenshot")["data"])

    def drag(self, y, start, end):
        """Drag the mouse from one x to another."""
        self._mouse("mouseMoved", start, y)
        self._mouse("mousePressed", start, y, button="left", buttons=1, clickCount=1)
        for x in (start + 12, (start + end) // 2, end):
            self._mouse("mouseMoved", x, y, button="left", buttons=1)
        self._mouse("mouseReleased", end, y, button="left", clickCount=1)

    def wheel(self, x, y, steps, *, zoom=False):
        """Turn the wheel over a place; with `zoom`, hold Ctrl."""
        self._mouse("mouseMoved", x, y)
        for _ in range(abs(steps)):
            delta = 100 if steps > 0 else -100
            self._mouse("mouseWheel", x, y, deltaX=0, deltaY=delta, modifiers=2 * zoom)

    def _mouse(self, kind, x, y, **more):
        """Do something with the mouse, and let the page draw twice."""
        self.call("Input.dispatchMouseEvent", type=kind, x=x, y=y, **more)
        self.call(
            "Runtime.evaluate",
            expression="new Promise(f => requestAnimationFrame(() => requestAnimationFrame(f)))",
            awaitPromise=True,
        )

    def close(self):
        if self._session is not None:
            self._loop.run_until_complete(self._disconnect())
        self._loop.close()
        self._browser.terminate()
        self._browser.wait(20)
        self._log.close()

    async def _disconnect(self):
        if self._socket is not None:
            await self._socket.close()
        await self._session.close()
        await asyncio.sleep(0)


@contextmanager
def browsing(address, folder, size="1100,760", flags=()):
    """Open a page; a large one is drawn slowly."""
    page = Page(address, folder, size, flags)
    try:
        yield page
    finally:
        page.close()


def ruler(picture, below=0):
    """Find the time ruler in a picture: x of its start, where the cursor is, and its y.

    The cursor is a line from the ruler down to the lower edge, or so many pixels above it.
    """
    light = pixels(picture)[: -6 - below].min(axis=2) > 140
    left = light[:, : light.shape[1] // 2]
    lengths = np.argmin(left[::-1], axis=0)  # of the line from the lower edge on
    x = int(np.argmax(lengths))
    assert lengths[x] > 40, "no time cursor in the picture"
    return x, len(left) - int(lengths[x]) + 8


def find_ruler(take, below=0):
    """Take pictures until one shows the time ruler; return its place, as `ruler` does."""

    def found():
        with suppress(AssertionError):
            return ruler(take(), below)
        return None

    return patiently(found, bool)
