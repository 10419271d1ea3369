"""Stand-in for the Hugging Face hub on the loopback interface, with the endpoints for pushing and pulling.

``python stand_in_hub.py`` prints its address and serves until it is ended. Repositories are kept in memory. After
``POST /cut`` every file of more than 10 kB breaks off in the middle, until ``POST /mend``.
"""

from __future__ import annotations

import base64
import hashlib
import json
import re
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from urllib.parse import unquote

REPOS: dict[str, Repo] = {}
BLOBS: dict[str, bytes] = {}  # large files by SHA-256
CUTTING: list[bool] = []
LARGE = ".parquet", ".safetensors"


class Repo:
    """Commits, each a dict of files, and the names that point to them."""

    def __init__(self):
        self.commits: dict[str, dict[str, bytes]] = {}
        self.refs: dict[str, str] = {}
        self.commit({})

    def commit(self, files: dict[str, bytes]) -> str:
        name = hashlib.sha1(f"{len(self.commits)}".encode()).hexdigest()
        self.commits[name] = files
        self.refs["main"] = name
        return name

    def resolve(self, revision: str) -> str | None:
        return self.refs.get(revision, revision if revision in self.commits else None)


class Handler(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"

    def log_message(self, *args):
        pass

    def answer(self, value=None, status=200, headers=(), body: bytes | None = None):
        body = json.dumps(value if value is not None else {}).encode() if body is None else body
        self.send_response(status)
        for name, content in {"Content-Length": str(len(body)), **dict(headers)}.items():
            self.send_header(name, content)
        self.end_headers()
        if self.command != "HEAD":
            cut = CUTTING and len(body) > 10_000
            self.wfile.write(body[: len(body) // 2] if cut else body)
            self.close_connection |= bool(cut)

    def refuse(self, code: str):
        self.answer({"error": code}, 404, {"X-Error-Code": code})

    def body(self) -> bytes:
        if self.headers.get("Transfer-Encoding") == "chunked":
            chunks = []
            while size := int(self.rfile.readline(), 16):
                chunks.append(self.rfile.read(size))
                self.rfile.readline()
            self.rfile.readline()
            return b"".join(chunks)
        return self.rfile.read(int(self.headers.get("Content-Length", 0)))

    def handle_request(self):
        path, data = unquote(self.path).split("?")[0], self.body()
        address = f"http://{self.headers['Host']}"
        if path in ("/cut", "/mend"):
            CUTTING[:] = [True] if path == "/cut" else []
            return self.answer()
        if path == "/api/repos/create":
            wanted = json.loads(data)
            name = f"{wanted.get('organization') or 'someone'}/{wanted['name']}"
            known = name in REPOS
            REPOS.setdefault(name, Repo())
            return self.answer({"url": f"{address}/datasets/{name}"}, 409 if known else 200)
        if path == "/api/validate-yaml":
            return self.answer({"errors": [], "warnings": []})
        if path == "/api/whoami-v2":
            return self.answer({"name": "someone", "type": "user", "orgs": [], "auth": {}})
        if match := re.fullmatch(r"/blob/(\w+)", path):
            BLOBS[match[1]] = data
            return self.answer()
        if match := re.fullmatch(r"/(?:datasets/)?([^/]+/[^/]+)\.git/info/lfs/objects/batch", path):
            objects = [
                {**o, "actions": {"upload": {"href": f"{address}/blob/{o['oid']}"}}}
                for o in json.loads(data)["objects"]
            ]
            return self.answer({"transfer": "basic", "objects": objects})
        kinds = "(?:(?:datasets|models)/)?"
        match = re.fullmatch(rf"/(?:api/)?{kinds}([^/]+/[^/]+)(?:/(\w+)(?:/([^/]+)(?:/(.*))?)?)?", path)
        if not match or match[1] not in REPOS:
            return self.refuse("RepoNotFound")
        repo, action, revision, rest = REPOS[match[1]], match[2], match[3] or "main", match[4]
        if action == "tag":
            return self.tag(repo, revision, data)
        commit = repo.resolve(revision)
        if commit is None:
            return self.refuse("RevisionNotFound")
        files = repo.commits[commit]
        if action == "preupload":
            modes = [
                {"path": f["path"], "uploadMode": "lfs" if f["path"].endswith(LARGE) else "regular"}
                for f in json.loads(data)["files"]
            ]
            return self.answer({"files": [{**mode, "shouldIgnore": False} for mode in modes]})
        if action == "commit":
            changed = {**files, **changed_files(data)}
            name = repo.commit({path: content for path, content in changed.items() if content is not None})
            return self.answer(
                {
                    "commitOid": name,
                    "commitUrl": f"{address}/datasets/{match[1]}/commit/{name}",
                    "success": True,
                }
            )
        if action == "refs":
            refs = [{"name": n, "ref": n, "targetCommit": c} for n, c in repo.refs.items()]
            return self.answer({"branches": refs[:1], "tags": refs[1:], "converts": []})
        if action == "tree":
            return self.answer([{"type": "file", **describe(n, content)} for n, content in files.items()])
        if action in (None, "revision"):
            siblings = [{"rfilename": n, **describe(n, content)} for n, content in files.items()]
            return self.answer(
                {"id": match[1], "sha": commit, "siblings": siblings, "tags": [], "private": False}
            )
        if action == "resolve" and rest in files:
            headers = {"X-Repo-Commit": commit, "ETag": f'"{hashlib.sha1(files[rest]).hexdigest()}"'}
            return self.answer(headers=headers, body=files[rest])
        return self.refuse("EntryNotFound")

    def tag(self, repo: Repo, revision: str, data: bytes):
        if self.command == "DELETE":
            found = repo.refs.pop(revision, None)
            return self.answer() if found else self.refuse("RevisionNotFound")
        repo.refs[json.loads(data)["tag"]] = repo.resolve(revision)
        return self.answer()

    do_GET = do_HEAD = do_POST = do_PUT = do_DELETE = handle_request


def describe(name: str, content: bytes) -> dict:
    return {"path": name, "size": len(content), "oid": hashlib.sha1(content).hexdigest()}


def changed_files(data: bytes) -> dict[str, bytes | None]:
    """Return the files of a commit's lines of JSON; None for deleted files."""
    files = {}
    for line in data.splitlines():
        operation = json.loads(line)
        value = operation["value"]
        if operation["key"] == "file":
            files[value["path"]] = base64.b64decode(value["content"])
        elif operation["key"] == "lfsFile":
            files[value["path"]] = BLOBS[value["oid"]]
        elif operation["key"] == "deletedFile":
            files[value["path"]] = None
    return files


if __name__ == "__main__":
    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    print(f"http://127.0.0.1:{server.server_port}", flush=True)
    server.serve_forever()
