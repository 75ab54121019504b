"""The tasks and the machinery that they share."""
