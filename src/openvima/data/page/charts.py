"""Histograms as plain SVG, which takes its colours from the page and names no element."""

import html

from openvima.data.summary import Histogram

_MOST_BARS = 18
_NUM_FIRST, _NUM_LAST = 10, 6  # of histograms with more bars
_WIDTH = 400  # units of the drawing, as are all below; about pixels on a phone
_ROW = 21
_FONT_SIZE = 11.5
_LETTER = 6.9  # width of an average letter in the widest of usual typefaces
_LONGEST_LABEL = 220
_COUNT = 92  # room for a count and its share
_GAP = 7


def bar_chart(histogram: Histogram) -> str:
    """Draw a histogram: a bar a value, with its count and share.

    Of many values the first and the last are shown.

    Args:
        histogram: What to draw.

    Returns:
        An `<svg>` element.
    """
    entries: list[tuple[str, int] | None] = [*histogram.counts.items()]
    left_out = len(entries) - _NUM_FIRST - _NUM_LAST
    if len(entries) > _MOST_BARS:
        entries[_NUM_FIRST : len(entries) - _NUM_LAST] = [None]
    total, most = sum(histogram.counts.values()), max(histogram.counts.values())
    label_width = min(_LONGEST_LABEL, _LETTER * max(map(len, histogram.counts)))
    left = label_width + _GAP
    longest = _WIDTH - left - _GAP - _COUNT
    rows = []
    for place, entry in enumerate(entries):
        middle = _ROW * place + _ROW / 2
        if entry is None:
            text = f"… {left_out} more …"
            rows.append(_words(left, middle, text, "start", "muted"))
            continue
        label, count = entry
        width = max(1.0, longest * count / most)
        rows.append(
            _words(label_width, middle, label, "end", "ink")
            + f'<rect x="{left:.1f}" y="{middle - 6:.1f}" width="{width:.1f}" height="12" rx="2" '
            f'fill="var(--accent)"/>'
            + _words(left + width + _GAP, middle, f"{count:,} ({count / total:.1%})", "start", "muted")
        )
    return (
        f'<svg viewBox="0 0 {_WIDTH} {_ROW * len(entries)}" role="img" '
        f'aria-label="{html.escape(histogram.title)}" font-size="{_FONT_SIZE}">{"".join(rows)}</svg>'
    )


def _words(x: float, middle: float, text: str, anchor: str, colour: str) -> str:
    return (
        f'<text x="{x:.1f}" y="{middle + 4:.1f}" text-anchor="{anchor}" fill="var(--{colour})">'
        f"{html.escape(text)}</text>"
    )
