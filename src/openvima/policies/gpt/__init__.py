"""VIMA-GPT."""
