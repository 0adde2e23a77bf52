"""A Hugging Face Hub on loopback: what huggingface_hub really asks for to share a dataset, and no more."""

import base64
import hashlib
import json
import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from threading import Thread
from typing import Any
from urllib.parse import unquote, urlsplit

TOKEN = "hf_secret"

Files = dict[str, bytes]


@dataclass
class Repository:
    """Commits by name, each all of its files; the branch main and tags point at them."""

    private: bool = False
    commits: dict[str, Files] = field(default_factory=dict)
    head: str = ""
    tags: dict[str, str] = field(default_factory=dict)
    history: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.commit({".gitattributes": b"*.parquet filter=lfs\n"}, "initial commit")

    def commit(self, files: Files, message: str) -> None:
        self.head = hashlib.sha1(f"{self.head}{len(self.commits)}".encode()).hexdigest()
        self.commits[self.head] = files
        self.history.append(message)

    def files(self, revision: str) -> Files | None:
        return self.commits.get(self.head if revision == "main" else self.tags.get(revision, revision))


class Hub(ThreadingHTTPServer):
    """Repositories "user/name" and large files by sha256; `refuse` may answer any request with a status.

    Where nobody asks for another one, `visibility` is that of new repositories, as organizations may choose.
    """

    daemon_threads = True

    def __init__(self) -> None:
        self.repos: dict[str, Repository] = {}
        self.large: Files = {}
        self.ranges: list[str] = []
        self.visibility = "public"
        self.refuse: Callable[[str, str], int | None] = lambda method, path: None
        super().__init__(("127.0.0.1", 0), Handler)

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.server_port}"


@contextmanager
def running_hub() -> Iterator[Hub]:
    with Hub() as hub:
        thread = Thread(target=hub.serve_forever, kwargs={"poll_interval": 0.01})
        thread.start()
        try:
            yield hub
        finally:
            hub.shutdown()
            thread.join()


REPO = r"(?P<repo>[^/]+/[^/]+)"
ROUTES = (
    ("POST", r"/api/repos/create", "create"),
    ("POST", r"/api/validate-yaml", "validate"),
    ("GET", rf"/api/datasets/{REPO}/refs", "refs"),
    ("GET", rf"/api/datasets/{REPO}(/revision/(?P<revision>[^/]+))?", "info"),
    ("GET", rf"/api/datasets/{REPO}/tree/(?P<revision>[^/]+)(/(?P<path>.*))?", "tree"),
    ("POST", rf"/api/datasets/{REPO}/paths-info/(?P<revision>[^/]+)", "paths_info"),
    ("POST", rf"/api/datasets/{REPO}/preupload/main", "preupload"),
    ("POST", rf"/api/datasets/{REPO}/commit/main", "commit"),
    ("POST", rf"/api/datasets/{REPO}/tag/(?P<revision>[^/]+)", "tag"),
    ("DELETE", rf"/api/datasets/{REPO}/tag/(?P<revision>[^/]+)", "untag"),
    ("POST", rf"/datasets/{REPO}\.git/info/lfs/objects/batch", "batch"),
    ("PUT", r"/large/(?P<oid>[0-9a-f]+)", "receive"),
    ("GET", rf"/datasets/{REPO}/resolve/(?P<revision>[^/]+)/(?P<path>.+)", "resolve"),
)


