"""The page of the home, served as its log is written, and a browser that is shown it."""

import json
import socket
import threading
import time
from contextlib import contextmanager, suppress
from http.client import HTTPConnection
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

from livehome import LiveHome, midday_zone
from viewers import patiently

from hearthlog.analyzer.bridge.bridge import Bridge
from hearthlog.analyzer.bridge.page import server
from hearthlog.analyzer.bridge.page.home_page import HomePage
from hearthlog.analyzer.bridge.settings import PageSettings, RecorderAddress
from hearthlog.analyzer.http import free_port
from hearthlog.analyzer.logs.local_time import today
from hearthlog.analyzer.marks.marks import read_marks
from hearthlog.schemas.logs.files import find_logs

JSON = {"Content-Type": "application/json"}
_WATCH = """
window.seen = [];
for (const kind of ["error", "unhandledrejection", "securitypolicyviolation"])
  addEventListener(kind, (e) =>
    seen.push(`${kind} ${e.message ?? e.reason ?? e.blockedURI}`), true);
console.error = (...texts) => seen.push(texts.join(" "));
"""
# The texts with too little contrast to the ground below them, after WCAG 2.
PALE_TEXTS = """
(() => {
  const parts = (colour) => colour.match(/[\\d.]+/g).map(Number);
  const linear = (v) => (v /= 255) <= 0.04045 ? v / 12.92 : ((v + 0.055) / 1.055) ** 2.4;
  const light = ([r, g, b]) => 0.2126 * linear(r) + 0.7152 * linear(g) + 0.0722 * linear(b);
  const ground = (e) => {
    for (; e; e = e.parentElement) {
      const found = parts(getComputedStyle(e).backgroundColor);
      if (found.length === 3 || found[3] === 1) return found;
    }
    return [255, 0, 0];
  };
  const pale = [];
  for (const e of document.body.querySelectorAll("*")) {
    const own = [...e.childNodes].some((n) => n.nodeType === 3 && n.textContent.trim());
    if (!own || !e.getClientRects().length || e.closest(".hidden, defs, title")) continue;
    const style = getComputedStyle(e);
    const colour = e instanceof SVGElement ? style.fill : style.color;
    const [one, other] = [light(parts(colour)), light(ground(e))].sort((a, b) => b - a);
    if ((one + 0.05) / (other + 0.05) < 4.5) pale.push(`${e.textContent} ${colour}`);
  }
  return pale;
})()
"""


class Served:
    """A home whose log is being written, and its page."""

    def __init__(self, folder, settings=None, never_tell=(), **options):
        self.settings = settings or {}
        self.log = LiveHome(folder / "logs", **options)
        hidden = frozenset(never_tell)
        self.home = RecorderAddress(folder / "logs", "home", midday_zone(), hidden)
        self.state, self.output, self.port = folder / "state", [], free_port()
        self._start()

    def _start(self):
        settings = PageSettings(port=self.port, **self.settings)
        page = self._page = HomePage(settings, self.home, self.state, self.output.append)
        self.url = (self.state / "page-address").read_text().strip()
        self.token = self.url.partition("=")[2]
        now = today(time.time_ns(), self.home.zone)
        self._stop = threading.Event()
        bridge = Bridge(self.home, min(now.midnight, now.night), {"page": page}, self.output.append)
        self._thread = threading.Thread(target=bridge.run, args=(self._stop,))
        self._thread.start()

    def end(self):
        self._stop.set()
        self._thread.join()

    def restart(self):
        self.end()
        self._start()

    def close(self):
        self.end()
        self.log.close()

    def open_pages(self):
        """How many browsers get the news."""
        return server._MOST_STREAMS - self._page._server.streams._value

    def threads(self):
        """The threads that answer requests."""
        return [each for each in threading.enumerate() if "process_request" in each.name]

    def connect(self):
        return socket.create_connection(("127.0.0.1", self.port), timeout=30)

    def cookie(self):
        _, fields, _ = self.request("GET", f"/?token={self.token}", cookie=None)
        return fields["Set-Cookie"].partition(";")[0]

    def request(self, method, path, body=None, cookie="own", **fields):
        """Send a request; return status, fields and body of the answer."""
        named = {name.replace("_", "-"): value for name, value in fields.items()}
        if cookie is not None:
            named["Cookie"] = self.cookie() if cookie == "own" else cookie
        connection = HTTPConnection("127.0.0.1", self.port, timeout=30)
        try:
            connection.request(method, path, body, named)
            answer = connection.getresponse()
            return answer.status, answer.headers, answer.read().decode()
        finally:
            connection.close()

    def mark(self, event, label):
        return self.post("/mark", {"event": event, "label": label})

    def post(self, path, content):
        own = {"Origin": f"http://127.0.0.1:{self.port}", **JSON}
        status, _, answer = self.request("POST", path, json.dumps(content), **own)
        return status, answer

    def marks(self):
        return [mark for log in find_logs(self.log.folder) for mark in read_marks(log)]

    def events(self):
        """The last events as the page shows them."""
        with self.stream() as part:
            return part("events")["events"]

    def open_stream(self):
        """Ask for the stream of news; return the connection, or None if there are too many."""
        connection = self.connect()
        head = f"GET /events HTTP/1.1\r\nHost: 127.0.0.1:{self.port}\r\n"
        connection.sendall(f"{head}Cookie: {self.cookie()}\r\n\r\n".encode())
        if connection.recv(12) == b"HTTP/1.1 200":
            return connection
        connection.close()
        return None

    @contextmanager
    def stream(self):
        """Open the stream of news; yield what waits for a part of the page."""
        with (
            patiently(self.open_stream, bool) as connection,
            connection.makefile("r", encoding="utf-8") as lines,
        ):

            def next_part(name, is_enough=lambda _: True):
                for line in lines:
                    if line.strip() == f"event: {name}":
                        part = json.loads(next(lines).removeprefix("data: "))
                        if is_enough(part):
                            return part
                raise AssertionError(name)

            yield next_part


