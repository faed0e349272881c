"""The page's JavaScript libraries: fetched once from npm's registry, checked, kept in the user's cache."""

from __future__ import annotations

import base64
import gzip
import hashlib
import io
import os
import tarfile
import urllib.error
import urllib.request
from collections.abc import Callable
from typing import NamedTuple

from rlservo.bundle.user_folders import default_folder
from rlservo.errors import RlservoError

REGISTRY = "https://registry.npmjs.org"
TIMEOUT_S = 30.0  # without a byte
BLOCK = 1 << 18  # [bytes]
MOST_BYTES = 1 << 26  # of a package; a longer one is not what was pinned


class Package(NamedTuple):
    """A release of npm's; `files` are the page's own, by their names in it."""

    name: str
    version: str
    license: str
    integrity: str
    files: dict[str, str]


# The single-threaded builds: others need headers that a plain web server does not send.
PACKAGES = (
    Package(
        "onnxruntime-web", "1.30.0", "MIT",
        "sha512-q0y+JrrtukXSzsBWEMccVfqX25LRmosXHF+CaRJmg8pZClzcV7svNc4rKY3jL02Vb7QmRMDs1SigqR4CXAfKYQ==",
        {
            "package/dist/ort.wasm.bundle.min.mjs": "onnxruntime.js",
            "package/dist/ort-wasm-simd-threaded.wasm": "onnxruntime.wasm.gz",
        },
    ),
    Package(
        "@mujoco/mujoco", "3.14.0", "Apache-2.0",
        "sha512-WPUYidu4Fx8+uM4hQv80SOA0ifpWGrsNJguKs8JBV8SCTxjKQ2/rqsh880nUH0/Vwa8vuefghvCQkkoed3bkUg==",
        {"package/mujoco.js": "mujoco.js", "package/mujoco.wasm": "mujoco.wasm.gz"},
    ),
    Package(
        "three", "0.187.0", "MIT",
        "sha512-Qiu7R+Cmh8CstZsY1uJOSWnVlfo7ZtNLV7mF8Jltk3LB3AtDu9cRZlcnRKkAk8Y4z6KKw35z7Y7Urd7jWY8etA==",
        {
            "package/build/three.module.js": "three.module.js",
            "package/build/three.core.js": "three.core.js",
            "package/examples/jsm/controls/OrbitControls.js": "OrbitControls.js",
        },
    ),
)  # fmt: skip


def libraries(say: Callable[[str], None]) -> dict[str, bytes]:
    """Return the libraries' files by their names on the page; WebAssembly is packed with gzip.

    Raises RlservoError, naming the package, if one cannot be fetched or is not the one that was pinned.
    """
    made: dict[str, bytes] = {}
    notice = []
    for package in PACKAGES:
        with tarfile.open(fileobj=io.BytesIO(_tarball(package, say))) as archive:
            for inside, name in package.files.items():
                stream = archive.extractfile(inside)
                assert stream is not None, inside
                content = stream.read()
                if name == "OrbitControls.js":  # an import map would be a script inside the page
                    content = content.replace(b"from 'three'", b"from './three.module.js'")
                made[name] = gzip.compress(content, 6, mtime=0) if name.endswith(".gz") else content
        notice.append(f"{package.name} {package.version}, {package.license}: https://npmjs.com/package/{package.name}")
    return {**made, "NOTICE.txt": "\n".join([*notice, ""]).encode()}


def _tarball(package: Package, say: Callable[[str], None]) -> bytes:
    file = f"{package.name.partition('/')[2] or package.name}-{package.version}.tgz"
    kept = default_folder() / "npm" / file
    if kept.is_file() and _is_pinned(content := kept.read_bytes(), package):
        return content
    set_by_user = (value for name, value in os.environ.items() if name.lower() == "npm_config_registry")
    registry = next(set_by_user, "") or REGISTRY
    url = f"{registry.rstrip('/')}/{package.name}/-/{file}"
    what = f"{package.name} {package.version}"
    say(f"fetching {what} from {registry}, once, into {kept.parent}")
    parts: list[bytes] = []
    try:
        with urllib.request.urlopen(url, timeout=TIMEOUT_S) as reply:
            while (size := sum(map(len, parts))) <= MOST_BYTES and (block := reply.read(BLOCK)):
                parts.append(block)
                say(f"fetching {what}: {size / 1e6:.0f} MB")
    except (OSError, urllib.error.URLError, ValueError) as error:
        reason = getattr(error, "reason", None) or error
        raise RlservoError(
            f"{what} cannot be fetched from {url}: {reason}; without a network, run the command once elsewhere and "
            f"copy {kept.parent}, or name a registry in npm_config_registry"
        ) from error
    content = b"".join(parts)
    if not _is_pinned(content, package):
        raise RlservoError(f"{url} is not the {what} that was pinned: its sha512 differs")
    kept.parent.mkdir(parents=True, exist_ok=True)
    partial = kept.with_name(f"{file}.{os.getpid()}")
    partial.write_bytes(content)
    partial.replace(kept)
    return content


def _is_pinned(content: bytes, package: Package) -> bool:
    return package.integrity == "sha512-" + base64.b64encode(hashlib.sha512(content).digest()).decode()
