"""Comma-separated options."""


def parse_list(text: str) -> tuple[str, ...]:
    """Split an option such as "rotate,twist"."""
    return tuple(word.strip() for word in text.split(",") if word.strip())


def parse_tasks(text: str) -> tuple[str, ...] | None:
    """Split the names of tasks; None for "all"."""
    names = parse_list(text)
    return None if names == ("all",) else names