@contextmanager
def serving(folder, settings=None, **options):
    served = Served(folder, settings, **options)
    try:
        yield served
    finally:
        served.close()


@contextmanager
def proxying(port, path, fields=()):
    """A proxy of its own port that has the page below a path; yields the address.

    It adds fields to each request, as the ingress of Home Assistant does.
    """

    class Proxy(BaseHTTPRequestHandler):
        def do_GET(self):
            inside = self.path.removeprefix(path)
            if inside == self.path or not inside.startswith("/"):
                self.send_error(404)
                return
            body = self.rfile.read(int(self.headers.get("Content-Length", "0")))
            behind = HTTPConnection("127.0.0.1", port, timeout=30)
            behind.request(self.command, inside, body, {**self.headers, **dict(fields)})
            answer = behind.getresponse()
            self.send_response_only(answer.status)
            for name, value in answer.getheaders():
                self.send_header(name, value)
            self.end_headers()
            with suppress(OSError):
                while block := answer.read1(65536):
                    self.wfile.write(block)
            behind.close()

        def do_POST(self):
            self.do_GET()

        def log_message(self, *_):
            pass

    with _answering(Proxy) as address:
        yield f"{address}{path.removeprefix('/')}/"


@contextmanager
def pages(content):
    """A server of one page; yields its address."""

    class Pages(BaseHTTPRequestHandler):
        def do_GET(self):
            self.send_response(200)
            self.send_header("Content-Type", "text/html")
            self.send_header("Content-Length", str(len(content)))
            self.end_headers()
            self.wfile.write(content)

        def log_message(self, *_):
            pass

    with _answering(Pages) as address:
        yield address


@contextmanager
def _answering(handler):
    with ThreadingHTTPServer(("127.0.0.1", 0), handler) as own:
        own.daemon_threads = True
        own.block_on_close = False
        threading.Thread(target=own.serve_forever, daemon=True).start()
        yield f"http://127.0.0.1:{own.server_port}/"
        own.shutdown()


class Phone:
    """A browser that is shown the page."""

    def __init__(self, browser):
        self._browser = browser
        browser.call("Page.enable")
        browser.call("Page.addScriptToEvaluateOnNewDocument", source=_WATCH)

    def open(self, served, width=390, height=844, scheme="light"):
        self.resize(width, height)
        features = [{"name": "prefers-color-scheme", "value": scheme}]
        self._browser.call("Emulation.setEmulatedMedia", features=features)
        self._browser.call("Page.navigate", url=served.url)
        patiently(self._is_there, bool)

    def resize(self, width, height):
        self._browser.call(
            "Emulation.setDeviceMetricsOverride",
            width=width,
            height=height,
            deviceScaleFactor=1,
            mobile=False,
        )

    def _is_there(self):
        with suppress(AssertionError):  # it is still going on from the entrance
            return self.of('document.querySelectorAll("#events li, #look li, .lane").length > 1')

    def of(self, expression):
        return self._browser.evaluate(expression)

    def until(self, expression):
        return patiently(lambda: self.of(f"!!({expression})"), bool)

    def wait_until_drawn(self):
        """Let the page draw twice."""
        self._browser.wait_for(
            "new Promise(f => requestAnimationFrame(() => requestAnimationFrame(() => f(true))))"
        )

    def text(self, selector):
        shown = self.of(f"document.querySelector({selector!r})?.innerText")
        return shown and shown.replace("\N{NO-BREAK SPACE}", " ")

    def shows(self, selector, text):
        patiently(lambda: self.text(selector), lambda shown: text.lower() in (shown or "").lower())

    def press(self, key, text=""):
        for kind in ("keyDown", "keyUp"):
            code = {"Enter": 13, "Tab": 9, " ": 32}.get(key, 0)
            self._browser.call(
                "Input.dispatchKeyEvent",
                type=kind,
                key=key,
                windowsVirtualKeyCode=code,
                **({"text": text} if text and kind == "keyDown" else {}),
            )

    def write(self, text):
        self._browser.call("Input.insertText", text=text)

    def focus(self):
        return self.of("document.activeElement.innerText || document.activeElement.value")

    def tree(self):
        """What a screen reader is told: role and name of everything that is not passed over."""
        nodes = self._browser.call("Accessibility.getFullAXTree")["nodes"]
        return [
            (node["role"]["value"], node.get("name", {}).get("value", ""))
            for node in nodes
            if not node["ignored"]
        ]

    def cookies(self, address):
        return self._browser.call("Network.getCookies", urls=[address])["cookies"]

    def framed(self):
        """The addresses that a frame could not show."""
        frames = self._browser.call("Page.getFrameTree")["frameTree"].get("childFrames", [])
        return [f["frame"]["unreachableUrl"] for f in frames if "unreachableUrl" in f["frame"]]

    def picture(self, path):
        path.write_bytes(self._browser.picture())
