"""The package speaks the vocabulary of its field: words of its first draft do not come back.

CONTRIBUTING.md's glossary lists the terms in use. A legitimate use of a word below (data of the benchmark, a
word of a published file, plain English) is excepted by file, with its reason.
"""

import re
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
FILES = (
    *sorted((ROOT / "src").rglob("*.py")),
    *sorted((ROOT / "src").rglob("*.j2")),
    *sorted((ROOT / "src").rglob("MODEL_CARD.md")),
    *sorted((ROOT / "docs").rglob("*.md")),
    *sorted((ROOT / "docs").rglob("*.py")),
    *sorted((ROOT / "examples").rglob("*.py")),
    *sorted((ROOT / "benchmarks").rglob("*.py")),
    *sorted((ROOT / "experiments").rglob("*.py")),
    ROOT / "README.md",
    ROOT / "CONTRIBUTING.md",
)

# What is out → the term in use. Matched without case, also as parts of identifiers in snake case.
WORDS = {
    r"looks(?! (?:at|down|for|like|up)\b)": "appearance",
    r"look_(?:weight|loss|accuracy|logits|scores?)|(?:by|word|random)_looks?": "appearance_…",
    r"turn_(?:bins|loss|accuracy|error|weight)|turnestimator": "rotation_bins, RelativeRotation",
    r"strangers?|bystanders?": "distractor, unused object",
    r"retell(?:ing|s)?|reread(?:ing)?|told otherwise": "prompt augmentation",
    r"told(?! apart)": "from, given",
    r"tally": "progress",
    r"players?": "rollout policies",
    r"films?|filmed|filming": "video",
    r"twins": "hard negatives",
    r"grays": "grayscale",
    r"lots": "hash_split",
    r"surprised?|likeliest|chances": "nll, greedy, probabilities",
    r"by heart": "overfit",
    r"processors|processor (?:time|core|alone)|(?:a|the|one) processor(?: core)?(?=[ ,.])": "CPU",
    r"per cent": "%",
    r"trunk|trunkstate|read_on": "decoder, KVCache, decode_next",
    r"referents?|nearness|lateness": "coreference, distance_bias, recency_bias",
    r"freepoints|shownturn|copyinghead|copyingconfig": "GridCandidates, RotationCopy, CandidatePointerHead",
    r"remembered|recollection|sights": "ObjectSet, PlaceCandidates, ObjectFeatures",
    r"motion_share|read as motions": "inverse_dynamics_prob, inverse dynamics",
    r"clip_norm|loader_workers|tune_crops": "max_grad_norm, num_workers, finetune_crop_encoder",
    r"--controls|clumsy|successes_strict": "--ablations, noisy, successes_oracle_horizon",
    r"objectfinder|see_objects": "ObjectExtractor, extract_objects",
    r"token cache|tokencache|data tokens": "object cache, data preprocess",
    r"proposalnetwork|least_overlap": "RegionProposalNetwork, IOU_THRESHOLD",
    r"(?-i:Lesson|Degree|Cast)": "AdjectiveExample, Attribute, Roles",
    r"vessels?|portraits?|chores": "containers, thumbnails, prerequisites",
    r"whole_file|component by component": "atomic_write, autoregressive",
    r"policy of the package|comes? with the package": "bundled checkpoint",
}
EXCEPTED = {  # file → word as it stands there → why
    "src/openvima/catalog/materials.py": {"film": "plastic film, a material"},
}


def boundary(pattern: str) -> re.Pattern[str]:
    """Compile a pattern that ends where a word, or a part of an identifier in snake case, ends."""
    return re.compile(rf"(?<![A-Za-z])(?:{pattern})(?![A-Za-z])", re.IGNORECASE)


def old_words(file: Path) -> Iterator[str]:
    """Yield what a file says in old words: file, line, the word and the one to use."""
    name = file.relative_to(ROOT).as_posix()
    excepted = EXCEPTED.get(name, {})
    for number, line in enumerate(file.read_text(encoding="utf-8").splitlines(), 1):
        for word, use in WORDS.items():
            for match in boundary(word).finditer(line):
                if match[0] not in excepted:
                    yield f"{name}:{number}: {match[0]!r}, use: {use}    {line.strip()[:120]}"


@pytest.mark.parametrize("file", FILES, ids=lambda file: file.relative_to(ROOT).as_posix())
def test_the_file_uses_no_old_word(file: Path) -> None:
    found = list(old_words(file))
    assert not found, "\n".join(found)


def test_every_term_of_the_glossary_is_where_it_says() -> None:
    contributing = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| (.+) \| .+ \| `([\w/.]+)` \|$", contributing, re.MULTILINE)
    assert len(rows) > 40
    wrong = []
    for term, where in rows:
        file = ROOT / "src" / "openvima" / where
        text = file.read_text(encoding="utf-8") if file.exists() else ""
        wrong += [f"{where}: {name}" for name in re.findall(r"`(\w+)`", term) if name not in text]
        wrong += [] if text else [f"{where} is missing"]
    assert not wrong, "\n".join(wrong)


def test_exceptions_are_in_use() -> None:
    for name, words in EXCEPTED.items():
        text = (ROOT / name).read_text(encoding="utf-8")
        assert not (unused := [word for word in words if word not in text]), f"{name}: {unused}"


if __name__ == "__main__":
    for path in FILES:
        print(*old_words(path), sep="\n")
