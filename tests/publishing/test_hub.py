"""Names of repositories on the Hub; demonstrations pushed to one on this machine, and fetched."""

import json
import re
from pathlib import Path

import pytest
import yaml

from local_hub import LocalHub
from openvima.cli.main import main
from openvima.data import Dataset
from openvima.data.manifest import INDEX_NAME, MANIFEST_NAME
from openvima.data.verification import VerifyConfig, verify
from openvima.errors import DatasetError, ServerError
from openvima.hub import HubName, dataset_name, hub_name
from openvima.publishing import push_demonstrations
from small_data_sets import contents, edit_manifest, flip_bit

pytestmark = pytest.mark.filterwarnings(
    "ignore:Use 'content=<...>':DeprecationWarning"
)  # by the Hub's client


@pytest.mark.parametrize(
    ("text", "name"),
    [
        ("owner/name", HubName("owner/name")),
        ("owner/name@v1.0", HubName("owner/name", "v1.0")),
        ("hf://owner/some.name-1@refs/pr/3", HubName("owner/some.name-1", "refs/pr/3")),
        (Path("hf://owner/name@main"), HubName("owner/name", "main")),
        *[
            (text, None)
            for text in ("name", "a/b/c", "./a/b", "/a/b", "a/b@", "a/b@../c", "a/b@v 1", "hf://a")
        ],
    ],
)
def test_only_a_text_that_can_be_a_repository_is_its_name(text: str | Path, name: HubName | None) -> None:
    assert hub_name(text) == name


def test_a_folder_comes_before_a_repository_unless_the_scheme_says_so(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("runs").mkdir()
    assert hub_name("runs/frist") is None
    assert hub_name("hf://runs/frist") == HubName("runs/frist")
    assert dataset_name("owner/name") is None


def test_pushed_demonstrations_are_read_from_the_hub(hub: LocalHub, demos: Path, capsys) -> None:
    assert main(["data", "push-to-hub", str(demos), "owner/demos", "--private"]) == 0
    pushed = capsys.readouterr().out.strip()
    assert re.fullmatch(r"hf://owner/demos@[0-9a-f]{40}", pushed)
    assert hub.private == {"datasets/owner/demos"}
    ours, theirs = Dataset(demos), Dataset(pushed)
    assert [demo.content_hash() for demo in theirs] == [demo.content_hash() for demo in ours]
    assert verify(theirs.path, VerifyConfig(0)).is_clean
    assert not any(path.is_symlink() for path in theirs.path.rglob("*"))


def test_the_card_of_demonstrations_counts_them_and_names_their_licence(hub: LocalHub, demos: Path) -> None:
    name = push_demonstrations(demos, "owner/demos@first")
    repository = hub.repository("owner/demos", "datasets")
    assert repository.branches["first"] == name.revision != repository.branches["main"]
    _, metadata, text = repository.commits[name.revision]["README.md"].decode().split("---\n", 2)
    values = yaml.safe_load(metadata)
    assert values["license"] == ["mit", "cc-by-4.0"]
    assert "| rotate | 2 | " in text
    assert Dataset(demos).manifest["content_hash"] in text
    assert "hf://owner/demos@first" in text


def test_info_on_a_data_set_of_the_hub_fetches_no_shard(hub: LocalHub, demos: Path, capsys) -> None:
    revision = push_demonstrations(demos, "owner/demos").revision
    hub.requests.clear()
    assert main(["data", "info", "hf://owner/demos"]) == 0
    shown = capsys.readouterr().out
    assert f"hf://owner/demos@{revision}: 2 episodes" in shown
    assert "rotate" in shown
    fetched = {request.rpartition("/")[2] for request in hub.requests if "/resolve/" in request}
    assert fetched == {MANIFEST_NAME, INDEX_NAME}
    assert main(["data", "info", "hf://owner/demos", "--details", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["summary"]["tasks"]["rotate"]["bytes"] > 0


def test_a_revision_stays_what_it_was_when_the_branch_moves_on(hub: LocalHub, demos: Path) -> None:
    first = push_demonstrations(demos, "owner/demos")
    hub.repository("owner/demos", "datasets").commit({MANIFEST_NAME: b"{}"})
    assert len(Dataset(f"hf://{first}")) == 2
    with pytest.raises(DatasetError, match=r"owner--demos/[0-9a-f]{40}/dataset\.json: it is damaged"):
        Dataset("hf://owner/demos")


def test_what_was_fetched_is_read_without_a_connection(hub: LocalHub, demos: Path, monkeypatch) -> None:
    push_demonstrations(demos, "owner/demos")
    Dataset("hf://owner/demos")
    monkeypatch.setattr(hub, "is_down", True)
    assert len(Dataset("hf://owner/demos")) == 2
    with pytest.raises(ServerError, match="the download of owner/others failed"):
        Dataset("hf://owner/others")


def test_a_shard_that_changed_since_is_not_pushed(hub: LocalHub, demos: Path) -> None:
    flip_bit(*demos.glob("*.arrow"))
    with pytest.raises(DatasetError, match="checksum is not that of the manifest"):
        push_demonstrations(demos, "owner/demos")
    assert not hub.requests


def test_a_manifest_of_others_names_no_file_outside(hub: LocalHub, demos: Path) -> None:
    def leave(manifest: dict) -> None:
        manifest["shards"]["../../secret.arrow"] = next(iter(manifest["shards"].values()))

    edit_manifest(demos, leave)
    hub.repository("evil/demos", "datasets").commit(contents(demos))
    with pytest.raises(DatasetError, match="which is no plain file name"):
        Dataset("hf://evil/demos")
    with pytest.raises(DatasetError, match="which is no plain file name"):
        Dataset("hf://evil/demos", index_only=True)


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("hf://owner/nowhere", "the download of owner/nowhere failed: .*[Rr]epository"),
        ("hf://owner/demos@nowhere", "the download of owner/demos@nowhere failed: .*[Rr]evision"),
        ("hf://owner/empty", "owner/empty on the Hugging Face Hub holds no data set"),
    ],
)
def test_what_the_hub_lacks_is_named_in_one_line(hub: LocalHub, name: str, message: str) -> None:
    hub.repository("owner/demos", "datasets").commit({"notes.txt": b""})
    hub.repository("owner/empty", "datasets").commit({"notes.txt": b""})
    with pytest.raises((ServerError, DatasetError), match=message) as caught:
        Dataset(name)
    assert "\n" not in str(caught.value)


def test_without_a_token_that_may_write_nothing_is_pushed(hub: LocalHub, demos: Path, monkeypatch) -> None:
    monkeypatch.setenv("HF_TOKEN", "hf_of_somebody_else")
    with pytest.raises(ServerError, match=r"^the push to owner/demos failed: .*(401|[Ii]nvalid)"):
        push_demonstrations(demos, "owner/demos")
    assert not hub.repositories


@pytest.mark.parametrize("name", ["demos", "owner/demos/more", "owner/../demos"])
def test_a_push_goes_to_a_repository_only(hub: LocalHub, demos: Path, name: str) -> None:
    with pytest.raises(ServerError, match="give OWNER/NAME"):
        push_demonstrations(demos, name)
    assert not hub.requests
