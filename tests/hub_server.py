"""A stand-in for the Hugging Face Hub's HTTP interface: takes what is pushed, in memory."""

import base64
import contextlib
import json
import threading
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer


class Hub(ThreadingHTTPServer):
    """Listens on a free port of this machine; keeps files, tokens and paths asked for."""

    def __init__(self, refuse=None):
        super().__init__(("127.0.0.1", 0), Handler)
        self.refuse = refuse
        self.files = {}
        self.created = []
        self.authorizations = set()
        self.requests = []

    @property
    def url(self):
        return f"http://127.0.0.1:{self.server_port}"


@contextlib.contextmanager
def running_hub(refuse=None):
    """A hub that answers; ``refuse`` is a status with which it answers everything."""
    hub = Hub(refuse)
    thread = threading.Thread(target=hub.serve_forever, daemon=True)
    thread.start()
    try:
        yield hub
    finally:
        hub.shutdown()
        hub.server_close()
        thread.join()


class Handler(BaseHTTPRequestHandler):
    def log_message(self, *_):
        """Says nothing."""

    def answer(self, content, status=200, headers=None):
        body = json.dumps(content).encode()
        self.send_response(status)
        for name, value in {"Content-Type": "application/json", **(headers or {})}.items():
            self.send_header(name, value)
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(body)

    def handle_any(self):
        hub, path = self.server, self.path.split("?")[0]
        length = int(self.headers.get("Content-Length") or 0)
        body = self.rfile.read(length)
        hub.requests.append((self.command, path))
        hub.authorizations.add(self.headers.get("Authorization"))
        if hub.refuse:
            self.answer({"error": "refused"}, hub.refuse)
        elif path == "/api/repos/create":
            hub.created.append(json.loads(body))
            made = hub.created[-1]
            self.answer({"url": f"{hub.url}/datasets/{made['organization']}/{made['name']}"})
        elif path == "/api/validate-yaml":
            self.answer({"errors": [], "warnings": []})
        elif "/preupload/" in path:
            files = json.loads(body)["files"]
            self.answer(
                {
                    "files": [
                        {"path": f["path"], "uploadMode": "regular", "shouldIgnore": False}
                        for f in files
                    ]
                }
            )
        elif "/commit/" in path:
            for line in body.splitlines():
                item = json.loads(line)
                if item["key"] == "file":
                    content = base64.b64decode(item["value"]["content"])
                    hub.files[item["value"]["path"]] = content
            repository = path.partition("/commit/")[0].removeprefix("/api/")
            url = f"{hub.url}/{repository}/commit/{'0' * 40}"
            self.answer({"commitUrl": url, "commitOid": "0" * 40, "success": True})
        elif self.command == "DELETE" and "/tag/" in path:
            self.answer({"error": "none"}, 404, {"X-Error-Code": "RevisionNotFound"})
        else:
            self.answer({})

    do_GET = do_POST = do_DELETE = do_HEAD = handle_any  # noqa: N815
