"""Lists in options: words with commas between them."""


def parse_list(text: str) -> tuple[str, ...]:
    """Return the words of an option such as "rotate,twist"."""
    return tuple(word.strip() for word in text.split(",") if word.strip())


def parse_tasks(text: str) -> tuple[str, ...] | None:
    """Return the names of tasks of an option; None for "all"."""
    names = parse_list(text)
    return None if names == ("all",) else names
