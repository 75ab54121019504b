"""The verb `policies`: the list, one policy, and published files made into folders."""

from collections.abc import Iterator
from functools import cache

import pytest

torch = pytest.importorskip("torch")

from openvima.cli.main import main  # noqa: E402
from openvima.policies import PRESETS, build, load_policy, preset  # noqa: E402
from openvima.policies.build import build_network, count_parameters, outline_network  # noqa: E402
from openvima.policies.checkpoint import load_checkpoint, save_checkpoint  # noqa: E402
from openvima.policies.naming import BEST_FILE, CHECKPOINTS_FOLDER, WEIGHTS_FILE  # noqa: E402
from published_policies import small_vima, write_published, write_tokenizer  # noqa: E402


@pytest.fixture(scope="module", autouse=True)
def count_each_preset_once() -> Iterator[None]:
    """Of the presets, each list counts all."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(build, "outline_network", cache(outline_network))
        yield


@pytest.fixture
def published(tmp_path):
    """A small published file."""
    return write_published(build_network(small_vima(), seed=2), tmp_path / "2M.ckpt")


@pytest.mark.slow
def test_the_list_holds_every_preset_with_its_numbers_within_100_columns(capsys, monkeypatch) -> None:
    monkeypatch.setenv("COLUMNS", "100")
    assert main(["policies"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert max(len(line) for line in lines if "model card" not in line) <= 100
    rows = {line.split()[0]: line.split()[1:] for line in lines if line.strip()}
    assert rows.keys() >= PRESETS.keys()
    counts = count_parameters(outline_network(preset("vima-20m")))
    total = counts["total"]
    numbers = [
        f"{count / 1e6:.2f}"
        for count in (*(count.total for count in counts.values()), total.trainable, total.frozen)
    ]
    assert rows["vima-20m"] == ["384", "4", "12", *numbers]
    assert rows["preset"][3:] == [*counts, "trained", "frozen"]


def test_a_preset_is_shown_with_all_of_its_sizes(capsys) -> None:
    assert main(["policies", "show", "gpt-nano"]) == 0
    shown = capsys.readouterr().out
    assert "gpt, width 128, 4 layers, 4 heads; 3.53 M parameters, of which 3.53 M are trained" in shown
    assert "3,529,664" in shown and "architecture: gpt" in shown


def test_a_checkpoint_and_a_published_file_are_shown_by_their_path(published, tmp_path, capsys) -> None:
    save_checkpoint(build_network(small_vima(), seed=0), tmp_path / "saved")
    for path in (tmp_path / "saved", published):
        assert main(["policies", "show", str(path)]) == 0
        assert "vima, width 32, 1 layer, 2 heads" in capsys.readouterr().out


def test_a_published_file_becomes_a_policy(published, tmp_path, capsys) -> None:
    pytest.importorskip("transformers")
    tokenizer = write_tokenizer(tmp_path / "t5")
    out = tmp_path / "out"
    assert main(["policies", "convert", str(published), str(out), "--tokenizer", str(tokenizer)]) == 0
    printed = capsys.readouterr()
    assert f"{published}: vima, width 32, 1 layer, 2 heads" in printed.out
    assert printed.out.splitlines()[-1] == str(out)
    assert not printed.err
    expected = build_network(small_vima(), seed=2).state_dict()
    for name, tensor in load_policy(str(out)).network.state_dict().items():
        assert torch.equal(tensor.float(), expected[name])


def test_without_a_tokenizer_it_says_so_and_one_can_be_added(published, tmp_path, capsys) -> None:
    pytest.importorskip("transformers")
    tokenizer = write_tokenizer(tmp_path / "t5")
    first, second, third = (str(tmp_path / name) for name in ("first", "second", "third"))
    assert main(["policies", "convert", str(published), first]) == 0
    assert "--tokenizer" in capsys.readouterr().err
    assert main(["policies", "convert", first, second, "--tokenizer", str(tokenizer)]) == 0
    assert main(["policies", "convert", second, third]) == 0  # with what is stored there
    assert not capsys.readouterr().err
    load_policy(third)


@pytest.mark.slow
def test_the_best_checkpoint_of_a_run_is_exported_in_half_the_bytes(tmp_path, capsys) -> None:
    run, out = tmp_path / "run", tmp_path / "out"
    for seed, name in enumerate(("000001", "000002")):
        save_checkpoint(build_network(small_vima(), seed=seed), run / CHECKPOINTS_FOLDER / name)
    (run / CHECKPOINTS_FOLDER / BEST_FILE).write_text("000001")
    assert main(["policies", "convert", str(run), str(out), "--precision", "float16"]) == 0
    best = run / CHECKPOINTS_FOLDER / "000001"
    for name, tensor in load_checkpoint(best).state_dict().items():
        assert torch.equal(load_checkpoint(out).state_dict()[name], tensor.half().float())
    whole, half = ((folder / WEIGHTS_FILE).stat().st_size for folder in (best, out))
    assert half < 0.6 * whole


def test_a_conversion_overwrites_only_when_forced(published, tmp_path, capsys) -> None:
    out = tmp_path / "out"
    save_checkpoint(build_network(small_vima(), seed=0), out)
    assert main(["policies", "convert", str(published), str(out)]) == 2
    assert "--force" in capsys.readouterr().err
    weights = "prompt.images.0.weight"
    assert torch.equal(
        load_checkpoint(out).state_dict()[weights], build_network(small_vima(), seed=0).state_dict()[weights]
    )
    assert main(["policies", "convert", str(published), str(out), "--force"]) == 0
    assert torch.equal(
        load_checkpoint(out).state_dict()[weights], build_network(small_vima(), seed=2).state_dict()[weights]
    )


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["show", "vima-20"], "Did you mean 'vima-20m'?"),
        (["show", "."], "no checkpoint"),
        (["convert", "nowhere.ckpt", "out"], "there is no checkpoint at nowhere.ckpt"),
        (["convert", "damaged.ckpt", "out"], "damaged.ckpt"),
        (["convert", "2M.ckpt", "out", "--tokenizer", "./nowhere"], "./nowhere"),
    ],
)
def test_bad_input_is_one_line_and_status_2_and_nothing_is_written(
    words: list[str], message: str, published, tmp_path, monkeypatch, capsys
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "damaged.ckpt").write_bytes(published.read_bytes()[:1000])
    assert main(["policies", *words]) == 2
    shown = capsys.readouterr().err.strip()
    assert message in shown
    assert "\n" not in shown
    assert {path.name for path in tmp_path.iterdir()} == {"2M.ckpt", "damaged.ckpt"}
