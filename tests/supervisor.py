"""Stand-in for the Supervisor of Home Assistant: its API names the broker, its ingress a page.

The header fields are those that Home Assistant and the Supervisor send on together.
"""

import http.client
import json
import sys
from contextlib import suppress
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

ADDON, TOKEN = sys.argv[1:]
PREFIX = "/api/hassio_ingress/abc123"
BROKER = {"host": "core-mosquitto", "port": 1883, "ssl": False, "protocol": "3.1.1"}
OWN = {"transfer-encoding", "content-length", "content-encoding", "connection"}


class Supervisor(BaseHTTPRequestHandler):
    """The API, and the ingress below the path that a browser has from Home Assistant."""

    def do_GET(self):
        if self.path.startswith(f"{PREFIX}/"):
            self.show_page()
        elif self.path == "/services/mqtt":
            is_known = self.headers["Authorization"] == f"Bearer {TOKEN}"
            answer = {"result": "ok", "data": BROKER} if is_known else {"result": "error"}
            self.answer(200 if is_known else 403, [], json.dumps(answer).encode())
        else:
            self.send_error(404)

    do_POST = do_GET

    def show_page(self):
        body = self.rfile.read(int(self.headers.get("Content-Length", "0")))
        fields = {name: value for name, value in self.headers.items() if name.lower() not in OWN}
        client = self.client_address[0]
        fields |= {
            "X-Ingress-Path": PREFIX,
            "X-Forwarded-For": f"{client}, 172.30.32.1",
            "X-Forwarded-Host": self.headers["Host"],
            "X-Forwarded-Proto": "http",
            "X-Remote-User-Id": "0123456789abcdef",
            "X-Remote-User-Name": "anna",
            "X-Remote-User-Display-Name": "Anna",
        }
        page = http.client.HTTPConnection(ADDON, 8099, timeout=60)
        page.request(self.command, self.path.removeprefix(PREFIX), body, fields)
        found = page.getresponse()
        kept = [(name, value) for name, value in found.getheaders() if name.lower() not in OWN]
        if found.getheader("Content-Length"):
            self.answer(found.status, kept, found.read())
        else:
            self.stream(found, kept)
        page.close()

    def answer(self, status, fields, body):
        self.begin(status, [*fields, ("Content-Length", str(len(body)))])
        self.wfile.write(body)

    def stream(self, found, fields):
        self.begin(found.status, fields)
        with suppress(OSError):
            while block := found.read1(65536):
                self.wfile.write(block)

    def begin(self, status, fields):
        self.send_response_only(status)
        for name, value in fields:
            self.send_header(name, value)
        self.end_headers()


ThreadingHTTPServer(("", 80), Supervisor).serve_forever()
