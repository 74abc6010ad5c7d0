"""A receiver of alerts."""

import json
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from threading import Thread


@contextmanager
def server(port=0, status=200):
    """A server that takes what is posted to it; yields its port and the texts."""
    texts = []

    class Handler(BaseHTTPRequestHandler):
        def do_POST(self):
            length = int(self.headers["Content-Length"])
            body = self.rfile.read(length)
            if status == 200:
                texts.append(json.loads(body)["message"])
            self.send_response(status)
            self.send_header("Content-Length", "0")
            self.end_headers()

        def log_message(self, *_):
            pass

    class Server(ThreadingHTTPServer):
        daemon_threads = True
        block_on_close = False

    with Server(("127.0.0.1", port), Handler) as own:
        Thread(target=own.serve_forever, daemon=True).start()
        yield own.server_port, texts
        own.shutdown()
