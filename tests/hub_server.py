"""A stand-in for the Hugging Face Hub's HTTP interface: keeps what is pushed, and hands it out."""

import base64
import contextlib
import hashlib
import json
import threading
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

COMMIT = "0" * 40


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
        elif "/tree/" in path:
            self.answer(
                [
                    {"type": "file", "path": name, "size": len(content), "oid": "0" * 40}
                    for name, content in hub.files.items()
                ]
            )
        elif "/revision/" in path:
            repository = path.partition("/revision/")[0].removeprefix("/api/models/")
            names = [{"rfilename": name} for name in hub.files]
            self.answer({"id": repository, "sha": COMMIT, "siblings": names})
        elif f"/resolve/{COMMIT}/" in path:
            self.hand_out(hub.files[path.partition(f"/resolve/{COMMIT}/")[2]])
        else:
            self.answer({})

    def hand_out(self, content):
        self.send_response(200)
        self.send_header("ETag", f'"{hashlib.sha1(content).hexdigest()}"')
        self.send_header("X-Repo-Commit", COMMIT)
        self.send_header("Content-Length", str(len(content)))
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(content)

    do_GET = do_POST = do_DELETE = do_HEAD = handle_any  # noqa: N815
