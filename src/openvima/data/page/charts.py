"""Histograms as plain SVG, which takes its colours from the page and names no element."""

from openvima.data.summary import Histogram

_MOST_BARS = 18
_NUM_FIRST, _NUM_LAST = 10, 6  # of histograms with more bars
_WIDTH = 400  # units of the drawing, as are all below; about pixels on a phone
_ROW = 21
_LETTER = 6.9  # width of an average letter in the widest of usual typefaces
_LONGEST_LABEL = 220
_COUNT = 92  # room for a count and its fraction
_GAP = 7


def bar_chart(histogram: Histogram) -> dict[str, object]:
    """Lay out a histogram: a bar per value, with its count and fraction.

    Of many values the first and the last are shown.

    Returns:
        Values of the template `histogram`.
    """
    entries: list[tuple[str, int] | None] = [*histogram.counts.items()]
    left_out = len(entries) - _NUM_FIRST - _NUM_LAST
    if len(entries) > _MOST_BARS:
        entries[_NUM_FIRST : len(entries) - _NUM_LAST] = [None]
    total, most = sum(histogram.counts.values()), max(histogram.counts.values())
    label_width = min(_LONGEST_LABEL, _LETTER * max(map(len, histogram.counts)))
    left = label_width + _GAP
    bars, texts = [], []  # x, y, width; x, y, anchor, colour, text
    for index, entry in enumerate(entries):
        middle = _ROW * index + _ROW / 2
        if entry is None:
            texts.append((left, middle + 4, "start", "muted", f"… {left_out} more …"))
            continue
        label, count = entry
        width = max(1.0, (_WIDTH - left - _GAP - _COUNT) * count / most)
        bars.append((left, middle - 6, width))
        texts.append((label_width, middle + 4, "end", "ink", label))
        texts.append((left + width + _GAP, middle + 4, "start", "muted", f"{count:,} ({count / total:.1%})"))
    size = (_WIDTH, _ROW * len(entries))
    return {"title": histogram.title, "size": size, "bars": bars, "texts": texts}
