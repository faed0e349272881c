"""Bundles in a repository of Hugging Face's hub: hf://owner/name, or hf://owner/name@revision.

huggingface_hub finds the hub, the token and its cache as its other users do (HF_ENDPOINT, HF_TOKEN, HF_HOME), and
answers from the cache while the hub is unreachable or HF_HUB_OFFLINE is set. A publication is one commit.
"""

from __future__ import annotations

import contextlib
import shutil
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, BinaryIO

from rlservo.errors import BundleError, RlservoError, UnavailableError, UsageError, first_line
from rlservo.serve_app.repository.places import TIMEOUT_S, place_of

CARD = "README.md"
OURS = b'library_name: "rlservo"'
"""A line of the cards that may be replaced: others were written by a person."""


class HubStorage:
    """Files of a repository, by the methods of `ObjectStorage`. Servers only read; plans are kept elsewhere."""

    is_read_only = True

    def __init__(self, uri: str, *, timeout_s: float = TIMEOUT_S / 2) -> None:
        """Nothing is asked yet. Raises UsageError."""
        self.uri = place_of(uri)
        self.timeout_s = timeout_s
        self._repository, _, revision = self.uri.removeprefix("hf://").partition("@")
        self._revision: str | None = revision or None
        self._beside: Mapping[str, bytes] = {}
        self.pinned = self.uri
        """The repository at the commit that `create` made."""

    def read(self, name: str, most: int) -> tuple[bytes, str]:
        """Return a file, and the commit it was read at for `create`.

        Raises FileNotFoundError, UnavailableError, and BundleError beyond `most` bytes.
        """
        path, commit = self._fetch(name, most)
        return path.read_bytes(), commit

    def copy(self, name: str, most: int, into: BinaryIO) -> None:
        """Copy a file into an empty one. Raises what `read` raises."""
        with self._fetch(name, most)[0].open("rb") as file:
            shutil.copyfileobj(file, into)

    def names(self, folder: str) -> list[str]:
        """Return the names of all files below a folder. Raises UnavailableError."""
        with self._named(folder):
            files: list[str] = self._api().list_repo_files(self._repository, revision=self._revision)
        return [file.removeprefix(f"{folder}/") for file in files if file.startswith(f"{folder}/")]

    def begin(self, beside: Mapping[str, bytes], card: str) -> None:
        """Make the repository if there is none, private, and keep files for the commit that `create` makes.

        `card` becomes the repository's README.md, unless a person wrote that. Raises UsageError for a pinned revision.
        """
        if self._revision is not None:
            raise UsageError(f"{self.uri} is one revision: publish to hf://{self._repository}")
        with self._named(""):
            self._api().create_repo(self._repository, private=True, exist_ok=True)
        with contextlib.suppress(FileNotFoundError):
            if OURS not in self.read(CARD, 1 << 20)[0]:
                card = ""
        self._beside = {**beside, CARD: card.encode()} if card else beside

    def create(self, name: str, content: bytes, tag: str = "") -> bool:
        """Commit a file with those of `begin`; return whether that was done, upon the commit `tag`.

        Raises UnavailableError.
        """
        from huggingface_hub import CommitOperationAdd
        from huggingface_hub.errors import HfHubHTTPError

        operations = [CommitOperationAdd(path, data) for path, data in {**self._beside, name: content}.items()]
        with self._named(name):
            try:
                made = self._api().create_commit(
                    self._repository, operations, commit_message="Publish with rlservo", parent_commit=tag or None
                )
            except HfHubHTTPError as error:
                if error.response.status_code not in (409, 412):  # another commit came first
                    raise
                return False
        self.pinned = f"{self.uri}@{made.oid}"
        return True

    def _fetch(self, name: str, most: int) -> tuple[Path, str]:
        from huggingface_hub import hf_hub_download
        from huggingface_hub.errors import LocalEntryNotFoundError, RemoteEntryNotFoundError

        with self._named(name):
            given: dict[str, Any] = {"etag_timeout": self.timeout_s, "library_name": "rlservo"}
            try:
                found = hf_hub_download(self._repository, name, revision=self._revision, dry_run=True, **given)
                if (found.file_size or 0) > most:
                    raise BundleError(f"{self.uri}/{name} has {found.file_size:,} bytes: at most {most:,} are read")
                file = hf_hub_download(self._repository, name, revision=found.commit_hash, **given)
            except RemoteEntryNotFoundError:
                raise FileNotFoundError(f"{self.uri}/{name}") from None
            except LocalEntryNotFoundError:
                raise UnavailableError(
                    f"{self.uri}/{name} is not in the hub's cache here (HF_HOME), and {_no_answer()}"
                ) from None
        return Path(file), found.commit_hash

    def _api(self) -> Any:
        from huggingface_hub import HfApi

        return HfApi(library_name="rlservo")

    @contextlib.contextmanager
    def _named(self, name: str) -> Iterator[None]:
        """Turn the hub's errors into UnavailableError, with the place."""
        from huggingface_hub.errors import HfHubHTTPError, RepositoryNotFoundError, RevisionNotFoundError

        place = f"{self.uri}/{name}".rstrip("/")
        try:
            yield
        except (RlservoError, FileNotFoundError):
            raise
        except RevisionNotFoundError:
            raise UnavailableError(f"{place}: the repository has no revision '{self._revision}'") from None
        except RepositoryNotFoundError:
            raise UnavailableError(
                f"{place}: there is no such repository, or it is not open to this environment's token (HF_TOKEN, or "
                "`hf auth login`)"
            ) from None
        except HfHubHTTPError as error:
            reason = first_line(error)
            if error.response.status_code in (401, 403):
                reason = "the hub refuses this: set HF_TOKEN, or run `hf auth login`, with a token that may write there"
            raise UnavailableError(f"{place} cannot be read or written: {reason}") from None
        except Exception as error:  # its HTTP client and Xet raise several unrelated types
            raise UnavailableError(f"{place} cannot be reached: {_no_answer()} ({first_line(error)})") from None


def _no_answer() -> str:
    from huggingface_hub import constants

    if constants.HF_HUB_OFFLINE:
        return "HF_HUB_OFFLINE is set: unset it to ask the hub"
    return f"{constants.ENDPOINT} does not answer: check the network, and HF_ENDPOINT if it is set"
