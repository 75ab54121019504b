"""The page on a data set: one HTML file with numbers, histograms and episodes to look at."""

from openvima.data.page.document import write_page

__all__ = ["write_page"]
