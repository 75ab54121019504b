"""Writing and reading demonstrations."""