class Handler(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"
    server: Hub

    def log_message(self, *_: object) -> None:
        pass

    def do_GET(self) -> None:
        self.body = self.rfile.read(int(self.headers.get("Content-Length") or 0))
        path = unquote(urlsplit(self.path).path)
        if status := self.server.refuse(self.command, path):
            return self._answer({"error": "refused"}, status)
        for method, pattern, name in ROUTES:
            found = re.fullmatch(pattern, path)
            if method == self.command and found:
                words = found.groupdict()
                repo = self.server.repos.get(words.get("repo", ""))
                if "repo" in words and (repo is None or (repo.private and not self._known())):
                    # The Hub does not tell strangers which private repositories exist.
                    headers = {"X-Error-Code": "RepoNotFound"}
                    return self._answer({"error": "Repository not found"}, 404, headers)
                if method != "GET" and name != "paths_info" and not self._known():
                    return self._answer({"error": "Invalid username or password."}, 401)
                if "repo" in words:
                    words["repo"] = repo
                getattr(self, name)(**{key: value for key, value in words.items() if value is not None})
                return None
        return self._answer({"error": f"{self.command} {path} is not served"}, 501)

    do_POST = do_PUT = do_DELETE = do_HEAD = do_GET  # noqa: N815

    def _known(self) -> bool:
        return self.headers.get("Authorization") == f"Bearer {TOKEN}" or self.command == "PUT"

    def _answer(self, content: object, status: int = 200, headers: dict[str, str] | None = None) -> None:
        body = content if isinstance(content, bytes) else json.dumps(content).encode()
        self.send_response(status)
        for name, value in {"Content-Length": str(len(body)), **(headers or {})}.items():
            self.send_header(name, value)
        self.end_headers()
        self.wfile.write(body)

    def _missing(self, code: str) -> None:
        self._answer({"error": code}, 404, {"X-Error-Code": code})

    def create(self) -> None:
        asked = json.loads(self.body)
        name = f"{asked['organization'] or 'me'}/{asked['name']}"
        if name in self.server.repos:
            return self._answer({"error": "exists", "url": f"{self.server.url}/datasets/{name}"}, 409)
        self.server.repos[name] = Repository(private=asked.get("visibility", self.server.visibility) == "private")
        return self._answer({"url": f"{self.server.url}/datasets/{name}", "id": name})

    def validate(self) -> None:
        if "license: none-such\n" in json.loads(self.body)["content"]:
            fault = {"message": '"license" must be one of a list'}
            return self._answer({"errors": [fault]}, 400, {"X-Error-Message": "Invalid metadata"})
        return self._answer({"warnings": [], "errors": []})

    def refs(self, repo: Repository) -> None:
        tags = [
            {"name": name, "ref": f"refs/tags/{name}", "targetCommit": commit} for name, commit in repo.tags.items()
        ]
        branches = [{"name": "main", "ref": "refs/heads/main", "targetCommit": repo.head}]
        self._answer({"branches": branches, "tags": tags, "converts": []})

    def info(self, repo: Repository, revision: str = "main") -> None:
        if repo.files(revision) is None:
            return self._missing("RevisionNotFound")
        sha = repo.head if revision == "main" else revision
        return self._answer({"id": "me/it", "sha": sha, "private": repo.private})

    def tree(self, repo: Repository, revision: str, path: str = "") -> None:
        files = repo.files(revision)
        if files is None:
            return self._missing("RevisionNotFound")
        prefix = f"{path}/" if path else ""
        below = {name: content for name, content in files.items() if name.startswith(prefix)}
        if "recursive=true" in self.path.lower():
            return self._answer([self._entry(name, content) for name, content in below.items()])
        entries = {}
        for name, content in below.items():
            first, deeper, _ = name.removeprefix(prefix).partition("/")
            folder = {"type": "directory", "path": prefix + first, "oid": "0" * 40, "size": 0}
            entries[first] = folder if deeper else self._entry(name, content)
        return self._answer(list(entries.values())) if entries else self._missing("EntryNotFound")

    def paths_info(self, repo: Repository, revision: str) -> None:
        files, asked = repo.files(revision) or {}, json.loads(self.body)["paths"]
        self._answer([self._entry(name, files[name]) for name in asked if name in files])

    def _entry(self, name: str, content: bytes) -> dict[str, Any]:
        oid = hashlib.sha1(f"blob {len(content)}\0".encode() + content).hexdigest()
        entry = {"type": "file", "path": name, "oid": oid, "size": len(content)}
        if not name.endswith((".parquet", ".png")):
            return entry
        large = {"oid": hashlib.sha256(content).hexdigest(), "size": len(content), "pointerSize": 130}
        return entry | {"lfs": large}

    def preupload(self, repo: Repository) -> None:
        def mode(path: str) -> str:
            return "lfs" if path.endswith((".parquet", ".png")) else "regular"

        asked = json.loads(self.body)["files"]
        self._answer(
            {"files": [{"path": f["path"], "uploadMode": mode(f["path"]), "shouldIgnore": False} for f in asked]}
        )

    def batch(self, repo: Repository) -> None:
        objects = []
        for asked in json.loads(self.body)["objects"]:
            upload = {"upload": {"href": f"{self.server.url}/large/{asked['oid']}"}}
            objects.append(asked | ({} if asked["oid"] in self.server.large else {"actions": upload}))
        self._answer({"transfer": "basic", "objects": objects})

    def receive(self, oid: str) -> None:
        assert hashlib.sha256(self.body).hexdigest() == oid
        self.server.large[oid] = self.body
        self._answer(b"")

    def commit(self, repo: Repository) -> None:
        lines = [json.loads(line) for line in self.body.splitlines()]
        head = lines[0]["value"]
        if head.get("parentCommit", repo.head) != repo.head:
            return self._answer({"error": "A commit has happened since"}, 412)
        files = dict(repo.commits[repo.head])
        for line in lines[1:]:
            value = line["value"]
            if line["key"] == "file":
                files[value["path"]] = base64.b64decode(value["content"])
            elif line["key"] == "lfsFile":
                files[value["path"]] = self.server.large[value["oid"]]
            else:
                assert line["key"] == "deletedFile"
                del files[value["path"]]
        repo.commit(files, head["summary"])
        url = f"{self.server.url}/datasets/me/it/commit/{repo.head}"
        return self._answer({"commitUrl": url, "commitOid": repo.head})

    def tag(self, repo: Repository, revision: str) -> None:
        name = json.loads(self.body)["tag"]
        if name in repo.tags:
            return self._answer({"error": "exists"}, 409)
        repo.tags[name] = repo.head if revision == "main" else revision
        return self._answer({})

    def untag(self, repo: Repository, revision: str) -> None:
        del repo.tags[revision]
        self._answer({})

    def resolve(self, repo: Repository, revision: str, path: str) -> None:
        content = (repo.files(revision) or {}).get(path)
        if content is None:
            return self._missing("EntryNotFound")
        asked = re.fullmatch(r"bytes=(\d+)-(\d+)", self.headers.get("Range", ""))
        if not asked:
            return self._answer(content)
        self.server.ranges.append(f"{path} {asked[0]}")
        first, last = int(asked[1]), min(int(asked[2]), len(content) - 1)
        headers = {"Content-Range": f"bytes {first}-{last}/{len(content)}"}
        return self._answer(content[first : last + 1], 206, headers)
