"""A stand-in for the Hugging Face Hub on this machine: the part of its HTTP API for pushing and fetching.

It keeps repositories in memory. Reading needs no token, writing that of `TOKEN`.
"""

import base64
import hashlib
import json
import re
import secrets
import threading
from contextlib import contextmanager
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from urllib.parse import unquote, urlsplit

TOKEN = "hf_of_the_tests"
_LARGE = (".safetensors", ".arrow", ".parquet")  # files that go through LFS
_API = re.compile(r"/api/(models|datasets)/([^/]+/[^/]+)(?:/(\w[\w-]*)(?:/([^/]+))?)?")
_FILE = re.compile(r"/(datasets/)?([^/]+/[^/]+)/resolve/([^/]+)/(.+)")
_BATCH = re.compile(r"/(?:datasets/)?[^/]+/[^/]+\.git/info/lfs/objects/batch")


@dataclass
class Repository:
    """Commits by id, files by path; and branches."""

    commits: dict[str, dict[str, bytes]] = field(default_factory=dict)
    branches: dict[str, str] = field(default_factory=dict)

    def commit(self, files: dict[str, bytes], branch: str = "main") -> str:
        """Add files in a commit to a branch, and return its id."""
        before = self.commits.get(self.branches.get(branch, ""), {})
        oid = secrets.token_hex(20)
        self.commits[oid] = before | files
        self.branches[branch] = oid
        return oid

    def find(self, revision: str) -> str | None:
        """Return the id of a branch or commit."""
        oid = self.branches.get(revision, revision)
        return oid if oid in self.commits else None


@dataclass
class LocalHub:
    """The server's state; `requests` are the method and path of each request."""

    endpoint: str = ""
    repositories: dict[str, Repository] = field(default_factory=dict)
    private: set[str] = field(default_factory=set)
    objects: dict[str, bytes] = field(default_factory=dict)
    requests: list[str] = field(default_factory=list)
    is_down: bool = False

    def repository(self, name: str, kind: str = "models") -> Repository:
        """Return a repository, a new one if there is none."""
        return self.repositories.setdefault(f"{kind}/{name}", Repository())


@contextmanager
def serving():
    """Serve a Hub without repositories on a free port of this machine."""
    hub = LocalHub()
    server = ThreadingHTTPServer(("127.0.0.1", 0), type("Handler", (_Handler,), {"hub": hub}))
    hub.endpoint = f"http://127.0.0.1:{server.server_port}"
    thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01})
    thread.start()
    try:
        yield hub
    finally:
        server.shutdown()
        thread.join()
        server.server_close()


