"""Repositories on the Hugging Face Hub: their names, and fetching and committing files by huggingface_hub.

A name is "owner/name", "owner/name@revision" or either with "hf://" in front; a revision is a branch, a tag
or a commit. No request is made unless a name can only be that of a repository.
"""

import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from types import ModuleType
from typing import Literal

from openvima.errors import ServerError, echo, one_line
from openvima.imports import import_extra

HubKind = Literal["model", "dataset"]

_NAME = re.compile(
    r"(?P<scheme>hf:/{1,2})?(?P<repo>[A-Za-z0-9][\w.-]*/[A-Za-z0-9][\w.-]*)(@(?P<revision>[A-Za-z0-9][\w./-]*))?",
    re.ASCII,
)  # a path shortens "hf://" to "hf:/"


@dataclass(frozen=True, slots=True)
class HubName:
    """The name of a repository.

    Args:
        repo: As "owner/name".
        revision: Branch, tag or commit; None is the main branch.
    """

    repo: str
    revision: str | None = None

    def __str__(self) -> str:
        return f"{self.repo}@{self.revision}" if self.revision else self.repo


def hub_name(text: str | Path) -> HubName | None:
    """Read a text that can only be the name of a repository; None for any other.

    Without "hf://", no local folder may be named as the owner, so that "runs/frist" beside a folder "runs" is
    a mistyped path and causes no request.
    """
    found = _NAME.fullmatch(str(text))
    if found is None or ".." in str(text):
        return None
    owner = found["repo"].partition("/")[0]
    if not found["scheme"] and (Path(text).exists() or Path(owner).exists()):
        return None
    return HubName(found["repo"], found["revision"])


def dataset_name(path: str | Path) -> HubName | None:
    """Read the name of a data set on the Hub, with "hf://" in front; None for a local path."""
    return hub_name(path) if str(path).startswith("hf:/") else None


def fetch(name: HubName, files: Sequence[str], *, kind: HubKind = "model", into: Path | None = None) -> Path:
    """Download files of a repository; files that are there already are reused.

    Args:
        name: The repository.
        files: File names, with `*` as wildcard.
        kind: Kind of repository.
        into: Folder for plain files; None is the cache of huggingface_hub, whose files are links, in a folder
            named by the commit.

    Returns:
        The local folder with the files. Their content is not checked.

    Raises:
        MissingExtraError: `huggingface_hub` is not installed.
        ServerError: There is no such repository, or it cannot be reached.
    """
    hub = _client(f"to fetch {name} from the Hugging Face Hub")
    with _failures(f"the download of {name}"):
        found = hub.snapshot_download(
            name.repo, repo_type=kind, revision=name.revision, allow_patterns=list(files), local_dir=into
        )
    return Path(found)


def cache_folder(name: HubName, commit: str) -> Path:
    """Return a folder of this package in the cache of huggingface_hub, for the files of one commit."""
    hub = _client("to find its cache")
    folder = hub.cached_assets_path("openvima", namespace=name.repo.replace("/", "--"), subfolder=commit)
    return Path(folder)


def commit(
    name: HubName,
    files: Mapping[str, Path | bytes],
    *,
    kind: HubKind = "model",
    private: bool = False,
) -> HubName:
    """Write files to a repository in one commit; it is created if there is none.

    Args:
        name: The repository; its revision is the branch, which is created too.
        files: Path in the repository to a local file or content. Other files in it stay.
        kind: Kind of repository.
        private: Whether a new repository is private.

    Returns:
        The repository at the new commit.

    Raises:
        MissingExtraError: `huggingface_hub` is not installed.
        ServerError: The Hub refuses, for example without a token that may write, or cannot be reached.
    """
    hub = _client(f"to push to {name} on the Hugging Face Hub")
    api = hub.HfApi(library_name="openvima")
    additions = [
        hub.CommitOperationAdd(path, content if isinstance(content, bytes) else str(content))
        for path, content in files.items()
    ]
    with _failures(f"the push to {name}"):
        api.create_repo(name.repo, repo_type=kind, private=private, exist_ok=True)
        if name.revision:
            api.create_branch(name.repo, branch=name.revision, repo_type=kind, exist_ok=True)
        done = api.create_commit(
            name.repo, additions, commit_message="Push with openvima", repo_type=kind, revision=name.revision
        )
    return replace(name, revision=done.oid)


def _client(purpose: str) -> ModuleType:
    return import_extra("huggingface_hub", f"{purpose}, install huggingface_hub: pip install 'openvima[hub]'")


@contextmanager
def _failures(what: str) -> Iterator[None]:
    """Report what fails in one line."""
    try:
        yield
    except Exception as error:  # the client passes on those of its HTTP library, which has changed before
        causes = [each for each in (error, error.__cause__) if each is not None]
        reasons = [echo(f"{type(each).__name__}: {one_line(each)}") for each in causes]
        raise ServerError(f"{what} failed: {'; '.join(reasons)}") from error
