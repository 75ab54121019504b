"""Demonstrations on the Hugging Face Hub, as local folders."""

from dataclasses import replace
from pathlib import Path

from openvima.data.manifest import INDEX_NAME, MANIFEST_NAME, parse_manifest, read_inside
from openvima.errors import DatasetError
from openvima.hub import cache_folder, dataset_name, fetch
from openvima.input_files import as_path

_MAX_MANIFEST_BYTES = 2**28  # of 500,000 shards


def data_folder(path: str | Path, *, shards: bool = True) -> Path:
    """Return the folder of a data set; one on the Hub is downloaded, into a folder of its commit.

    Args:
        path: A folder, or the name of a data set on the Hub such as "hf://owner/name@revision".
        shards: Whether to fetch the shards that its manifest lists; else manifest and index only. No other
            file of the repository is fetched.

    Returns:
        The folder. Of one on the Hub only the manifest was checked, as readers check shards.

    Raises:
        HubError: There is no such repository, or it cannot be reached.
        DatasetError: It holds no data set, or its manifest is damaged.
        MissingExtraError: `huggingface_hub` is not installed.
    """
    name = dataset_name(path)
    if name is None:
        return as_path(path)
    # The client's cache has a folder per commit, of links. A data set must be of plain files.
    commit = fetch(name, (MANIFEST_NAME,), kind="dataset").name
    fixed, folder = replace(name, revision=commit), cache_folder(name, commit)
    fetch(fixed, (MANIFEST_NAME, INDEX_NAME), kind="dataset", into=folder)
    manifest = folder / MANIFEST_NAME
    if not manifest.is_file():
        raise DatasetError(f"{name} on the Hugging Face Hub holds no data set ({MANIFEST_NAME} is missing).")
    if (size := manifest.stat().st_size) > _MAX_MANIFEST_BYTES:
        raise DatasetError(
            f"{MANIFEST_NAME} of {fixed} has {size} bytes; at most {_MAX_MANIFEST_BYTES} are read."
        )
    if shards:
        try:
            names = list(parse_manifest(read_inside(manifest))["shards"])  # plain file names
        except DatasetError as error:
            raise DatasetError(f"{MANIFEST_NAME} of {fixed}: {error}.") from None
        fetch(fixed, names, kind="dataset", into=folder)
    return folder
