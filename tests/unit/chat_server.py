# SPDX-License-Identifier: MIT
"""A chat endpoint on this machine that answers as a test says."""

import contextlib
import http.server
import json
import threading

LINES = "1, camera_model, 200, soft, 0.15, yes\n2, camera, 2700, hard, 0.20, no\n0.2"


def completion(content=LINES, **message):
    return json.dumps({"choices": [{"message": {"role": "assistant", "content": content, **message}}]}).encode()


class Server:
    """Answers request number n (from 0) by ``behave(handler, n)``; keeps what it was sent."""

    def __init__(self, behave, context=None):
        self.received = []
        kept = self.received

        class Handler(http.server.BaseHTTPRequestHandler):
            protocol_version = "HTTP/1.1"

            def do_POST(self):
                body = self.rfile.read(int(self.headers.get("Content-Length", 0)))
                kept.append((self.path, dict(self.headers), body))
                self.close_connection = True
                with contextlib.suppress(OSError):
                    behave(self, len(kept) - 1)

            do_GET = do_POST

            def log_message(self, *arguments):
                pass

        self._server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        self._server.daemon_threads = True
        if context is not None:
            self._server.socket = context.wrap_socket(self._server.socket, server_side=True)
        self._server.handle_error = lambda *_: None
        self.url = f"http://127.0.0.1:{self._server.server_address[1]}"

    def __enter__(self):
        threading.Thread(target=self._server.serve_forever, kwargs={"poll_interval": 0.01}, daemon=True).start()
        return self

    def __exit__(self, *_):
        self._server.shutdown()
        self._server.server_close()


def send(handler, body, status=200, **headers):
    handler.send_response(status)
    own = {name.replace("_", "-"): value for name, value in headers.items()}
    for name, value in {"Content-Type": "application/json", "Content-Length": str(len(body)), **own}.items():
        handler.send_header(name, value)
    handler.end_headers()
    handler.wfile.write(body)
