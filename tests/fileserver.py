"""A server of one file, on loopback, which misbehaves as it is told."""

import re
import ssl
import time
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from threading import Event, Thread


class FileServer:
    """Serves `data`; each request is served as the next of `moods`, the last one again and again.

    A mood is a number of bytes after which the connection is closed, or a word.
    """

    def __init__(self, origin):
        self.data = b""
        self.moods = ["well"]
        self.requested = []  # the ranges
        self.url = f"{origin}/network.tflite"
        self.over = Event()

    def mood(self):
        return self.moods.pop(0) if len(self.moods) > 1 else self.moods[0]


@contextmanager
def file_server(certificate=None):
    """Serve over http, or over https with the files of a certificate and its key."""

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self):
            server.requested.append(self.headers["Range"])
            _answer(self, server, server.mood())

        def log_message(self, *_):
            pass

    with ThreadingHTTPServer(("127.0.0.1", 0), Handler) as listening:
        listening.daemon_threads = True
        if certificate:
            context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
            context.load_cert_chain(*certificate)
            listening.socket = context.wrap_socket(listening.socket, server_side=True)
            listening.handle_error = lambda *_: None  # who does not trust it ends the handshake
        scheme = "https" if certificate else "http"
        server = FileServer(f"{scheme}://127.0.0.1:{listening.server_port}")
        Thread(target=listening.serve_forever, args=(0.02,), daemon=True).start()
        try:
            yield server
        finally:
            server.over.set()
            listening.shutdown()


def _answer(request, server, mood):
    if isinstance(mood, str) and mood.isdigit():
        request.send_error(int(mood))
    elif isinstance(mood, str) and mood.startswith("moved"):
        request.send_response(302)
        request.send_header("Location", mood.removeprefix("moved to ").replace("moved", server.url))
        request.end_headers()
    else:
        _answer_with_data(request, server, mood)


def _answer_with_data(request, server, mood):
    data, start = server.data, 0
    requested = re.fullmatch(r"bytes=(\d+)-", request.headers["Range"] or "")
    if requested and mood != "no ranges":
        start = int(requested[1])
        if start >= len(data):
            request.send_error(416)
            return
    request.send_response(206 if start else 200)
    if start:
        output = 0 if mood == "another range" else start
        request.send_header("Content-Range", f"bytes {output}-{len(data) - 1}/{len(data)}")
    if mood != "no length":
        request.send_header("Content-Length", str(len(data) - start))
    request.end_headers()
    rest = data[start:][: mood if isinstance(mood, int) else None]
    _write(request, server, mood, rest)


def _write(request, server, mood, rest):
    if mood in {"slow", "stalls"}:
        for at in range(0, len(rest), len(rest) // 5 + 1):
            request.wfile.write(rest[at : at + len(rest) // 5 + 1])
            request.wfile.flush()
            if mood == "stalls":
                server.over.wait(20)
                return
            time.sleep(0.1)
        return
    request.wfile.write(rest)