class _Handler(BaseHTTPRequestHandler):
    hub: LocalHub
    protocol_version = "HTTP/1.1"

    def log_message(self, *_: object) -> None:
        """Print nothing."""

    def do_GET(self) -> None:
        path = self._path()
        if self.hub.is_down:
            return self._refuse(503, "", "Service Unavailable")
        if found := _FILE.fullmatch(path):
            kind = "datasets" if found[1] else "models"
            return self._file(kind, found[2], unquote(found[3]), unquote(found[4]))
        found = _API.fullmatch(path)
        repository = self.hub.repositories.get(f"{found[1]}/{found[2]}") if found else None
        if found is None or repository is None:
            return self._refuse(404, "RepoNotFound", "Repository Not Found")
        oid = repository.find(unquote(found[4] or "main"))
        if oid is None:
            return self._refuse(404, "RevisionNotFound", "Revision Not Found")
        files = repository.commits[oid]
        if found[3] == "tree":
            return self._json([{"type": "file", "path": n, **_described(n, c)} for n, c in files.items()])
        return self._json({"id": found[2], "sha": oid, "siblings": [{"rfilename": name} for name in files]})

    def _file(self, kind: str, name: str, revision: str, path: str) -> None:
        repository = self.hub.repositories.get(f"{kind}/{name}")
        oid = repository.find(revision) if repository else None
        if repository is None or oid is None or path not in repository.commits[oid]:
            return self._refuse(404, "EntryNotFound", "Entry Not Found")
        content = repository.commits[oid][path]
        return self._send(200, content, {"ETag": f'"{_oid(path, content)}"', "X-Repo-Commit": oid})

    do_HEAD = do_GET

    def do_POST(self) -> None:
        path, body = self._path(), self._body()
        if path.startswith("/lfs/"):
            oid = path.removeprefix("/lfs/")
            assert hashlib.sha256(body).hexdigest() == oid
            self.hub.objects[oid] = body
            return self._json({})
        if self.headers.get("Authorization") != f"Bearer {TOKEN}":
            return self._refuse(401, "", "Invalid username or password.")
        if _BATCH.fullmatch(path):
            asked = json.loads(body)["objects"]
            for one in asked:
                one["actions"] = {"upload": {"href": f"{self.hub.endpoint}/lfs/{one['oid']}"}}
            return self._json({"transfer": "basic", "objects": asked})
        if path == "/api/validate-yaml":
            return self._json({"errors": [], "warnings": []})
        if path == "/api/repos/create":
            return self._create(json.loads(body))
        found = _API.fullmatch(path)
        repository = self.hub.repositories.get(f"{found[1]}/{found[2]}") if found else None
        if found is None or repository is None:
            return self._refuse(404, "RepoNotFound", "Repository Not Found")
        branch = unquote(found[4])
        if found[3] == "branch":
            known = repository.branches.setdefault(branch, repository.branches["main"])
            return self._json({"ref": known})
        if found[3] == "preupload":
            return self._json({"files": [_mode(file["path"]) for file in json.loads(body)["files"]]})
        return self._commit(found[2], repository, branch, [json.loads(line) for line in body.splitlines()])

    do_PUT = do_POST

    def _create(self, asked: dict) -> None:
        kind = f"{asked.get('type', 'model')}s"
        name = f"{asked['organization']}/{asked['name']}"
        url = f"{self.hub.endpoint}/{'datasets/' if kind == 'datasets' else ''}{name}"
        if f"{kind}/{name}" in self.hub.repositories:
            return self._json({"url": url, "error": "You already created this repo"}, 409)
        self.hub.repository(name, kind).commit({".gitattributes": b"*.arrow filter=lfs\n"})
        if asked.get("private") or asked.get("visibility") == "private":
            self.hub.private.add(f"{kind}/{name}")
        return self._json({"url": url})

    def _commit(self, name: str, repository: Repository, branch: str, lines: list[dict]) -> None:
        files = {}
        for line in lines:
            value = line["value"]
            if line["key"] == "file":
                files[value["path"]] = base64.b64decode(value["content"])
            elif line["key"] == "lfsFile":
                files[value["path"]] = self.hub.objects[value["oid"]]
        oid = repository.commit(files, branch)
        return self._json({"commitUrl": f"{self.hub.endpoint}/{name}/commit/{oid}", "commitOid": oid})

    def _path(self) -> str:
        path = urlsplit(self.path).path
        self.hub.requests.append(f"{self.command} {path}")
        return path

    def _body(self) -> bytes:
        if self.headers.get("Transfer-Encoding") != "chunked":
            return self.rfile.read(int(self.headers.get("Content-Length", 0)))
        body = b""
        while size := int(self.rfile.readline(), 16):
            body += self.rfile.read(size)
            self.rfile.readline()
        self.rfile.readline()
        return body

    def _refuse(self, status: int, code: str, message: str) -> None:
        self._send(
            status,
            json.dumps({"error": message}).encode(),
            {"X-Error-Code": code, "X-Error-Message": message},
        )

    def _json(self, values: object, status: int = 200) -> None:
        self._send(status, json.dumps(values).encode(), {"Content-Type": "application/json"})

    def _send(self, status: int, content: bytes, headers: dict[str, str]) -> None:
        self.send_response(status)
        for name, value in {**headers, "Content-Length": str(len(content))}.items():
            self.send_header(name, value)
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(content)


def _mode(path: str) -> dict[str, object]:
    return {"path": path, "uploadMode": "lfs" if path.endswith(_LARGE) else "regular", "shouldIgnore": False}


def _oid(path: str, content: bytes) -> str:
    if path.endswith(_LARGE):
        return hashlib.sha256(content).hexdigest()
    return hashlib.sha1(b"blob %d\0%b" % (len(content), content)).hexdigest()


def _described(path: str, content: bytes) -> dict[str, object]:
    about: dict[str, object] = {"oid": _oid(path, content), "size": len(content)}
    if path.endswith(_LARGE):
        about["lfs"] = {"oid": _oid(path, content), "size": len(content), "pointerSize": 134}
    return about
