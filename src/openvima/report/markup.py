"""Pieces of HTML that several sections of the report share."""

from openvima.report.text import prose

DOT = '<span class="dot"></span>'  # in the colour of its policy


def section(name: str, title: str, lead: str, body: str) -> str:
    """A section of the page with heading and lead."""
    return f'<section id="{name}"><h2>{prose(title)}</h2><p>{prose(lead)}</p>{body}</section>'


def policy_head(policy: str, colour: str) -> str:
    """Head of a policy's column; the colour is a CSS variable."""
    return f'<th scope="col" style="--series:var({colour})">{DOT}{prose(policy)}</th>'


def folded(summary: str, body: str) -> str:
    """A collapsed section."""
    return f'<details class="card fold"><summary>{prose(summary)}</summary>{body}</details>'
